"""A setting learned from a drive by gradient: `python examples/learn_noise.py [DRIVE]`.

The sum of the log-evidence of all images is a function of the settings. The noise of a segment's
end points, in pixels, is moved uphill from a bad start.
"""

import dataclasses
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp

from sofjax import FilterConfig, SlamConfig, SofSlam
from sofjax.io.drive import read_drive
from sofjax.vision import Frontend, FrontendSettings, observe_drive

IMAGES, STEPS, RATE = 20, 5, 0.3
OFFICE = Path(__file__).parent / "office"

drive = read_drive(Path(sys.argv[1]) if len(sys.argv) > 1 else OFFICE)
drive = dataclasses.replace(
    drive, image_files=drive.image_files[:IMAGES], image_stamps=drive.image_stamps[:IMAGES]
)
camera_file, settings = drive.camera_file, FrontendSettings(capacity=32)
log = observe_drive(drive, Frontend(camera_file, settings))
config = SlamConfig(filter=FilterConfig(particles=64, soft=True))
key = jax.random.key(0)  # the same random numbers at each step


@jax.jit
@jax.value_and_grad
def log_evidence(log_sigma: jax.Array) -> jax.Array:
    """Of the drive, per image, by the logarithm of the pixels' standard deviation."""
    changed = eqx.tree_at(lambda c: c.sensor.pixel_sigma, config, jnp.exp(log_sigma))
    slam = SofSlam(changed, camera_file.camera, camera_file.mount)
    _, info = slam.run(slam.init(key, settings.capacity), log)
    return info.log_evidence.mean()


log_sigma = jnp.log(2.0)
for _ in range(STEPS):
    value, slope = log_evidence(log_sigma)
    print(f"pixel_sigma {float(jnp.exp(log_sigma)):.3f}: log-evidence {float(value):.2f} an image")
    log_sigma = log_sigma + RATE * jnp.clip(slope, -1, 1)
