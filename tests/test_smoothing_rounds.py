"""Keyframes, associations and merging by worked examples; the rounds on a small drive."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sofjax.extraction.observation import Observation
from sofjax.geometry import SE2, Camera, Mount, Segments, floor_homography, floor_to_image
from sofjax.motion import MotionModel
from sofjax.segment_map import MapConfig, empty_map
from sofjax.slam.config import SlamConfig
from sofjax.smoothing import (
    Keyframes,
    Path,
    Priors,
    Problem,
    Seeing,
    SmoothingConfig,
    Unknowns,
    smooth,
    smoother,
)
from sofjax.smoothing import keyframes as kf
from sofjax.smoothing.association.duplicates import duplicates, representatives
from sofjax.smoothing.association.lines import associate, lines_of
from sofjax.smoothing.association.revisits import apart
from sofjax.smoothing.solution import solve
from sofjax.smoothing.sparse.dissection import dissect
from sofjax.smoothing.sparse.elimination import Factors
from sofjax.smoothing.sparse.marginals import Marginals


def straight(n, step=0.1):
    return SE2(jnp.stack([step * jnp.arange(n, dtype=float), jnp.zeros(n)], axis=1), jnp.zeros(n))


def test_keyframes_are_a_distance_or_an_angle_apart():
    xy = np.stack([[0, 0.1, 0.2, 0.3, 0.3, 0.3], np.zeros(6)], axis=1)
    T = SE2(jnp.asarray(xy), jnp.asarray([0, 0, 0, 0, 0.2, 0.21]))
    assert list(kf.choose(T, 0.19, 0.1)) == [0, 2, 4, 5]  # the last is always one
    assert list(kf.choose(straight(1), 0.2, 0.1)) == [0]


def test_motion_between_keyframes_is_the_motions_of_the_images_in_a_row(x64, rng):
    motion = SE2(jnp.asarray(rng.normal(0, 0.1, (9, 2))), jnp.asarray(rng.normal(0, 0.3, 9)))
    log = Observation(
        Segments(jnp.zeros((9, 4, 2, 2)), jnp.ones((9, 4), bool)), motion, jnp.zeros(9, int)
    )
    frames = kf.gather(log, np.array([0, 3, 8]))
    want = SE2.identity()
    for i in range(1, 4):
        want = want @ jax.tree.map(lambda a, i=i: a[i], motion)
    np.testing.assert_allclose(frames.motion.xy[1], want.xy, atol=1e-12)
    np.testing.assert_allclose(frames.motion.yaw[1], want.yaw, atol=1e-12)
    forward, _, turn = motion.log()[4:9].T
    np.testing.assert_allclose(
        frames.way[2],
        [abs(forward).sum(), turn[turn > 0].sum(), turn[turn < 0].sum()],
        atol=1e-12,
    )  # fmt: skip
    # what is padded stands still and sees nothing
    assert not frames.segments_image.valid[3:].any()
    np.testing.assert_allclose(frames.way[3:], 0, atol=1e-12)
    np.testing.assert_allclose(frames.motion.xy[3:], 0, atol=1e-12)


def test_what_the_odometer_did_not_tell_adds_up_between_keyframes(x64):
    segments = Segments(jnp.zeros((9, 4, 2, 2)), jnp.ones((9, 4), bool))
    log = Observation(segments, straight(9), jnp.zeros(9, int))
    index = np.array([0, 3, 8])
    assert kf.gather(log, index).unknown is None
    sigma = jnp.zeros((9, 3)).at[2].set(0.3).at[4].set(0.4).at[3].set(0.1)
    frames = kf.gather(replace(log, motion_sigma=sigma), index)
    np.testing.assert_allclose(frames.unknown[1:3, 0], [0.3**2 + 0.1**2, 0.4**2], atol=1e-12)


def test_carried_poses_go_through_their_keyframes_and_keep_the_motion_between(x64, rng):
    T, index = straight(11), np.array([0, 5, 10])
    same = kf.carry(T, index, SE2(T.xy[index], T.yaw[index]))
    np.testing.assert_allclose(same.xy, T.xy, atol=1e-7)
    turned = SE2(jnp.array([[1.0, 1.0]]), jnp.array([0.5])) @ T
    moved = kf.carry(T, index, SE2(turned.xy[index], turned.yaw[index]))
    np.testing.assert_allclose(moved.xy, turned.xy, atol=1e-6)
    any_pose = SE2(jnp.asarray(rng.normal(size=(3, 2))), jnp.asarray(rng.normal(size=3)))
    through = kf.carry(T, index, any_pose)
    np.testing.assert_allclose(through.xy[index], any_pose.xy, atol=1e-6)


def lines_along_x(y, reach, off_floor=None):
    """Lines parallel to the x axis, described from the origin."""
    K = len(y)
    ends = jnp.stack(
        [jnp.asarray(reach, float), jnp.broadcast_to(jnp.asarray(y)[:, None], (K, 2))], -1
    )
    off_floor = jnp.zeros(K, bool) if off_floor is None else jnp.asarray(off_floor)
    line = jnp.stack(
        [jnp.asarray(y, float), jnp.zeros(K), 1 + 0.1 * off_floor.astype(float)], axis=1
    )
    anchor = SE2(jnp.zeros((K, 2)), jnp.zeros(K))
    return lines_of(anchor, line, ends, off_floor, jnp.ones(K, bool))


CAMERA = Camera(jnp.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), 320, 240)
MOUNT = Mount.create(x=0.1, height=0.8, pitch=0.4)


def keyframe(segments_image, driven=0.0):
    """One that shows nothing yet."""
    none = jnp.zeros(segments_image.valid.shape, int)
    still = SE2(jnp.zeros((1, 2)), jnp.zeros(1))
    return Keyframes(segments_image, none, none > 0, still, jnp.array([[driven, 0.0, 0.0]]))


def test_a_segment_shows_the_nearest_line_that_reaches_it():
    lines = lines_along_x([0.3, 0.32, -0.3], [[1, 2], [1, 2], [4, 5]])
    np.testing.assert_allclose(lines.endpoints_world[0], [[1, 0.3], [2, 0.3]], atol=1e-6)
    H_F = floor_homography(CAMERA, MOUNT, SE2.identity())
    floor = jnp.array([
        [[1.2, 0.302], [1.8, 0.302]],  # the first line, though the second is near
        [[1.2, -0.3], [1.8, -0.3]],  # on the third line, and 2.2 m before what was seen of it
        [[1.2, 0.25], [1.8, 0.25]],  # far from all
    ])  # fmt: skip
    image, ahead = jax.vmap(jax.vmap(floor_to_image, (None, 0)), (None, 0))(H_F, floor)
    assert ahead.all()
    unknowns = Unknowns(jnp.zeros((1, 5)), lines.line, jnp.zeros(8))
    seen = keyframe(Segments(image[None], jnp.ones((1, 3), bool)))
    index, known = associate(Seeing(), 8.0, 1.0, CAMERA, MOUNT, lines, unknowns, seen)
    assert known.tolist() == [[True, False, False]]
    assert index[0, 0] == 0


@pytest.mark.parametrize(
    ("y", "driven", "shows"),
    [
        (0.3, 5.0, True),
        (0.0, 5.0, False),  # it points to the nadir, as an edge of a door does
        (0.3, 9.0, False),  # after the part of the way in which the line may be seen
    ],
)
def test_what_may_be_upright_or_was_passed_shows_no_line(y, driven, shows):
    lines = lines_along_x([y], [(1, 2)])
    lines = replace(lines, span=jnp.array([[0.0, 6.0]]))
    H_F = floor_homography(CAMERA, MOUNT, SE2.identity())
    ends = jax.vmap(lambda p: floor_to_image(H_F, p)[0])(jnp.array([[1.2, y], [1.8, y]]))
    seen = keyframe(Segments(ends[None, None], jnp.ones((1, 1), bool)), driven)
    unknowns = Unknowns(jnp.zeros((1, 5)), lines.line, jnp.zeros(8))
    _, known = associate(Seeing(), 8.0, 1.0, CAMERA, MOUNT, lines, unknowns, seen)
    assert bool(known[0, 0]) == shows


def drive_past(known, line, driven, lines):
    """A problem of which only what was seen is there."""
    n, M = known.shape
    frames = Keyframes(
        Segments(jnp.zeros((n, M, 2, 2)), jnp.asarray(known)), jnp.asarray(line),
        jnp.asarray(known), SE2(jnp.zeros((n, 2)), jnp.zeros(n)),
        jnp.pad(jnp.diff(jnp.asarray(driven, float), prepend=0.0)[:, None], ((0, 0), (0, 2))),
    )  # fmt: skip
    start = Unknowns(jnp.zeros((n, 5)), lines.line, jnp.zeros(8))
    return Problem(
        CAMERA, MOUNT, MotionModel(), Priors(), frames, lines.anchor, lines.off_floor, start
    )


def test_what_is_seen_again_after_a_way_is_another_line():
    lines = lines_along_x([0.3, -0.3], [(1, 2), (1, 2)])
    driven = np.array([0, 1, 2, 3, 20, 21, 22])
    known = np.array([[1, 1], [1, 1], [1, 1], [1, 1], [1, 1], [1, 0], [1, 0]], bool)
    line = np.tile([0, 1], (7, 1))
    problem = drive_past(known, line, driven, lines)
    told, passes = apart(problem, lines, passing=10.0, least=3, room=4)
    assert told.keyframes.line[:, 0].tolist() == [0, 0, 0, 0, 2, 2, 2]
    assert not told.keyframes.known[4, 1]  # once is too seldom for a line
    assert passes.valid.tolist() == [True, True, True, False]
    np.testing.assert_allclose(passes.span[:3], [[-5, 8], [-5, 8], [15, 27]], atol=1e-6)
    np.testing.assert_allclose(passes.line[2], lines.line[0])
    assert passes.off_floor.tolist()[:3] == [False, False, True]  # its height is anew to be found
    same, _ = apart(problem, lines, passing=np.inf, least=3, room=4)
    assert same.keyframes.line.tolist() == line.tolist()


def test_what_may_as_well_be_one_as_another_is_left_for_later():
    lines = lines_along_x([0.0, 0.1, 0.05], [(1, 2), (1, 2), (1, 2)])
    sigma = jnp.diag(jnp.array([0.05, 0.01, 1e-6]))
    joint = jnp.zeros((3, 3, 3, 3)).at[2, :, 2, :].set(sigma @ sigma)
    _, joins = duplicates(lines, known(joint), jnp.array([9, 8, 4]))
    assert not joins.any()  # the first two are two, and the third may be either
    lines = lines_along_x([0.0, 0.1, 0.05], [(1, 2), (5, 6), (1, 2)])
    _, joins = duplicates(lines, known(joint), jnp.array([9, 8, 4]))
    assert joins.tolist() == [False, False, True]


@pytest.mark.parametrize(("y", "joins"), [(-0.2, [False] * 3), (0.19, [False, True, True])])
def test_two_that_are_known_to_be_two_are_not_both_made_one_with_a_third(y, joins):
    """Each may be the first line, by errors of its own; 40 cm apart they are not one another."""
    lines = lines_along_x([0.0, 0.2, y], [(1, 2)] * 3)
    sigma = jnp.diag(jnp.array([0.1, 0.01, 1e-6]))
    joint = jnp.einsum("ab,kl->kalb", sigma @ sigma, jnp.diag(jnp.array([0.01, 1.0, 1.0])))
    _, found = duplicates(lines, known(joint), jnp.array([9, 5, 4]))
    assert found.tolist() == joins


@pytest.mark.parametrize(
    ("y", "reach", "off_floor", "together", "is_one"),
    [
        (0.1, (1, 2), False, False, True),  # 10 cm off where 5 cm are a standard deviation
        (0.1, (1, 2), False, True, False),  # but seen side by side they are two edges
        (0.2, (1, 2), False, False, False),  # four standard deviations off
        (0.1, (2.5, 3), False, False, False),  # half a metre beyond the other's end
        (0.1, (1, 2), True, False, False),  # above the floor, and the other is on it
    ],
)
def test_lines_are_one_where_what_is_known_of_both_together_allows_it(
    y, reach, off_floor, together, is_one
):
    lines = lines_along_x([0.0, y], [(1, 2), reach], [False, off_floor])
    sigma = jnp.diag(jnp.array([0.05, 0.01, 1e-6]))
    joint = jnp.zeros((2, 3, 2, 3)).at[0, :, 0, :].set(0.01 * sigma @ sigma)
    joint = joint.at[1, :, 1, :].set(sigma @ sigma)
    if together:  # the same error in both: their difference is known well
        joint = jnp.broadcast_to((sigma @ sigma)[None, :, None, :], (2, 3, 2, 3))
    into, joins = duplicates(lines, known(joint), jnp.array([9, 4]))
    assert joins.tolist() == [False, is_one]
    assert not is_one or into[1] == 0


@pytest.mark.parametrize(("undetermined", "is_one"), [(True, False), (False, True)])
def test_two_edges_of_the_floor_are_not_made_one_by_heights_that_are_free(undetermined, is_one):
    """Each passed on another side, which shifts what stands above the floor the other way."""
    lines = lines_along_x([0.0, 0.1], [(1, 2), (1, 2)], [True, True])
    lines = eqx.tree_at(
        lambda l: (l.line, l.undetermined),
        lines,
        (lines.line.at[:, 2].set(1), jnp.array([undetermined] * 2)),
    )
    passed = jnp.array([[0.8, 0, 1], [-0.8, 0, 1]]) * 0.1  # metres, radians, the apparent scale
    joint = jnp.einsum("ka,kb,kl->kalb", passed, passed, jnp.eye(2))
    _, joins = duplicates(lines, known(joint), jnp.array([9, 4]))
    assert joins.tolist() == [False, is_one]


def known(joint):
    """Marginals of some lines that the only leaf eliminates, after the pose of its keyframe."""
    none = jnp.zeros((1, 1), int)
    frames = Keyframes(
        Segments(jnp.zeros((1, 1, 2, 2)), none > 0), none, none > 0,
        SE2(jnp.zeros((1, 2)), jnp.zeros(1)), jnp.zeros((1, 3)),
    )  # fmt: skip
    K = len(joint)
    dissection = dissect(frames, K, np.zeros(1, int))
    (only,) = dissection.generations
    a, q = only.own.shape[1], only.border.shape[1]
    within = jnp.zeros((1, a + q, a + q))
    within = within.at[0, 5 : 5 + 3 * K, 5 : 5 + 3 * K].set(joint.reshape(3 * K, 3 * K))
    factors = Factors(dissection, (jnp.zeros((1, a, a)),), (jnp.zeros((1, a, q)),))
    return Marginals(factors, (within,), jnp.zeros((1, 5, 5)))


def test_names_are_handed_on_to_the_end():
    into = np.array([0, 0, 1, 3])
    assert representatives(into, np.array([False, True, True, False])).tolist() == [0, 0, 0, 3]


@pytest.mark.slow
def test_rounds_find_the_path_that_the_odometer_misread(rng, monkeypatch):
    """An odometer that reads 3 % too much, and a map that was made by it."""
    T = straight(41, 0.05)
    y = np.concatenate([np.full(12, 0.5), np.full(12, -0.6)])
    start = np.tile(np.linspace(0.6, 3.9, 12), 2)
    along = np.stack([np.stack([start, y], 1), np.stack([start + 0.2, y], 1)], axis=1)
    across = np.stack([np.stack([start, y - 0.1], 1), np.stack([start, y + 0.1], 1)], axis=1)
    floor = np.concatenate([along, across])

    def see(T):
        H_F = floor_homography(CAMERA, MOUNT, T)
        image, ahead = jax.vmap(jax.vmap(floor_to_image, (None, 0)), (None, 0))(
            H_F, jnp.asarray(floor)
        )
        inside = (image >= 0).all((1, 2)) & (image < jnp.array([320.0, 240.0])).all((1, 2))
        return Segments(image, ahead.all(1) & inside)

    seen = jax.jit(jax.vmap(see))(T)
    noisy = Segments(seen.endpoints + rng.normal(0, 0.2, seen.endpoints.shape), seen.valid)
    read = SE2(jnp.concatenate([jnp.zeros((1, 2)), 1.03 * jnp.diff(T.xy, axis=0)]), jnp.zeros(41))
    log = Observation(noisy, read, jnp.zeros(41, int))
    wrong = floor * [1.03, 1.0]  # [48, 2, 2]
    K = len(floor)
    m = empty_map(MapConfig(capacity=K))
    d = wrong[:, 1] - wrong[:, 0]
    theta = np.arctan2(d[:, 1], d[:, 0])
    rho = -np.sin(theta) * wrong[:, 0, 0] + np.cos(theta) * wrong[:, 0, 1]
    m = replace(
        m,
        segments_world=Segments(jnp.asarray(wrong), jnp.ones(K, bool)),
        line=jnp.stack([jnp.asarray(rho), jnp.asarray(theta), jnp.ones(K)], axis=1),
        covariance=jnp.broadcast_to(jnp.diag(jnp.array([0.01, 0.01, 0.02]) ** 2), (K, 3, 3)),
        updates=jnp.full(K, 9),
    )
    online = SE2(1.03 * T.xy, T.yaw)
    path = Path(online, jnp.zeros((41, 2)), jnp.zeros(4))
    kinds = set()

    def solve_of_one_kind(problem, dissection, **how):
        kinds.add(str(jax.eval_shape(lambda *a: a, problem, dissection)))
        return solve(problem, dissection, **how)

    monkeypatch.setattr(smoother, "solve", solve_of_one_kind)
    done = smooth(SlamConfig(), CAMERA, MOUNT, log, path, m, SmoothingConfig(rounds=2))
    assert len(kinds) == 1  # compiled once, before lines are merged and after
    assert done.solution.converged
    np.testing.assert_allclose(done.T_world_robot.xy, T.xy, atol=0.01)
    assert np.abs(online.xy - T.xy).max() > 0.05
    assert done.solution.unknowns.shared[4] == pytest.approx(-0.03, abs=0.01)
    assert done.T_world_robot.xy.dtype == np.float64
    assert done.merged >= 15  # the pieces of the two dashed lines; the bars across stay apart
    bars = done.lines.valid[24:48]
    assert bars.sum() >= 22
    ends = done.endpoints_world[24:48]
    often = bars & (done.measurements[24:48] > 8)
    assert often.sum() >= 8
    np.testing.assert_allclose(
        ends[often].mean(1)[:, 0], floor[24:].mean(1)[often][:, 0], atol=0.02
    )


def test_segments_that_show_no_line_are_left_aside():
    known = jnp.array([[False, True, False, True], [True, False, False, False]])
    line = jnp.array([[0, 5, 0, 3], [2, 0, 0, 0]])
    ends = jnp.broadcast_to(jnp.arange(4.0)[None, :, None, None], (2, 4, 2, 2))
    still = SE2(jnp.zeros((2, 2)), jnp.zeros(2))
    frames = Keyframes(Segments(ends, known), line, known, still, jnp.zeros((2, 3)))
    narrow = kf.narrowed(frames, 2)
    assert narrow.known.tolist() == [[True, True], [True, False]]
    assert narrow.line[0].tolist() == [5, 3]
    assert narrow.line[1, 0] == 2
    assert narrow.segments_image.endpoints[0, :, 0, 0].tolist() == [1, 3]


def test_sizes_are_rounded_up_to_few():
    sizes = [kf.padded(s) for s in range(1, 1025)]
    assert all(size >= s for s, size in enumerate(sizes, 1))
    assert sorted(set(sizes)) == [64, 96, 128, 192, 256, 384, 512, 768, 1024]
    assert kf.padded(5000) == 5120
