"""10,000 poses scored against a map of one's own: `python examples/batch_likelihood.py`."""

import jax
import jax.numpy as jnp
import numpy as np

import sofjax
from sofjax import SE2, Camera, Mount, Segments

# a map: K segments on the floor, end points (x, y) in the world, metres
endpoints = np.array([
    [[0.0, 1.0], [8.0, 1.0]], [[0.0, -1.0], [8.0, -1.0]],  # along a corridor
    [[2.0, -1.0], [2.0, 1.0]], [[4.0, -1.0], [4.0, 1.0]], [[4.0, 0.0], [6.0, 0.5]],
])  # fmt: skip
segment_map = Segments(jnp.asarray(endpoints, float), jnp.ones(len(endpoints), bool))

# a camera, and an image taken 0.5 m along the corridor: M segments, pixels
K = jnp.array([[270.0, 0.0, 159.5], [0.0, 270.0, 119.5], [0.0, 0.0, 1.0]])
camera, mount = Camera(K, width=320, height=240), Mount.create(height=0.6, pitch=0.26, x=0.05)
true_pose = SE2(jnp.array([0.5, 0.1]), jnp.array(0.02))
H = sofjax.floor_homography(camera, mount, true_pose)
seen = np.array([[[2.0, -0.7], [2.0, 0.8]], [[2.5, 1.0], [4.5, 1.0]], [[2.5, -1.0], [4.5, -1.0]]])
pixels, _ = jax.vmap(jax.vmap(lambda x: sofjax.floor_to_image(H, x)))(jnp.asarray(seen, float))
segments_image = Segments(pixels, jnp.ones(len(pixels), bool))

# N poses about a guess
rng = np.random.default_rng(0)
guess, spread = np.array([0.6, 0.0, 0.0]), np.array([0.2, 0.2, 0.05])
poses = jnp.asarray(guess + spread * rng.standard_normal((10_000, 3)), float)
noise = sofjax.LineNoise(rho_sigma=0.02, theta_sigma=0.02)


def score(poses: jax.Array, soft: bool) -> jax.Array:
    """log L of poses [N, 3]; the soft form has derivatives."""
    particles = SE2(poses[:, :2], poses[:, 2])
    return sofjax.image_log_likelihood(
        camera, mount, particles, segments_image, segment_map, noise, soft=soft
    )


best = poses[jnp.argmax(score(poses, soft=False))]
print("best of 10,000 poses (x, y, yaw):", *np.asarray(best).round(3))
uphill = jax.grad(lambda pose: score(pose[None], soft=True)[0])(best)
print("d log L / d pose there:", *np.asarray(uphill).round(1))
