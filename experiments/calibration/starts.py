"""Where does the mount of a drive end, begun from 24 places far from its own?

    python experiments/calibration/starts.py DRIVE [--scale 0.99] [--heights 6] [--tilts 4]
        [--each 1] [--out DIR]

30 % too high to 30 % too low, 8° too steep to 8° too flat, about what the drive's camera file says.
If that is the truth, as on a drive that was drawn, the errors are too: of the height over the
odometer's distances, which is all that can be seen, with --scale for what these read too much.
Writes `starts.json`.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))
import common

from sofjax.calibration import DriveFitConfig, fit_drive
from sofjax.io.drive import read_drive
from sofjax.vision import Frontend, observe_drive

RULES = DriveFitConfig()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("drive", metavar="DRIVE", type=Path)
    parser.add_argument("--scale", type=float, default=1.0, help="distances, read over true")
    parser.add_argument("--heights", type=int, default=6, help="from 0.7 to 1.3 times")
    parser.add_argument("--tilts", type=int, default=4, help="from -8 to 8 degrees more")
    parser.add_argument(
        "--each", type=int, default=1, choices=range(1, len(RULES.starts) + 1),
        help="searches, about each place; the command has all of them",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("runs/calibration"))
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    drive = read_drive(options.drive)
    log = observe_drive(drive, Frontend(drive.camera_file))
    double = lambda leaf: jnp.asarray(leaf, float if leaf.dtype.kind == "f" else leaf.dtype)
    given = (drive.camera_file.rig, log)
    rig, log = jax.tree.map(lambda leaf: double(np.asarray(leaf)), given)
    mount = rig.mount
    rules = dataclasses.replace(RULES, starts=RULES.starts[: options.each])
    told = np.array([mount.height * options.scale, mount.pitch, mount.roll], float)
    unit = np.array([told[0] / 100, np.pi / 180, np.pi / 180])
    rows = []
    print("begun at               ends at                      off by                    seconds")
    for times in np.linspace(0.7, 1.3, options.heights):
        for more in np.radians(np.linspace(-8, 8, options.tilts)):
            begin = dataclasses.replace(
                mount, height=mount.height * times, pitch=mount.pitch + more
            )
            begun = time.process_time()
            found = fit_drive(dataclasses.replace(rig, mount=begin), log, rules)
            m, seconds = found.fit.mount, time.process_time() - begun
            end = np.array([m.height, m.pitch, m.roll])
            off = (end - told) / unit
            verdict = found.verdict(rules)
            row = [float(begin.height), float(begin.pitch)]
            rows.append({"begin": row, "end": end, "off": off, "usable": verdict.usable,
                         "why": verdict.sentence,
                         "sigma": np.sqrt(np.diag(found.covariance))[:3] * [end[0], 1, 1],
                         "odometer": found.fit.odometer,
                         "processor_seconds": seconds})  # fmt: skip
            print(f"{row[0]:.3f} m, {np.degrees(row[1]):5.1f}°  {end[0]:.4f} m, "
                  f"{np.degrees(end[1]):6.3f}°, {np.degrees(end[2]):6.3f}°  {off[0]:+6.2f} %, "
                  f"{off[1]:+.3f}°, {off[2]:+.3f}°  {seconds:5.1f}  "
                  f"{verdict.sentence}", flush=True)  # fmt: skip
    off, ends = np.array([row["off"] for row in rows]), np.array([row["end"] for row in rows])
    worst, apart = np.abs(off).max(0), np.ptp(ends, axis=0) / unit
    said = lambda x: f"{x[0]:.2f} %, {x[1]:.3f}°, {x[2]:.3f}°"
    print(f"worst of {len(rows)}: {said(worst)}; apart by {said(apart)} (height, pitch, roll)")
    results = {"worst": worst, "apart": apart, "starts": rows}
    common.save(options.out, "starts", options, results)


if __name__ == "__main__":
    main()
