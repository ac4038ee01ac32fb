"""Drawn images: edges lie where the truth says, and walls hide what is behind them."""

import dataclasses

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from simulated import behind_a_wall, numpy_pose, office_camera, project, run_of, world_of

from sofjax.geometry import Camera, Mount
from sofjax.io.camera_file import CameraFile
from sofjax.simulation import (
    Imaging,
    Renderer,
    webcam,
)
from sofjax.simulation.world.types import Areas

CLEAN = Imaging(noise=0.0, blur=0.55, exposure_time=0.0, hunting=0.0, vignetting=0.0)
NO_BOXES = {"boxes": np.zeros((0, 5)), "box_colours": np.zeros((0, 3))}
# Drawn images


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
