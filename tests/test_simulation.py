"""The simulator: what it draws, what it calls true, and what it refuses."""

import dataclasses
import itertools
import math
import re
import time
from functools import cache

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sofjax.cli import main
from sofjax.geometry import SE2, Camera, Mount
from sofjax.io.camera_file import CameraFile
from sofjax.io.drive import motions, read_drive
from sofjax.simulation import (
    WORLDS,
    Detection,
    Driver,
    Imaging,
    Odometer,
    Renderer,
    RobotSetup,
    Scene,
    make_world,
    observe,
    random_setup,
    record,
    simulate_run,
    webcam,
)
from sofjax.simulation.robot import clearance, drive_along, increments, read_path
from sofjax.simulation.world.floors import BLOCK_SPACING, BLOCK_WIDTH
from sofjax.simulation.world.plan import inside, offset_walls, parts_inside, union_walls
from sofjax.simulation.world.types import Areas

CLEAN = Imaging(noise=0.0, blur=0.55, exposure_time=0.0, hunting=0.0, vignetting=0.0)
NO_BOXES = {"boxes": np.zeros((0, 5)), "box_colours": np.zeros((0, 3))}
SAMPLES = [(name, 0) for name in sorted(WORLDS)] + [("random", seed) for seed in range(1, 6)]


@cache
def world_of(name, seed=0):
    return make_world(name, seed)


@cache
def run_of(name, seed=0):
    still = RobotSetup(vibration=0.0, dropped=0.0)
    return simulate_run(world_of(name, seed), still, seed)


def office_camera():
    """The lens and mount of the sample drive."""
    mount = Mount.create(height=0.6, pitch=0.2618, x=0.05)
    return webcam(mount, focal=270.0, distortion=(-0.14, 0.05, 0.0003, 0.0005, 0.0))


# The plan


def test_walls_of_an_l_by_hand():
    corridors = np.array([[0.0, 0.0, 2.0, 6.0], [0.0, 4.0, 5.0, 6.0]])
    walls = {tuple(wall.ravel()) for wall in union_walls(corridors)}
    assert walls == {
        (0, 0, 2, 0), (2, 0, 2, 4), (2, 4, 5, 4), (5, 4, 5, 6), (5, 6, 0, 6), (0, 6, 0, 0)
    }  # fmt: skip


@pytest.mark.parametrize(("name", "seed"), SAMPLES)
def test_the_corridor_is_on_the_left_of_every_wall_and_the_walls_close(name, seed):
    world = world_of(name, seed)
    a, b = world.walls[:, 0], world.walls[:, 1]
    d = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    normal = np.stack([-d[:, 1], d[:, 0]], axis=1)
    for share in (0.01, 0.5, 0.99):
        point = a + share * (b - a)
        assert inside(world.corridors, point + 1e-3 * normal).all()
        assert not inside(world.corridors, point - 1e-3 * normal).any()
    assert sorted(map(tuple, a)) == sorted(map(tuple, b))


def test_offset_walls_meet_in_every_corner():
    world = world_of("eight")
    moved = offset_walls(world.corridors, world.walls, 0.2)
    starts, ends = moved[:, 0], moved[:, 1]
    gaps = np.linalg.norm(starts[:, None] - ends[None], axis=-1).min(1)
    np.testing.assert_allclose(gaps, 0, atol=1e-12)


def test_parts_inside_cross_two_corridors():
    corridors = np.array([[0.0, 0.0, 1.0, 5.0], [3.0, 0.0, 4.0, 5.0]])
    parts = parts_inside(corridors, np.array([[-1.0, 1.0], [9.0, 1.0]]))
    np.testing.assert_allclose(parts, [[[0, 1], [1, 1]], [[3, 1], [4, 1]]])


# Worlds


@pytest.mark.parametrize(("name", "seed"), SAMPLES)
def test_truth_is_on_the_floor_inside_and_the_rest_is_not(name, seed):
    world = world_of(name, seed)
    floor, off_floor = world.floor_segments, world.off_floor_segments
    assert (floor.endpoints[..., 2] == 0).all()
    middles = floor.endpoints[:, :, :2].mean(1)
    grown = world.corridors + np.array([-1e-6, -1e-6, 1e-6, 1e-6])
    assert inside(grown, middles).all()
    assert (np.linalg.norm(floor.endpoints[:, 1] - floor.endpoints[:, 0], axis=-1) > 0.05).all()
    assert (off_floor.endpoints[..., 2].max(1) > 0).all()
    assert (world.reflections.endpoints[..., 2] == -world.ceiling).all()


def test_the_papers_blocks_have_its_width_and_spacing():
    world = world_of("paper")
    marks = world.floor_areas.corners[np.array(world.floor_areas.kinds) == "mark"]
    size = marks.max(1) - marks.min(1)
    np.testing.assert_allclose(size.min(1), BLOCK_WIDTH)
    first = marks.mean(1)[abs(marks.mean(1)[:, 0]) < 0.5]  # of the left corridor
    np.testing.assert_allclose(np.diff(np.sort(first[:, 1])), BLOCK_SPACING, atol=0.05)
    assert np.ptp(world.waypoints, axis=0) == pytest.approx([11.5, 24])


def test_a_world_is_the_same_for_a_seed_and_another_for_another():
    again, other = make_world("random", 3), make_world("random", 4)
    np.testing.assert_array_equal(
        again.floor_segments.endpoints, make_world("random", 3).floor_segments.endpoints
    )
    assert again.floor_segments.endpoints.shape != other.floor_segments.endpoints.shape


def test_random_worlds_have_every_floor():
    kinds = {kind for seed in range(12) for kind in make_world("random", seed).floor_segments.kinds}
    assert {"mark", "grout", "plank", "stripe", "joint", "threshold", "wall", "box"} <= kinds


# Robots


@pytest.mark.parametrize(("name", "seed"), SAMPLES)
def test_a_drive_keeps_off_the_walls_and_arrives(name, seed):
    world = world_of(name, seed)
    path = drive_along(world.waypoints, Driver(), np.random.default_rng(seed))
    assert clearance(world.walls, path) > 0.3
    assert np.linalg.norm(path.xy[-1] - world.waypoints[-1]) < 0.2
    speed = np.linalg.norm(np.diff(path.xy, axis=0), axis=1) / np.diff(path.stamps)
    assert speed.max() <= Driver().speed + 1e-6


PERFECT = Odometer(
    distance=1, left=1, right=1, distance_noise=0, heading_noise=0, turn_noise=0, slip=0
)  # fmt: skip


def test_a_perfect_odometer_reads_the_true_path():
    truth = run_of("l").truth
    read = read_path(PERFECT, truth, jax.random.key(0))
    first = SE2(jnp.asarray(truth.xy[0]), jnp.asarray(truth.yaw[0]))
    back = jax.vmap(first.apply)(jnp.asarray(read.xy, first.xy.dtype))
    np.testing.assert_allclose(back, truth.xy, atol=2e-4)


def test_an_odometer_scales_left_and_right_turns_apart():
    odometer = dataclasses.replace(PERFECT, left=jnp.asarray(1.1), right=jnp.asarray(0.9))
    turns = SE2(jnp.zeros((2, 2)), jnp.array([0.2, -0.2]))
    np.testing.assert_allclose(
        odometer.read(turns, jax.random.key(0)).yaw, [0.22, -0.18], rtol=1e-6
    )


def test_the_odometers_noise_adds_up_alike_however_the_path_is_cut():
    odometer = dataclasses.replace(
        PERFECT, distance_noise=jnp.asarray(0.02), heading_noise=jnp.asarray(0.02)
    )
    spread = []
    for pieces in (1, 10):
        steps = SE2(
            jnp.tile(jnp.array([1.0 / pieces, 0.0]), (4000 * pieces, 1)), jnp.zeros(4000 * pieces)
        )
        read = odometer.read(steps, jax.random.key(1))
        for metres in (read.xy[:, 0], read.yaw):
            spread.append(float(metres.reshape(4000, pieces).sum(1).std()))
    np.testing.assert_allclose(spread, 0.02, rtol=0.1)


def test_the_papers_robot_spins_inward_on_a_clockwise_loop():
    simulated = run_of("paper")
    assert simulated.truth.yaw[-1] - simulated.truth.yaw[0] == pytest.approx(-2 * np.pi, abs=0.1)
    assert simulated.odometry.yaw[-1] < -2 * np.pi * 1.03


def test_readings_are_dropped_and_the_ends_stay():
    setup = RobotSetup(dropped=0.3)
    simulated = simulate_run(world_of("l"), setup)
    all_of_it = run_of("l").odometry
    assert 0.6 < len(simulated.odometry.stamps) / len(all_of_it.stamps) < 0.8
    assert (
        simulated.odometry.stamps[0] == 0
        and simulated.odometry.stamps[-1] >= simulated.truth.stamps[-1]
    )


def test_the_mount_shakes_by_what_is_asked():
    simulated = simulate_run(world_of("l"), RobotSetup(vibration=np.radians(0.1)))
    moving = np.linalg.norm(np.gradient(simulated.truth.xy, axis=0), axis=1) > 0.065
    pitch = np.degrees(np.asarray(simulated.mounts.pitch))[moving]
    assert 0.07 < pitch.std() < 0.13


# Drawn images


def numpy_pose(camera_file, xy, yaw):
    """R_world_camera and C by the book: Rz Ry Rx A, plain numpy."""
    mount = {
        k: float(getattr(camera_file.mount, k))
        for k in ("x", "y", "height", "pitch", "roll", "yaw")
    }

    def rotation(axis, angle):
        c, s = np.cos(angle), np.sin(angle)
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        R = np.eye(3)
        R[i, i] = R[j, j] = c
        R[i, j], R[j, i] = -s, s
        return R

    A = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
    Rz = rotation("z", yaw)
    R = (
        Rz
        @ rotation("z", mount["yaw"])
        @ rotation("y", mount["pitch"])
        @ rotation("x", mount["roll"])
        @ A
    )
    return R, np.array([*xy, 0]) + Rz @ [mount["x"], mount["y"], mount["height"]]


def project(camera_file, R, C, points):
    """Pixels of world points [n, 3] through the lens, and their depths."""
    local = (points - C) @ R
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    k1, k2, p1, p2, k3 = camera_file.distortion
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    K = np.asarray(camera_file.camera.K, float)
    return np.stack([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]], axis=1), local[:, 2]


def behind_a_wall(world, nadir, points, margin=0.05):
    """[n] whether the straight way from the camera's nadir to a plan point crosses a wall.

    The last `margin` metres of the way do not count: the wall that the point is on.
    """

    def side(p, q, r):
        u, v = q - p, r - p
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    rays = points - nadir
    ends = nadir + rays * (1 - margin / np.linalg.norm(rays, axis=1, keepdims=True))
    a, b = world.walls[:, 0], world.walls[:, 1]
    ends = ends[:, None]
    apart = side(a, b, ends) * side(a, b, nadir) < 0
    return (apart & (side(nadir, ends, a) * side(nadir, ends, b) <= 0)).any(1)


def edge_offsets(world, camera_file, simulated, frames, kinds, narrow):
    """Distances in pixels of drawn edges from where the truth projects, along the normal."""
    renderer = Renderer(world, camera_file, CLEAN)
    truth = world.floor_segments
    offsets = []
    for i in frames:
        R, C = numpy_pose(camera_file, simulated.truth.xy[i], simulated.truth.yaw[i])
        grey = cv2.cvtColor(
            renderer.draw(R, C, simulated.truth.stamps[i]), cv2.COLOR_BGR2GRAY
        ).astype(np.float32)
        for ends, kind in zip(truth.endpoints, truth.kinds, strict=True):
            if kind not in kinds:
                continue
            ends = np.round(ends, 4)  # as they are written
            n = max(3, int(np.linalg.norm(ends[1] - ends[0]) / 0.1))
            points = ends[0] + np.linspace(0.05, 0.95, n)[:, None] * (ends[1] - ends[0])
            x, depth = project(camera_file, R, C, points)
            ahead, _ = project(camera_file, R, C, points + 1e-3 * (ends[1] - ends[0]))
            size = np.array([camera_file.camera.width, camera_file.camera.height])
            ok = (depth > 0.3) & (depth < 3.5) & ((x > 8) & (x < size - 9)).all(1)
            ok[ok] = ~behind_a_wall(world, C[:2], points[ok, :2])
            if not ok.any():
                continue
            along = ahead[ok] - x[ok]
            normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
            normal /= np.linalg.norm(along, axis=1, keepdims=True)
            t = np.arange(-4, 4.01, 0.25)
            lines = (x[ok][:, None] + t[:, None] * normal[:, None]).astype(np.float32)
            profiles = cv2.remap(grey, lines[..., 0], lines[..., 1], cv2.INTER_LINEAR)
            found = [ridge(t, p) if narrow else step(t, p) for p in profiles]
            offsets += [offset for offset in found if offset is not None]
    return np.array(offsets)


def step(t, profile):
    """Where a profile with one clear step passes half way."""
    low, high = profile[:5].mean(), profile[-5:].mean()
    if abs(high - low) < 35 or np.ptp(profile[:5]) > 8 or np.ptp(profile[-5:]) > 8:
        return None
    rising = (profile - low) / (high - low)
    crossings = np.flatnonzero((rising[:-1] < 0.5) & (rising[1:] >= 0.5))
    if len(crossings) != 1:
        return None
    i = crossings[0]
    return t[i] + (0.5 - rising[i]) / (rising[i + 1] - rising[i]) * (t[i + 1] - t[i])


def ridge(t, profile):
    """The middle of a dark or light line on an even ground."""
    ground = np.median(profile)
    deep = profile - ground
    if np.abs(deep).max() < 15:
        return None
    strong = np.where(np.abs(deep) > 0.5 * np.abs(deep).max(), np.abs(deep), 0)
    return (t * strong).sum() / strong.sum()


def test_written_truth_lands_on_the_drawn_edges():
    world = dataclasses.replace(world_of("paper", 3), **NO_BOXES)
    simulated = run_of("paper", 3)
    mount = Mount.create(height=1.0, pitch=0.21, x=0.1, y=0.03, roll=0.02, yaw=-0.03)
    frames = range(5, len(simulated.truth.stamps), 200)
    offsets = edge_offsets(world, webcam(mount), simulated, frames, {"mark", "wall"}, narrow=False)
    assert len(offsets) > 100
    assert np.abs(np.median(offsets)) < 0.05
    assert np.quantile(np.abs(offsets), 0.95) < 0.3


def test_written_truth_lands_on_the_middle_of_drawn_joints():
    world = dataclasses.replace(world_of("l", 2), **NO_BOXES)
    simulated = run_of("l", 2)
    offsets = edge_offsets(
        world, office_camera(), simulated, range(5, 200, 40), {"grout"}, narrow=True
    )
    assert len(offsets) > 100
    assert np.abs(np.median(offsets)) < 0.05
    assert np.quantile(np.abs(offsets), 0.9) < 0.3


def test_walls_hide_what_is_behind_them():
    """Every pixel of a bare world against a slow cast of its ray, wall by wall."""
    bare = Areas(np.zeros((0, 4, 2)), np.zeros((0, 3)), ())
    world = world_of("l", 1)
    red, green, blue = np.diag([0.7, 0.7, 0.7])
    world = dataclasses.replace(
        world,
        floor_areas=bare,
        floor_lines=dataclasses.replace(
            world.floor_lines, endpoints=np.zeros((0, 2, 2)), widths=np.zeros(0),
            colours=np.zeros((0, 3)), kinds=(),
        ),
        wall_areas=bare,
        wall_of_area=np.zeros(0, int),
        **NO_BOXES,
        lamps=np.zeros((0, 4)),
        lamp_light=np.zeros(0),
        look=dataclasses.replace(world.look, floor=red, wall=green, ceiling=blue, gloss=0.0),
    )  # fmt: skip
    camera_file = webcam()
    camera_file = dataclasses.replace(camera_file, distortion=np.zeros(5))
    K = np.asarray(camera_file.camera.K, float)
    renderer = Renderer(world, camera_file, dataclasses.replace(CLEAN, blur=0.0))
    rng = np.random.default_rng(0)
    wrong = total = 0
    for xy, yaw in (([0.2, 6.5], 1.1), ([0.0, 8.0], 0.3), ([-0.3, 4.0], 1.7), ([5.0, 9.3], -2.9)):
        R, C = numpy_pose(camera_file, np.array(xy), yaw)
        image = renderer.draw(R, C, 0.0)
        pixels = rng.integers(0, [320, 240], (300, 2))
        for u, v in pixels:
            ray = R @ np.linalg.solve(K, [u, v, 1])
            reach, kind = (
                (C[2] / -ray[2], 2) if ray[2] < 0 else ((world.ceiling - C[2]) / ray[2], 0)
            )
            for a, b in world.walls:
                M = np.column_stack([ray[:2], a - b])
                if abs(np.linalg.det(M)) > 1e-9:
                    s, t = np.linalg.solve(M, a - C[:2])
                    if 0 < s < reach and 0 <= t <= 1:
                        reach, kind = s, 1
            wrong += int(image[v, u].argmax() != kind)
            total += 1
    assert wrong / total < 0.01


def test_an_image_is_the_same_for_a_seed():
    world, camera_file = world_of("l"), office_camera()
    R, C = numpy_pose(camera_file, np.array([0.0, 2.0]), 1.5)
    first, again = (Renderer(world, camera_file, Imaging(), 5).draw(R, C, 0.0) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = Renderer(world, camera_file, Imaging(), 6).draw(R, C, 0.0)
    assert (first != other).any()


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("plumb_bob", [-0.2527, 0.0399, 0.0, 0.0, 0.0]),
        ("equidistant", [0.02, -0.01, 0.003, 0.0]),
        ("rational_polynomial", [0.1, 0.01, 0.0, 0.0, 0.0, 0.2, 0.01, 0.0]),
    ],
)
def test_any_lens_can_be_drawn_through(model, distortion):
    K = jnp.array([[153.0, 0.0, 163.0], [0.0, 153.0, 125.0], [0.0, 0.0, 1.0]])
    mount = Mount.create(height=0.11, pitch=0.35)
    camera_file = CameraFile(Camera(K, 320, 240), mount, np.array(distortion), model, "wide")
    R, C = numpy_pose(camera_file, np.array([0.0, 2.0]), 1.5)
    image = Renderer(world_of("l"), camera_file, Imaging()).draw(R, C, 0.0)
    assert image.shape == (240, 320, 3) and image.std() > 5


def test_lsd_errs_on_drawn_images_as_on_the_sample_drive():
    """Within a factor of 1.5 of the sample's 1.2 cm and 0.28 degrees, medians within 5 m."""
    world, camera_file, simulated = world_of("l", 2), office_camera(), run_of("l", 2)
    renderer = Renderer(world, camera_file, Imaging())
    K = np.asarray(camera_file.camera.K, float)
    truth = world.floor_segments.endpoints[:, :, :2]
    rho, theta = [], []
    for i in range(0, len(simulated.truth.stamps), 6):
        R, C = numpy_pose(camera_file, simulated.truth.xy[i], simulated.truth.yaw[i])
        image = cv2.undistort(
            renderer.draw(R, C, simulated.truth.stamps[i]), K, camera_file.distortion
        )
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        lines = cv2.createLineSegmentDetector().detect(grey)[0].reshape(-1, 2, 2) + 0.125
        inverse = np.linalg.inv(K @ R.T @ np.column_stack([[1, 0, 0], [0, 1, 0], -C]))
        X = np.concatenate([lines, np.ones((len(lines), 2, 1))], axis=-1) @ inverse.T
        X = X[(X[..., 2] > 0.2).all(1)]  # both ends within a depth of 5 m
        found = X[..., :2] / X[..., 2:]
        d = truth[:, 1] - truth[:, 0]
        away = found.mean(1)[:, None] - truth[:, 0]
        share = ((away * d).sum(-1) / (d**2).sum(-1)).clip(0, 1)
        distance = np.linalg.norm(away - share[..., None] * d, axis=-1)
        e = found[:, 1] - found[:, 0]
        angle = np.arctan2(e[:, 1], e[:, 0])[:, None] - np.arctan2(d[:, 1], d[:, 0])
        angle = np.abs((angle + np.pi / 2) % np.pi - np.pi / 2)
        distance = np.where(angle < np.radians(5), distance, np.inf)
        right = distance.min(1) < 0.1
        rho += list(distance.min(1)[right])
        theta += list(np.take_along_axis(angle, distance.argmin(1)[:, None], 1)[right, 0])
    assert 0.012 / 1.5 < np.median(rho) < 0.012 * 1.5
    assert 0.28 / 1.5 < np.degrees(np.median(theta)) < 0.28 * 1.5


# Segments without an image

CAMERA = Camera(jnp.array([[291.0, 0.0, 159.5], [0.0, 291.0, 119.5], [0.0, 0.0, 1.0]]), 320, 240)
EXACT = Detection(
    noise=0.0, shortening=0.0, missed=0.0, min_contrast=0.0, full_contrast=1e-6, broken=0.0,
    false_segments=0.0, shortest=3.0, max_depth=8.0,
)  # fmt: skip


FRAMES, DRIVES, CAPACITY = 5, 40, 24  # of all tests, so that little is compiled
look = jax.jit(lambda *arguments: observe(*arguments, CAPACITY))
look_many = jax.jit(
    jax.vmap(
        lambda *arguments: observe(*arguments, CAPACITY), in_axes=(None, None, 0, 0, 0, 0, None)
    )
)


def scene_of(name, seed=0):
    return Scene.of(world_of(name, seed), edges=768, walls=16)


def without_width(scene):
    """Its fine lines seen as one line each, in their middle."""
    return dataclasses.replace(scene, width=jnp.zeros_like(scene.width))


def seen_exactly(name, seed, frames):
    simulated = run_of(name, seed)
    poses = jax.tree.map(lambda leaf: leaf[jnp.asarray(frames)], simulated.poses())
    mounts = jax.tree.map(lambda leaf: leaf[jnp.asarray(frames)], simulated.mounts)
    key = jax.random.key(0)
    return simulated, look(
        without_width(scene_of(name, seed)), CAMERA, mounts, poses, poses, key, EXACT
    )


@pytest.mark.parametrize(("name", "seed"), [("l", 2), ("eight", 0), ("random", 3)])
def test_exact_segments_are_visible_parts_of_the_worlds_edges(name, seed):
    frames = list(range(10, 250, 50))
    world = world_of(name, seed)
    simulated, observed = seen_exactly(name, seed, frames)
    camera_file = CameraFile(CAMERA, webcam().mount, np.zeros(5), "plumb_bob", "")
    edges = [world.floor_segments, world.off_floor_segments, world.reflections]
    ends = np.concatenate([kind.endpoints for kind in edges])
    for row, i in enumerate(frames):
        R, C = numpy_pose(camera_file, simulated.truth.xy[i], simulated.truth.yaw[i])
        segments = np.asarray(observed.segments_image.endpoints[row], float)
        valid = np.asarray(observed.segments_image.valid[row])
        assert valid.sum() > 3
        points = ends[:, :1] + np.linspace(0, 1, 401)[:, None] * (ends[:, 1:] - ends[:, :1])
        x, depth = project(camera_file, R, C, points.reshape(-1, 3))
        truncated = depth < 0.05
        for segment in segments[valid]:
            assert (segment > -0.1).all() and (segment < [319.1, 239.1]).all()
            middle = segment.mean(0)
            # the line of the nearest sampled edge passes through both ends
            gap = np.where(truncated, np.inf, np.linalg.norm(x - middle, axis=1))
            candidates = np.unique(np.argsort(gap)[:40] // 401)
            errors = []
            for edge in candidates:
                a = points[edge][depth.reshape(-1, 401)[edge] > 0.05][[0, -1]]
                (p, q), _ = project(camera_file, R, C, a)
                normal = np.array([p[1] - q[1], q[0] - p[0]]) / (np.linalg.norm(q - p) + 1e-12)
                errors.append(np.abs((segment - p) @ normal).max())
            assert min(errors) < 0.1


def test_segments_end_where_a_wall_hides_the_rest():
    """From the stem of the L the floor behind the inner corner cannot be seen."""
    world = world_of("l", 2)
    scene = without_width(scene_of("l", 2))
    floor_alone = jnp.where(scene.on_floor, scene.contrast, 0)
    scene = dataclasses.replace(scene, contrast=floor_alone)
    pose = SE2(jnp.tile(jnp.array([0.0, 5.0]), (FRAMES, 1)), jnp.full(FRAMES, 1.2))
    mount = Mount.create(1.0, 0.2, x=0.1)
    mounts = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (FRAMES,)), mount)
    observed = look(scene, CAMERA, mounts, pose, pose, jax.random.key(0), EXACT)
    camera_file = CameraFile(CAMERA, Mount.create(1.0, 0.2, x=0.1), np.zeros(5), "plumb_bob", "")
    R, C = numpy_pose(camera_file, [0.0, 5.0], 1.2)
    H_F = np.asarray(CAMERA.K, float) @ R.T @ np.column_stack([[1, 0, 0], [0, 1, 0], -C])
    for segment in np.asarray(observed.segments_image.endpoints[0], float)[
        np.asarray(observed.segments_image.valid[0])
    ]:
        X = np.column_stack([segment, np.ones(2)]) @ np.linalg.inv(H_F).T
        floor = X[:, :2] / X[:, 2:]
        floor = floor + 0.02 * (floor[::-1] - floor)  # the very end lies on the shadow's edge
        assert not behind_a_wall(world, C[:2], floor, margin=0.1).any()
    assert observed.segments_image.valid.sum() > 5


def test_the_longest_segments_fit_and_the_rest_is_counted():
    _, observed = seen_exactly("l", 2, list(range(0, 100, 20)))
    segments = observed.segments_image
    assert segments.endpoints.shape == (FRAMES, CAPACITY, 2, 2)
    assert observed.motion.yaw.shape == observed.overflow.shape == (FRAMES,)
    found, overflow = np.asarray(segments.valid).sum(1), np.asarray(observed.overflow)
    assert (overflow > 0).any() and (found[overflow > 0] == CAPACITY).all()
    assert (np.diff(np.where(segments.valid, segments.length, 0), axis=1) < 1e-3).all()
    assert np.isfinite(np.asarray(segments.endpoints)).all()


def forty_drives():
    """Stretches of one simulated run, each as if it were a drive."""
    simulated = run_of("paper")
    starts = jnp.arange(100, 1100, 25)[:, None] + jnp.arange(FRAMES)[None]
    poses, mounts = (
        jax.tree.map(lambda leaf: leaf[starts], tree)
        for tree in (simulated.poses(), simulated.mounts)
    )
    return mounts, poses, poses, jax.random.split(jax.random.key(0), DRIVES)


def test_a_batch_of_drives_sees_what_each_drive_sees():
    scene, drives, detection = scene_of("paper"), forty_drives(), Detection()
    batch = look_many(scene, CAMERA, *drives, detection).segments_image
    for i in (0, 7, 39):
        mine = jax.tree.map(lambda leaf, i=i: leaf[i], drives)
        alone = look(scene, CAMERA, *mine, detection).segments_image
        np.testing.assert_array_equal(alone.valid, batch.valid[i])
        np.testing.assert_allclose(alone.endpoints, batch.endpoints[i], atol=0.02)


def test_misses_and_inventions_are_as_many_as_asked():
    scene, drives = scene_of("paper"), forty_drives()

    def count(**changes):
        detection = dataclasses.replace(EXACT, **changes)
        observed = look_many(scene, CAMERA, *drives, detection)
        return float(observed.segments_image.valid.sum() + observed.overflow.sum()) / (
            DRIVES * FRAMES
        )

    all_of_them = count()
    assert count(missed=0.5) == pytest.approx(all_of_them / 2, rel=0.1)
    assert count(false_segments=3.0) - all_of_them == pytest.approx(3, abs=0.6)
    assert count(broken=1.0) > 1.5 * all_of_them


def one_line(y, width, contrast=0.3, length=0.4):
    """A scene of one line of some width across the way, y metres ahead of the first corner."""
    ends = np.zeros((768, 2, 3), np.float32)
    ends[0] = [[-length, y, 0], [length, y, 0]]
    of_first = lambda value: jnp.zeros(768).at[0].set(value)
    return Scene(
        jnp.asarray(ends), of_first(contrast), of_first(1) > 0, of_first(width),
        jnp.zeros((16, 2, 2)),
    )  # fmt: skip


def edges_of_line(scene, detection=EXACT):
    """Segments of the first image, from 1 m above the origin, looking along y and down by 0.2."""
    pose = SE2(jnp.zeros((FRAMES, 2)), jnp.full(FRAMES, jnp.pi / 2))
    mount = Mount.create(1.0, 0.2)
    mounts = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (FRAMES,)), mount)
    seen = look(scene, CAMERA, mounts, pose, pose, jax.random.key(0), detection).segments_image
    return np.asarray(seen.endpoints[0])[np.asarray(seen.valid[0])]


def rows_of(*ys):
    """Where floor points ahead project, by the mount of `edges_of_line`: image rows and depths."""
    y = np.array(ys)
    depth = y * np.cos(0.2) + np.sin(0.2)
    return 119.5 + 291 * (np.cos(0.2) - y * np.sin(0.2)) / depth, depth


def test_a_broad_line_is_seen_where_its_edges_are():
    ends = edges_of_line(one_line(2.0, 0.1), dataclasses.replace(EXACT, blur=1.0))
    far, near = rows_of(2.05, 1.95)[0]
    assert near - far > 6
    np.testing.assert_allclose(np.sort(ends[:, :, 1].mean(1)), [far, near], atol=0.15)
    assert ((ends[0, 1] - ends[0, 0]) @ (ends[1, 1] - ends[1, 0])) < 0  # darker on one hand


@pytest.mark.parametrize(("y", "width"), [(2.0, 0.002), (4.0, 0.004), (6.0, 0.01)])
def test_a_fine_lines_edges_are_never_nearer_than_the_blur_leaves_them(y, width):
    """Fields of a Gaussian's slope, by sums: the middle of what is left on either side."""
    blur = 1.2
    ends = edges_of_line(one_line(y, width), dataclasses.replace(EXACT, blur=blur))
    w = -np.diff(rows_of(y - width / 2, y + width / 2)[0])[0]
    x = np.linspace(0, 12, 12001)
    left = np.exp(-((x - w / 2) ** 2) / (2 * blur**2)) - np.exp(-((x + w / 2) ** 2) / (2 * blur**2))
    apart = 2 * (x * left).sum() / left.sum()
    rows = np.sort(ends[:, :, 1].mean(1))
    assert rows[1] - rows[0] == pytest.approx(apart, abs=0.02)
    assert rows[1] - rows[0] > max(2.5 * blur, w)
    assert rows.mean() == pytest.approx(rows_of(y)[0][0], abs=0.02)


def test_a_fine_line_fades_with_distance_and_a_step_does_not():
    def seen_from(width):
        detection = dataclasses.replace(EXACT, min_contrast=0.05, full_contrast=0.05001, blur=1.0)
        ys = np.arange(1.5, 7.0, 0.25)
        return ys, np.array([len(edges_of_line(one_line(y, width), detection)) for y in ys])

    ys, counts = seen_from(0.01)
    rows = np.array([-np.diff(rows_of(y - 0.005, y + 0.005)[0])[0] for y in ys])
    left = np.array([math.erf(w / 8**0.5) for w in rows])
    assert (counts[0.3 * left > 0.052] == 2).all() and (counts[0.3 * left < 0.048] == 0).all()
    assert 3 < (counts > 0).sum() < len(ys) - 3
    assert (seen_from(0.0)[1] == 1).all()


def test_a_fine_line_that_runs_away_ends_where_it_fades_and_its_edges_converge():
    scene = one_line(2.0, 0.008)
    ends = scene.edges_world.at[0].set(jnp.array([[0.3, 1.0, 0.0], [0.3, 9.0, 0.0]]))
    scene = dataclasses.replace(scene, edges_world=ends)
    detection = dataclasses.replace(EXACT, min_contrast=0.05, full_contrast=0.05001, blur=1.0)
    found = edges_of_line(scene, detection)
    assert len(found) == 2
    found = found[np.arange(2)[:, None], np.argsort(-found[:, :, 1], axis=1)]  # near end first
    near, far = np.linalg.norm(found[0] - found[1], axis=-1)
    assert near > far > 2.5
    as_far_as_it_runs = rows_of(7.9)[0][0]  # 8 metres of depth
    assert found[:, 1, 1].min() > as_far_as_it_runs + 1


def test_a_joint_of_a_world_comes_as_its_two_edges_by_chance():
    scene = scene_of("l", 2)
    scene = dataclasses.replace(scene, contrast=jnp.where(scene.width > 0, scene.contrast, 0))
    pose = SE2(jnp.tile(jnp.array([0.0, 3.0]), (FRAMES, 1)), jnp.full(FRAMES, 1.5))
    mounts = jax.tree.map(lambda leaf: leaf[0], forty_drives()[0])

    def count(**changes):
        detection = dataclasses.replace(EXACT, min_contrast=0.03, full_contrast=0.1, **changes)
        observed = look(scene, CAMERA, mounts, pose, pose, jax.random.key(0), detection)
        return int(observed.segments_image.valid.sum())

    assert "grout" in world_of("l", 2).floor_segments.kinds
    assert count(missed=1.0) == 0 < count(missed=0.6) < count(blur=2.0) < count()


def test_scratch_memory_does_not_grow_with_the_images():
    """Of a hundred drives it stays far below 4 GiB."""
    compiled = look_many.lower(scene_of("paper"), CAMERA, *forty_drives(), EXACT).compile()
    assert compiled.memory_analysis().temp_size_in_bytes / DRIVES < 10 * 2**20


def test_a_world_with_more_edges_than_room_is_refused():
    with pytest.raises(ValueError, match="room for 8"):
        Scene.of(world_of("l"), edges=8)


@pytest.mark.slow
def test_a_hundred_drives_take_seconds():
    drives, images = 100, 300
    scene, simulated = scene_of("paper"), run_of("paper")

    def batch(tree):
        return jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf[:images], (drives, images, *leaf.shape[1:])), tree
        )

    def one(mounts, poses, key):
        return observe(scene, CAMERA, mounts, poses, poses, key)

    keys = jax.random.split(jax.random.key(0), drives)
    see = (
        jax.jit(jax.vmap(one))
        .lower(batch(simulated.mounts), batch(simulated.poses()), keys)
        .compile()
    )
    begun = time.perf_counter()
    jax.block_until_ready(see(batch(simulated.mounts), batch(simulated.poses()), keys))
    assert time.perf_counter() - begun < 10
    memory = see.memory_analysis()
    assert memory.temp_size_in_bytes + memory.output_size_in_bytes < 4 * 2**30


# Drive folders


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("drives") / "short"
    setup = RobotSetup(camera_file=office_camera())
    simulated = simulate_run(world_of("l", 2), setup, 2, max_images=12)
    record(path, world_of("l", 2), setup, simulated, seed=2)
    return path, simulated


def test_a_recorded_drive_reads_back(recorded):
    path, simulated = recorded
    drive = read_drive(path)
    assert len(drive.image_files) == 12 and all(file.exists() for file in drive.image_files)
    np.testing.assert_allclose(drive.groundtruth.xy, simulated.truth.xy, atol=1e-6)
    np.testing.assert_allclose(drive.camera_file.distortion, office_camera().distortion)
    expected = world_of("l", 2).floor_segments.endpoints[:, :, :2]
    np.testing.assert_allclose(drive.floor_segments, expected, atol=5.1e-5)
    assert not [file for file in path.parent.iterdir() if file.name.startswith(".")]


def test_the_written_odometry_gives_the_motions_that_observe_takes(recorded):
    path, simulated = recorded
    written, given = motions(read_drive(path)), simulated.motions()
    np.testing.assert_allclose(written[:, :2], given.xy, atol=1e-4)
    np.testing.assert_allclose(written[:, 2], given.yaw, atol=1e-4)


def test_simulate_writes_a_drive(tmp_path, capsys):
    out = tmp_path / "drive"
    args = ["--world", "random", "--seed", "3", "--images", "4", "--height", "0.8", "--pitch", "15"]
    assert main(["simulate", *args, "--out", str(out)]) == 0
    mount = read_drive(out).camera_file.mount
    assert float(mount.height) == pytest.approx(0.8)
    assert float(mount.pitch) == pytest.approx(np.radians(15), rel=1e-5)
    assert "4 images" in capsys.readouterr().out


def test_random_rigs_differ():
    heights = {round(float(random_setup(seed).camera_file.mount.height), 3) for seed in range(5)}
    assert len(heights) == 5


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--world", "papr"], "did you mean 'paper'"),
        (["--world", "l", "--way", "0,0 0,9 20,9"], "goes through a wall at (9.0"),
        (["--way", "0,1 0,1.01"], "within 0.1 m"),
        (["--way", "0,1 x"], "must be numbers"),
        (["--way", "0.9,1 0.9,9"], "of a wall"),
        (["--height", "5"], "above the ceiling"),
        (["--height", "0"], "under the floor"),
        (["--pitch", "-80"], "sees no floor"),
        (["--x", "3"], "camera goes through a wall"),
        (["--x", "nan"], "no place for a camera"),
        (["--noise", "-1"], "noise is -1"),
        (["--blur", "inf"], "blur is inf"),
        (["--vibration", "-1"], "vibration"),
        (["--dropped", "1"], "dropped"),
        (["--speed", "0"], "speed"),
        (["--odometer", "slip=-1"], "slips per metre is -1"),
        (["--odometer", "rigth=1"], "did you mean 'right'"),
        (["--odometer", "right=one"], "must be numbers"),
        (["--size", "big"], "like 640x480"),
        (["--focal", "1"], "--focal"),
        (["--distortion", "1", "2"], "--distortion"),
        (["--world", "l", "--distortion", "-0.9", "0", "0", "0"], "folds the image"),
        (["--images", "1"], "2 at least"),
        (["--seed", "-1"], "--seed"),
    ],
)
def test_what_cannot_be_simulated_gets_a_sentence(arguments, sentence, tmp_path, capsys):
    out = tmp_path / "drive"
    assert main(["simulate", *arguments, "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.startswith("sofjax: ") and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_folder_with_something_in_it_is_left_alone(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["simulate", "--world", "l", "--images", "3", "--out", str(tmp_path)]) == 2
    assert "there already" in capsys.readouterr().err
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_increments_of_a_path_begin_with_none():
    steps = increments(run_of("l").truth)
    assert float(steps.xy[0, 0]) == 0 and float(steps.yaw[0]) == 0
    pairs = itertools.islice(zip(run_of("l").truth.yaw[1:], run_of("l").truth.yaw, strict=False), 5)
    np.testing.assert_allclose([a - b for a, b in pairs], steps.yaw[1:6], atol=1e-6)


@pytest.mark.slow
def test_the_demo_ends_with_a_page(tmp_path, capsys):
    folder = tmp_path / "demo"
    assert main(["demo", "--world", "l", "--out", str(folder)]) == 0
    page = (folder / "index.html").read_text()
    for source in re.findall(r'src="([^"]+)"', page):
        assert (folder / source).stat().st_size > 1000
    assert "odometer alone" in page and "[3/3]" in capsys.readouterr().out


def test_the_demo_refuses_an_unknown_world(tmp_path, capsys):
    assert main(["demo", "--world", "maze", "--out", str(tmp_path / "demo")]) == 2
    assert "there is no world 'maze'" in capsys.readouterr().err
