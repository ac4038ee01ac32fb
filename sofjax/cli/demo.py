"""`sofjax demo`: the whole system on a made-up drive, in one command."""

import argparse
import json
import time
from pathlib import Path

from sofjax.cli import inspect, simulate
from sofjax.cli import run as estimate
from sofjax.cli.arguments import make_parser

PAGE, IMAGES = "index.html", "images.png"


def run(args: argparse.Namespace) -> int:
    """Simulate, look, run, explain: each step is a command that can be given alone."""
    begun = time.perf_counter()
    from sofjax import viewer
    from sofjax.io.text import write_atomically
    from sofjax.pipeline import run_folder

    folder = args.out or Path("runs") / f"demo-{time.strftime('%Y%m%d-%H%M%S')}"
    run_folder.check_new(folder)
    run_folder.check_writable(folder)
    drive, result = folder / "drive", folder / "run"
    steps = (
        ("a robot is driven through a made-up corridor", simulate.run, [
            "simulate", "--world", args.world, "--seed", str(args.seed), "--out", str(drive)
        ]),
        ("lines in its camera's images: which of them are on the floor?", inspect.run, [
            "inspect", str(drive), "--out", str(folder / IMAGES)
        ]),
        ("its path and a map of the floor, from images and odometry", estimate.run, [
            "run", str(drive), "--out", str(result)
        ]),
    )  # fmt: skip
    for number, (what, command, words) in enumerate(steps, start=1):
        if command is inspect.run and not viewer.available():
            continue
        print(f"\n[{number}/{len(steps)}] {what}\n$ sofjax {' '.join(words)}", flush=True)
        code = command(make_parser().parse_args(words))
        if code:
            return code
    report = json.loads((result / run_folder.REPORT).read_text())
    write_atomically(folder / PAGE, page(report, drive, viewer.available()))
    print(f"\ndone in {time.perf_counter() - begun:.0f} s; look at {folder / PAGE}")
    return 0


def page(report: dict, drive: Path, pictures: bool) -> str:
    """The page that a newcomer reads: three pictures, a table, what they mean."""
    from sofjax.viewer import MISSING

    errors, images = report["errors"], report["images"]["done"]
    odometry, found, of_map = errors["odometry"], errors["trajectory"], errors["map"]
    columns = (odometry, found, errors.get("smoothed") or found)
    middle = sorted((drive / "rgb").iterdir())[images // 5].name

    def row(name: str, key: str, unit: str, digits: int) -> str:
        cells = "".join(f"<td>{errors[key]:.{digits}f} {unit}</td>" for errors in columns)
        return f"<tr><th>{name}</th>{cells}</tr>"

    def picture(source: str, what: str) -> str:
        if pictures:
            return f'<img src="{source}" alt="{what}">'
        return f"<p><em>{MISSING}</em></p>"

    return f"""<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<title>sofjax: a drive and its map</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: auto; padding: 1rem }}
img {{ max-width: 100% }}
table {{ border-collapse: collapse }}
td, th {{ padding: .2rem 1rem; border-bottom: 1px solid #ccc; text-align: left }}
</style>
<h1>One camera, two wheels and a flat floor</h1>
<p>A robot was driven {found["path_m"]:.0f} m through a corridor that exists in the computer only,
so that the truth is known to the millimetre. It has one camera, and an odometer that counts the
turns of its wheels and is wrong about them.</p>
<h2>What it sees</h2>
<p><img src="drive/rgb/{middle}" alt="an image of the camera"></p>
<p>In each of {images} images, straight segments are found. Those that move from image to image as
the floor does are used; the others, such as door frames and rails, are not on the floor and would
mislead.</p>
{picture(IMAGES, "segments on the floor and others")}
<h2>Where it went, and the map that it made on the way</h2>
<p>Dashed is the path by the odometer alone: the corners turn in too far, and errors grow. Red is
the estimate; grey, mostly hidden under it, is the truth. Blue are the segments of the map. After
the drive, all poses and all lines were solved for at once, so that what was seen again at the end
of the loop lies where it was first seen.</p>
{picture("run/map.png", "the path and the map")}
<table>
<tr><th></th><th>odometer alone</th><th>while driving</th><th>solved afterwards</th></tr>
{row("position, root mean square", "ate_m", "m", 3)}
{row("of the path", "ate_percent", "%", 2)}
{row("heading, root mean square", "yaw_deg", "°", 2)}
{row("error at the end", "end_gap_m", "m", 2)}
</table>
<p>The map has {of_map["segments"]} segments; of their length {100 * of_map["precision"]:.0f} % lies
within 5 cm of a true line on the floor.</p>
<h2>On your own drive</h2>
<p><code>drive/</code> shows the files that a drive needs; <code>sofjax inspect DRIVE</code> checks
them, and <code>sofjax run DRIVE</code> does what was done here.</p>
</html>
"""
