"""What the same pixels mean by another lens, clock, shutter and place of the camera."""

import dataclasses
from types import SimpleNamespace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from conftest import jit_quickly, make_camera
from simulated import numpy_pose

from sofjax.calibration import UNKNOWNS, SegmentPairs, all_distances, start_at
from sofjax.extraction.observation import LAGS, Observation
from sofjax.geometry import SE2, Camera, Mount, Segments
from sofjax.io.trajectory import Trajectory
from sofjax.rig import RIG, Lens, Rig, corrected, exposure, motion_between, retaken

pytestmark = pytest.mark.usefixtures("x64")

BROWN = {
    "none": np.zeros(5),
    "plumb_bob": np.array([-0.2, 0.05, 0.001, -0.002, 0.01]),
    "rational": np.array([0.3, -0.1, 0.001, 0.002, 0.02, 0.5, 0.05, 0.01]),
}
FISHEYE = np.array([0.03, -0.02, 0.01, -0.004])
POINTS = np.array([[0.0, 0.0], [0.4, 0.3], [-0.55, 0.4], [0.1, -0.42], [1e-5, 0.0]])
PIXELS = np.array([[159.5, 119.5], [40.0, 200.0], [300.0, 150.0], [160.0, 230.0]])
TWIST = np.array([0.5, 0.0, 0.4])  # metres and radians a second
AROUND = LAGS[:, None] * TWIST  # of a robot that drives steadily along an arc


def shown(lens, points, K=None):
    """Points [n, 2] of the normalised image as OpenCV shows them; pixels where K is given."""
    K = np.eye(3) if K is None else np.asarray(K)
    k = np.asarray(lens.coefficients)
    if lens.fisheye:
        return cv2.fisheye.distortPoints(points[None], K, k[:4])[0]
    at = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    return cv2.projectPoints(at, np.zeros(3), np.zeros(3), K, k)[0][:, 0]


def undistorted(lens, pixels, K):
    """The pixels that OpenCV shows at `pixels`, found by SciPy's root finder."""
    K = np.asarray(K)
    normal = lambda x: (x - K[:2, 2]) / np.diag(K)[:2]
    off = lambda x, want: shown(lens, normal(x)[None], K)[0] - want
    return np.array([scipy.optimize.root(off, x, (x,), tol=1e-12).x for x in pixels])


def lenses():
    return [*(Lens.of(k) for k in BROWN.values()), Lens.of(FISHEYE, fisheye=True)]


def make_rig(lens=None, **clock):
    mount = Mount(*map(jnp.asarray, (0.05, 0.02, 0.6, 0.26, 0.02, -0.01)))
    values = {name: jnp.asarray(value) for name, value in clock.items()}
    return Rig(
        make_camera(), mount, Lens.of(BROWN["plumb_bob"]) if lens is None else lens, **values
    )


def other(rig, **by):
    """The rig with some of `RIG` changed."""
    return rig.moved(jnp.array([by.get(name, 0.0) for name in RIG]))


by_point = jit_quickly(jax.vmap(retaken, in_axes=(None, None, None, 0)))


def test_a_lens_shows_points_as_opencv_does_and_undistorts_them():
    for lens in lenses():
        distorted = np.array([lens.distort(jnp.asarray(n)) for n in POINTS])
        np.testing.assert_allclose(distorted, shown(lens, POINTS), atol=1e-9)
        near = POINTS + np.array([0.01, -0.01])
        back = [
            lens.undistort(jnp.asarray(d), jnp.asarray(n))
            for d, n in zip(distorted, near, strict=True)
        ]
        np.testing.assert_allclose(back, POINTS, atol=1e-8)


def test_the_same_rig_retakes_the_same_image():
    for lens in lenses():
        rig = make_rig(lens, time_offset=0.03, line_delay=2e-5)
        np.testing.assert_allclose(by_point(rig, rig, AROUND, PIXELS), PIXELS, atol=1e-8)
        np.testing.assert_allclose(by_point(rig, rig, None, PIXELS), PIXELS, atol=1e-8)


def test_another_lens_and_matrix_retake_as_opencv_undistorts():
    """What the camera showed is undistorted by the right lens in the place of the given one."""
    for lens in lenses():
        given = make_rig(lens)
        right = other(given, focal=0.03, cx=0.01, cy=-0.02, k1=0.04, k2=-0.02)
        K = np.asarray(right.camera.K)
        assert K[0, 0] / 270 == pytest.approx(np.exp(0.03))
        assert K[0, 2] - 159.5 == pytest.approx(0.01 * K[0, 0])
        normal = (PIXELS - [159.5, 119.5]) / 270
        raw = shown(lens, normal, given.camera.K)
        want = undistorted(right.lens, raw, right.camera.K)
        np.testing.assert_allclose(by_point(given, right, None, PIXELS), want, atol=1e-4)


def test_a_mount_moves_with_the_height_that_it_is_measured_in():
    rig = make_rig()
    moved = other(rig, height=0.1, pitch=0.01, x=0.2, y=-0.1, time_offset=0.02).mount
    height = 0.6 * np.exp(0.1)
    np.testing.assert_allclose(
        [moved.height, moved.pitch, moved.x, moved.y],
        [height, 0.27, 0.05 + 0.2 * height, 0.02 - 0.1 * height],
    )


# Moments


def pose_after(seconds):
    """By the book: along an arc from the origin."""
    v, _, w = TWIST
    return np.array([v / w * np.sin(w * seconds), v / w * (1 - np.cos(w * seconds))]), w * seconds


def project(rig, P, seconds):
    """A floor point in the image, normalised, by plain projection."""
    R, C = numpy_pose(SimpleNamespace(mount=rig.mount), *pose_after(seconds))
    x = (np.array([*P, 0.0]) - C) @ R
    return x[:2] / x[2]


def rolled(rig, P, late):
    """Where a camera that reads row after row shows a floor point: the robot moves row by row."""
    K, delay = rig.camera.K, float(rig.line_delay)
    at = lambda row: shown(rig.lens, project(rig, P, late + row * delay)[None], K)[0]
    rows = np.arange(-50, 400)
    ahead = np.array([at(row)[1] - row for row in rows])
    i = int(np.flatnonzero((ahead[:-1] >= 0) & (ahead[1:] < 0))[0])
    share = ahead[i] / (ahead[i] - ahead[i + 1])
    return at(rows[i] + share)


@pytest.mark.parametrize(
    "by",
    [
        dict(line_delay=8e-5),
        dict(line_delay=-8e-5, time_offset=0.08),
        dict(line_delay=5e-5, time_offset=-0.1, k1=0.03, focal=0.02, pitch=0.02, height=0.1),
    ],
)
def test_rows_are_put_back_to_the_stamp_as_a_robot_moved_row_by_row_shows(by):
    """Slow: each row has a pose of its own, and the point is in the row that sees it there."""
    given = make_rig()
    right = other(given, **by)
    late = by.get("time_offset", 0.0)
    floor = np.array([[1.5, 0.3], [1.2, -0.2], [3.0, 0.5], [0.9, 0.0]])
    raw = np.array([rolled(right, P, late) for P in floor])
    normal = undistorted(given.lens, raw, given.camera.K)
    K = np.asarray(right.camera.K)
    want = np.array([K[:2, :2] @ project(right, P, late) + K[:2, 2] for P in floor])
    moved = np.abs(by_point(given, right, AROUND, normal) - normal).max()
    np.testing.assert_allclose(by_point(given, right, AROUND, normal), want, atol=0.01)
    assert moved > 0.3


def driven():
    """A path with a bend that comes and goes, read at 200 Hz."""
    t = np.arange(0, 6, 0.005)
    yaw = 0.6 * np.sin(1.3 * t)
    speed = 0.5 + 0.2 * np.sin(0.7 * t)
    xy = np.cumsum(speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], 1), axis=0) * 0.005
    return Trajectory(t, xy, yaw)


def pose_of(trajectory, stamp):
    at = trajectory.at(np.array([stamp]))
    return SE2(jnp.asarray(at.xy[0]), jnp.asarray(at.yaw[0]))


def ways(trajectory, stamp):
    here = pose_of(trajectory, stamp)
    return jnp.stack([here.between(pose_of(trajectory, stamp + lag)).log() for lag in LAGS])


@pytest.mark.parametrize(
    ("late", "within"), [(0.0, 1e-9), (0.05, 1e-9), (-0.2, 1e-9), (0.08, 2e-4)]
)
def test_the_motion_by_another_clock_is_that_of_the_trajectory_at_shifted_stamps(late, within):
    """Exact at `LAGS`, which are looked up; interpolated between them."""
    path = driven()
    given = make_rig(time_offset=0.01)
    right = other(given, time_offset=late)
    first, second = 2.0, 2.3
    read = pose_of(path, first).between(pose_of(path, second))
    got = motion_between(given, right, read, ways(path, first), ways(path, second))
    want = pose_of(path, first + late).between(pose_of(path, second + late))
    np.testing.assert_allclose(got.xy, want.xy, atol=within)
    np.testing.assert_allclose(got.yaw, want.yaw, atol=within)


def test_beyond_the_lags_the_way_ends():
    far, last = (exposure(jnp.asarray(AROUND), jnp.asarray(s)) for s in (5.0, LAGS[-1]))
    np.testing.assert_array_equal([*far.xy, far.yaw], [*last.xy, last.yaw])


def test_a_whole_log_is_corrected_image_by_image_and_its_first_motion_stays():
    given = make_rig()
    right = other(given, time_offset=0.05, k1=0.02)
    path, stamps = driven(), np.array([1.0, 1.2, 1.4])
    poses = [pose_of(path, s) for s in stamps]
    motion = [SE2.identity(), poses[0].between(poses[1]), poses[1].between(poses[2])]
    motion = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v, float) for v in x]), *motion)
    ends = jnp.broadcast_to(jnp.asarray(PIXELS[1:3]), (3, 2, 2, 2))
    around = jnp.stack([ways(path, s) for s in stamps])
    log = Observation(
        Segments(ends, jnp.ones((3, 2), bool)), motion, jnp.zeros(3, int), around=around
    )
    found = corrected(given, right, log)
    for i in range(3):
        want = by_point(given, right, around[i], PIXELS[1:3])
        np.testing.assert_allclose(found.segments_image.endpoints[i, 0], want, atol=1e-9)
    assert float(found.motion.yaw[0]) == 0 and not found.motion.xy[0].any()
    want = pose_of(path, 1.25).between(pose_of(path, 1.45))
    np.testing.assert_allclose(found.motion.xy[2], want.xy, atol=1e-9)
    bare = corrected(given, right, dataclasses.replace(log, around=None))
    np.testing.assert_array_equal(bare.motion.yaw, motion.yaw)


# Derivatives


def central(f, n, step=1e-6):
    eye = np.eye(n) * step
    return np.stack([(f(jnp.asarray(e)) - f(jnp.asarray(-e))) / (2 * step) for e in eye], axis=-1)


HORIZON = 119.5 - 270 * np.tan(0.26)  # the row, about: the camera rolls by 0.02
PLACES = {
    "ordinary": (AROUND, (220.0, 180.0), 0.03),
    "the centre": (AROUND, (159.5, 119.5), 0.03),
    "no motion": (0 * AROUND, (220.0, 180.0), 0.0),
    "a lag beyond all": (AROUND, (220.0, 180.0), 0.7),
    "the horizon": (AROUND, (159.5, HORIZON), 0.03),
    "above it": (AROUND, (200.0, 10.0), 0.03),
}


@pytest.mark.parametrize("lens", [BROWN["plumb_bob"], FISHEYE], ids=["brown", "fisheye"])
def test_derivatives_of_a_retaken_point_are_those_of_finite_differences(lens):
    """By all of `RIG`, at ordinary points and where a formula could divide by nothing."""
    given = make_rig(Lens.of(lens, fisheye=len(lens) == 4))

    def of(by, around, point, late):
        right = other(given, time_offset=late, line_delay=3e-5)
        return retaken(given, right.moved(by), around, point)

    slopes, value = jit_quickly(jax.jacfwd(of)), jit_quickly(of)
    for name, (around, point, late) in PLACES.items():
        at = (around, jnp.array(point), jnp.asarray(late))
        got = slopes(jnp.zeros(len(RIG)), *at)
        assert np.isfinite(got).all(), name
        want = central(lambda by, at=at: value(by, *at), len(RIG))
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-4, err_msg=name)


def test_derivatives_of_distances_by_all_unknowns_are_those_of_finite_differences():
    """And never NaN: not without motion, at the centre, at the horizon or beyond the lags."""
    given = make_rig()
    n = len(UNKNOWNS)
    late = jnp.zeros(n).at[UNKNOWNS.index("time_offset")].set(0.03)
    bias = jnp.zeros(n).at[UNKNOWNS.index("left")].set(0.02)

    def of(by, pairs):
        return all_distances(start_at(given).moved(late + bias + by), pairs)[0]

    def pair(first, second, motion, around):
        T = SE2(jnp.array([motion[:2]]), jnp.array([motion[2]]))
        both = (jnp.asarray(around)[None],) * 2
        return SegmentPairs(
            jnp.array([first]), jnp.array([second]), T, jnp.ones(1, bool), jnp.ones((1, 4)),
            jnp.zeros(1, int), both,
        )  # fmt: skip

    near, far = [[60.0, 180.0], [250.0, 170.0]], [[70.0, 195.0], [260.0, 190.0]]
    slopes, value = jit_quickly(jax.jacfwd(of)), jit_quickly(of)
    smooth = {
        "ordinary": pair(near, far, (0.2, 0.01, 0.1), AROUND),
        "the centre": pair([[159.5, 119.5], [250.0, 170.0]], far, (0.2, 0.0, 0.1), AROUND),
        "the horizon": pair([[100.0, HORIZON], [250.0, 170.0]], far, (0.2, 0.0, 0.1), AROUND),
    }
    for name, each in smooth.items():
        got, want = slopes(jnp.zeros(n), each), central(lambda by, p=each: value(by, p), n)
        np.testing.assert_allclose(got, want, rtol=1e-3, atol=2e-3, err_msg=name)
    degenerate = [
        pair(near, far, (0.0, 0.0, 0.0), 0 * AROUND),  # no motion
        pair(near, near, (0.0, 0.0, 0.0), AROUND),
        pair([[80.0, 180.0]] * 2, [[90.0, 190.0]] * 2, (0.2, 0.0, 0.1), AROUND),  # no length
    ]
    beyond = jnp.zeros(n).at[UNKNOWNS.index("time_offset")].set(3.0)
    for each in degenerate:
        assert np.isfinite(slopes(jnp.zeros(n), each)).all()
        assert np.isfinite(slopes(beyond, each)).all()


def test_a_rig_without_a_lens_is_one_of_the_precision_that_it_is_made_in():
    camera, mount = make_camera(), Mount.create(height=0.6, pitch=0.2)
    rig = Rig(camera, mount)
    assert isinstance(rig.camera, Camera)
    assert {leaf.dtype for leaf in jax.tree.leaves((rig.lens, rig.time_offset))} == {
        np.dtype(float)
    }
