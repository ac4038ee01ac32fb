"""Calls that must be refused, and what they say, as JSON; run by test_likelihood_arguments.py."""

import json

import jax
import jax.numpy as jnp

from sofjax import (
    PRESETS,
    SE2,
    Association,
    Camera,
    FilterConfig,
    LineNoise,
    MotionModel,
    Mount,
    Segments,
    SofSlam,
    image_log_likelihood,
    log_likelihood,
    pose_log_likelihood,
)

poses = SE2(jnp.zeros((4, 2)), jnp.zeros(4))
two = SE2(jnp.zeros((2, 2)), jnp.zeros(2))
seen = Segments.of([[[1.0, 1.0], [2.0, 1.0]]])
noise = LineNoise(0.1, 0.1)
camera = Camera(jnp.array([[300.0, 0, 320], [0, 300, 240], [0, 0, 1]]), 640, 480)
mount = Mount.create(0.5, 0.4)
whole = SE2(jnp.zeros((4, 2), int), jnp.zeros(4, int))
lost = SE2(poses.xy.at[3].set(jnp.nan), poses.yaw)
config = PRESETS["default"]
slam = SofSlam(config, camera, mount)
state = slam.init(jax.random.key(0), 1)
seen_image = Segments.of([[[300.0, 400.0], [10.0, 400.0]]])
calls = {
    "integer poses": lambda: log_likelihood(whole, seen, seen, noise),
    "one pose": lambda: log_likelihood(SE2(jnp.zeros(2), jnp.zeros(())), seen, seen, noise),
    "a pose that is not a number": lambda: log_likelihood(lost, seen, seen, noise),
    "an array of poses": lambda: log_likelihood(poses.xy, seen, seen, noise),
    "an end that is infinite": lambda: log_likelihood(
        poses, Segments.of([[[1.0, jnp.inf], [2.0, 1.0]]]), seen, noise
    ),
    "a mask of numbers": lambda: log_likelihood(
        poses, Segments(seen.endpoints, jnp.ones(1, int)), seen, noise
    ),
    "pixels for metres": lambda: log_likelihood(
        poses, Segments.of([[[1200.0, 300.0], [10.0, 300.0]]]), seen, noise
    ),
    "an array as map": lambda: log_likelihood(poses, seen, seen.endpoints, noise),
    "a number as noise": lambda: log_likelihood(poses, seen, seen, 0.15),
    "another order": lambda: log_likelihood(seen, poses, seen, noise),
    "a mask of floats": lambda: log_likelihood(two, seen, seen, noise, used=jnp.ones((2, 1))),
    "covariances of another size": lambda: log_likelihood(
        poses, seen, seen, noise, covariance=jnp.eye(2)
    ),
    "metres for pixels": lambda: image_log_likelihood(camera, mount, poses, seen, seen, noise),
    "mount before camera": lambda: image_log_likelihood(mount, camera, poses, seen, seen, noise),
    "pixels of a small image for metres": lambda: log_likelihood(
        poses, Segments.of([[[300.0, 200.0], [10.0, 100.0]]]), seen, noise
    ),
    "a pose of a filter that is not a number": lambda: pose_log_likelihood(
        slam, state, seen_image, lost
    ),
    "an image before the state": lambda: pose_log_likelihood(slam, seen_image, state, poses),
    "a negative noise of the motion": lambda: MotionModel(turn_noise=-0.1),
    "a gate that is not a number": lambda: Association(gate=float("nan")),
    "a choice that is none": lambda: FilterConfig(choice="winer"),
    "an int as key": lambda: SofSlam(config, camera, mount).init(0, 64),
    "camera before settings": lambda: SofSlam(camera, mount, config),
}


def said(call):
    try:
        return f"accepted: {jax.block_until_ready(call())}"
    except ValueError as error:
        return str(error)


print(json.dumps({name: said(call) for name, call in calls.items()}))
