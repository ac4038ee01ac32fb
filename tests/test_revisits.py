"""Places seen again: where to ask, and path and map with the loop closed; worked examples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_loop_closure import blocks, seen_again

from sofjax.geometry import SE2, Mount, Segments
from sofjax.loop_closure import (
    Closing,
    ClosingConfig,
    Revisit,
    TimedLines,
    closed,
    driven,
    joined_map,
    moved_lines,
    revisits,
    solved,
)
from sofjax.segment_map import FinalMap, MapConfig, empty_map
from sofjax.smoothing import Keyframes, Lines, Path, Problem, Smoothed, Solution
from sofjax.smoothing.sparse.marginals import Marginals

T = 49  # images of a path 12 m out along x and 12 m back, half a metre apart
OUT = np.minimum(np.arange(T), T - 1 - np.arange(T)) * 0.5
PATH = SE2(jnp.asarray(np.stack([OUT, np.zeros(T)], 1), "float32"), jnp.zeros(T))
DRIFT = (0.3, -0.2, 0.02)


def bare(kind, **fields):
    """An object of which only some fields are there."""
    made = object.__new__(kind)
    for name, value in fields.items():
        object.__setattr__(made, name, value)
    return made


def there_and_back(rng, last_of_earlier=8):
    """Lines of the first metres, and the same lines as a drifted path describes them at the end."""
    earlier = blocks(1.1, 5, irregular=0.3)
    later = seen_again(earlier, *DRIFT, rng)
    n = len(earlier)
    first = np.repeat([2, T - 6], n)
    last = np.repeat([last_of_earlier, T - 1], n)
    sigma = np.tile([0.2, 0.2, 0.03], (T, 1))
    return TimedLines(PATH, sigma, np.concatenate([earlier, later]), first, last), n


def test_a_place_seen_again_is_found_with_its_lines_and_its_error(rng):
    drive, n = there_and_back(rng)
    (found,) = revisits(ClosingConfig(), drive, np.array([T - 1]))
    assert found.closing.accepted, found.closing.reason
    assert (found.image, found.since) == (T - 1, 2)
    later, earlier = found.lines.T
    assert len(later) > 0.8 * n and (later == earlier + n).all()
    np.testing.assert_allclose(found.closing.T_correction.xy, DRIFT[:2], atol=0.03)


def test_a_place_is_asked_for_every_few_metres_and_not_before_there_is_one(rng):
    drive, _ = there_and_back(rng)
    asked = [revisit.image for revisit in revisits(ClosingConfig(), drive)]
    assert asked and min(asked) >= T - 6 and (np.diff(asked) >= 4).all()


def test_lines_that_were_found_again_ask_for_nothing(rng):
    drive, _ = there_and_back(rng, last_of_earlier=T - 1)
    assert revisits(ClosingConfig(), drive, np.array([T - 1])) == []


def a_revisit(since=10, image=40):
    correction = SE2(jnp.array([0.4, 0.1]), jnp.array(0.1))
    closing = bare(Closing, T_correction=correction, accepted=True)
    return Revisit(image, since, closing, np.array([[1, 0]])), correction


def test_a_closed_path_is_as_it_was_before_the_place_and_moved_as_a_whole_behind_it(rng):
    drive, _ = there_and_back(rng)
    revisit, correction = a_revisit()
    path, motion = closed(drive, revisit)
    assert path.yaw.shape == motion.yaw.shape == (T,)
    np.testing.assert_array_equal(path.xy[:11], PATH.xy[:11])
    behind = correction @ jax.tree.map(lambda a: a[40:], PATH)
    np.testing.assert_allclose(path.xy[40:], behind.xy, atol=1e-5)
    np.testing.assert_allclose(path.yaw[40:], behind.yaw, atol=1e-6)
    by_motion = jax.vmap(lambda m, p: m @ p)(motion, PATH)  # each pose moves by its motion
    np.testing.assert_allclose(by_motion.xy, path.xy, atol=1e-5)
    np.testing.assert_allclose(by_motion.yaw, path.yaw, atol=1e-6)
    turned = np.asarray(path.yaw[10:41])  # the error is distributed uniformly along the path
    np.testing.assert_allclose(turned, np.linspace(0, 0.1, 31), atol=1e-5)


def test_lines_move_with_the_pose_that_saw_them_first(rng):
    drive, n = there_and_back(rng)
    revisit, correction = a_revisit()
    _, motion = closed(drive, revisit)
    moved = np.asarray(moved_lines(drive, motion))
    np.testing.assert_allclose(moved[:n], drive.endpoints_world[:n], atol=1e-6)
    expected = correction.apply(jnp.asarray(drive.endpoints_world[n:], "float32"))
    np.testing.assert_allclose(moved[n:], expected, atol=1e-5)


def floor(is_floor, ends):
    K = len(is_floor)
    none = jnp.zeros(K)
    return FinalMap(jnp.asarray(ends, float), jnp.asarray(is_floor), jnp.full(K, 9), none, none)


def test_a_driven_path_knows_when_its_lines_were_seen():
    m = empty_map(MapConfig(capacity=3))
    anchors = jax.tree.map(lambda a: a[jnp.array([4, 20, 30])], PATH)
    mount = Mount.create(height=0.6, pitch=0.3, x=0.05)
    m = bare(type(m), **vars(m) | {
        "anchor": anchors @ mount.T_robot_nadir, "unseen": jnp.array([40, 7, 0]),
    })  # fmt: skip
    path = Path(PATH, jnp.zeros((T, 2)), jnp.zeros(4))
    ends = np.zeros((3, 2, 2))
    drive = driven(path, mount, m, floor([True, True, False], ends))
    # out and back are the same places: the earliest image there counts
    np.testing.assert_array_equal(drive.first, [4, 20, 18])
    np.testing.assert_array_equal(drive.last, [T - 1 - 40, T - 1 - 7, -1])
    np.testing.assert_allclose(drive.travelled[[0, -1]], [0, 24], atol=1e-5)
    assert (np.diff(drive.sigma[:, 0]) > 0).all()


def a_solution():
    """Keyframes 0, 2, 4 of five images; line 0 is seen in the first two, line 1 in the last."""
    line = jnp.array([[0, 1], [0, 1], [1, 1]])
    known = jnp.array([[True, False], [True, False], [True, True]])
    keyframes = bare(Keyframes, line=np.asarray(line), known=np.asarray(known))
    covariance = np.zeros((3, 5, 5))
    covariance[:, [0, 1, 2], [0, 1, 2]] = np.array([[0.01], [0.04], [0.25]])
    solution = bare(
        Solution, marginals=bare(Marginals, pose=covariance),
        scale_sigma=np.array([0.02, 0.03]),
    )  # fmt: skip
    n = jax.tree.map(lambda a: a[:5], PATH)
    lines = bare(
        Lines, anchor=SE2(jnp.zeros((2, 2)), jnp.zeros(2)), line=jnp.ones((2, 3)),
        valid=np.array([True, True]),
    )  # fmt: skip
    return bare(
        Smoothed, T_world_robot=n, index=np.array([0, 2, 4]), lines=lines,
        problem=bare(Problem, keyframes=keyframes), solution=solution,
        measurements=np.array([2, 2]),
    )  # fmt: skip


def test_a_solved_path_knows_when_its_lines_were_seen_and_how_sure_it_is():
    drive = solved(a_solution(), floor([True, True], np.zeros((2, 2, 2))))
    np.testing.assert_array_equal(drive.first, [0, 4])
    np.testing.assert_array_equal(drive.last, [2, 4])
    np.testing.assert_allclose(drive.sigma[:, 0], [0.1, 0.2, 0.2, 0.5, 0.5])
    hidden = solved(a_solution(), floor([True, False], np.zeros((2, 2, 2))))
    np.testing.assert_array_equal(hidden.last, [2, -1])


def test_what_was_described_twice_is_once_in_the_joined_map():
    done = a_solution()
    ends = np.array([[[0, 1], [1, 1]], [[0, 1.2], [1, 1.2]]], float)
    drive = solved(done, floor([True, True], ends))
    still = SE2(jnp.zeros((5, 2)), jnp.zeros(5))
    motion = jax.tree.map(lambda a: a.at[4].add(0.1), still)
    revisit, _ = a_revisit()
    joined = joined_map(done, drive, motion, revisit)
    np.testing.assert_array_equal(joined.valid, [True, False])  # the later of the two goes
    np.testing.assert_allclose(joined.segments_world.endpoints[0], ends[0], atol=1e-6)
    np.testing.assert_allclose(joined.anchor.yaw, [0, 0.1], atol=1e-6)  # each with its first image
    np.testing.assert_allclose(joined.covariance[:, 2, 2], [0.02**2, 0.03**2], rtol=1e-5)
    assert isinstance(joined.segments_world, Segments)


@pytest.mark.parametrize("wrong", [{"share": -1.0}, {"margin": float("nan")}])
def test_settings_of_a_closing_that_are_none_are_refused(wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=f"ClosingConfig.{name} must be"):
        ClosingConfig(**wrong)
