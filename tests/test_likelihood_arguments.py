"""What cannot be scored is refused by name."""

import functools
import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_batch import NOISY, problem

from sofjax import LineNoise, Segments, log_likelihood
from sofjax.geometry import SE2

SAID = {
    "integer poses": "particles must be floating point numbers, not int32",
    "one pose": "particles must be N poses, xy [N, 2] and yaw [N], not xy (2,); for one pose use",
    "a pose that is not a number": "particles must be finite where it is valid; row 3 is not",
    "an array of poses": "particles must be poses SE2(xy [N, 2], yaw [N]), not",
    "an end that is infinite": "observed must be finite where it is valid; row 0 is not",
    "a mask of numbers": "observed.valid must be a mask of bool, not int32",
    "pixels for metres": "it must be in metres of the robot frame; pixels go into image_log",
    "an array as map": "segment_map must be Segments(endpoints [K, 2, 2], valid [K]), not",
    "a number as noise": "noise must be a LineNoise(rho_sigma, theta_sigma, e_max), not float",
    "another order": "particles must be poses SE2(xy [N, 2], yaw [N]), not Segments",
    "a mask of floats": "used must be a mask of bool [2, 1], not float32 [2, 1]",
    "covariances of another size": "covariance must be [1, 2, 2], not [2, 2]",
    "metres for pixels": "it must be in pixels; metres of the robot frame go into log_likelihood",
    "mount before camera": "camera must be a Camera, not Mount",
    "pixels of a small image for metres": "it must be in metres of the robot frame",
    "a pose of a filter that is not a number": "T_world_robot must be finite where",
    "an image before the state": "state must be a SlamState, not Segments",
    "a negative noise of the motion": "MotionModel.turn_noise must be a number from 0 on, not -0.1",
    "a gate that is not a number": "Association.gate must be a number from 0 on, not nan",
    "a choice that is none": "FilterConfig.choice must be 'resample' or 'winner', not 'winer'",
    "an int as key": "key must be a jax.random.key(...), not a int",
    "camera before settings": "SofSlam(config, camera, mount): config must be a SlamConfig, not a",
}


@functools.cache
def refusals():
    """What is said without the type checks of the tests, as a user sees it."""
    file = Path(__file__).parent / "refused_arguments.py"
    done = subprocess.run([sys.executable, file], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.parametrize("what", SAID)
def test_what_cannot_be_scored_is_refused_by_name(what):
    assert SAID[what] in refusals()[what]


@pytest.mark.parametrize("wrong", [0.0, -0.1, float("nan"), float("inf")])
@pytest.mark.parametrize("field", ["rho_sigma", "theta_sigma", "e_max", "gap_scale"])
def test_noise_must_be_above_zero(field, wrong):
    right = {"rho_sigma": 0.1, "theta_sigma": 0.1}
    with pytest.raises(ValueError, match=f"LineNoise.{field} must be a number above 0"):
        LineNoise(**right | {field: wrong})


@pytest.mark.parametrize("N", [9, 300])
def test_the_hard_form_says_that_it_has_no_derivative(N):
    cloud, seen, lines = problem(N)
    total = lambda xy: log_likelihood(SE2(xy, cloud.yaw), seen, lines, NOISY).sum()
    with pytest.raises(ValueError, match="hard form has no derivative; pass soft=True"):
        jax.grad(total)(cloud.xy)
    with pytest.raises(ValueError, match="hard form has no derivative; pass soft=True"):
        jax.jit(jax.grad(total))(cloud.xy)


def test_a_map_of_ones_own_is_an_array():
    ends = np.array([[[3.0, -5.0], [3.0, 5.0]]])
    pose = SE2(jnp.array([[1.0, 0.0]]), jnp.array([0.0]))
    seen = Segments.of([[[2.3, -1.0], [2.3, 1.0]]])
    found = log_likelihood(pose, seen, Segments.of(ends), LineNoise(0.15, 0.08))
    np.testing.assert_allclose(found, -0.5 * (0.3 / 0.15) ** 2, rtol=1e-5)
