"""The path and the map of a drive: `python examples/quickstart.py [DRIVE]`."""

import sys
from pathlib import Path

from sofjax.io.drive import read_drive
from sofjax.pipeline import run_drive

OFFICE = Path(__file__).parent / "office"

drive = read_drive(Path(sys.argv[1]) if len(sys.argv) > 1 else OFFICE)
result = run_drive(drive)

print(f"{drive.name}: {len(result.trajectory.stamps)} poses, {len(result.segments)} segments")
print("last pose (x, y, yaw):", *result.trajectory.xy[-1].round(3), result.trajectory.yaw[-1])
if result.errors.smoothed:  # the drive has the true path
    print(f"{result.errors.smoothed.ate_m:.3f} m from the true path")
