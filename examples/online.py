"""One image at a time, as a robot would: `python examples/online.py [DRIVE]`.

The images and the odometry come from a drive's folder here; on a robot they come from its drivers.
"""

import sys
from pathlib import Path

import jax
import numpy as np

from sofjax import PRESETS, SofSlam
from sofjax.io.drive import motions, read_drive
from sofjax.vision import Frontend, observation

OFFICE = Path(__file__).parent / "office"

drive = read_drive(Path(sys.argv[1]) if len(sys.argv) > 1 else OFFICE)
camera_file = drive.camera_file  # camera, lens and mount
frontend = Frontend(camera_file)

slam = SofSlam(PRESETS["default"], camera_file.camera, camera_file.mount)
state = slam.init(jax.random.key(0), capacity=frontend.settings.capacity)

for file, motion in zip(drive.image_files, motions(drive), strict=True):
    view = frontend.view(file)  # an array [height, width]: frontend.detect(frontend.undistort(a))
    # `motion` is what the wheels say since the image before: (dx, dy, dyaw), metres and radians
    state, info = slam.step(state, observation(view, motion))
    x, y = np.asarray(info.T_world_robot.xy)
    print(f"{file.name}: {x:.3f} {y:.3f} m, {int(info.matched)} segments known", flush=True)

print(f"{int(state.segment_map.valid.sum())} lines in the map")
