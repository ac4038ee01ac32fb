"""Segments of a simulated world without an image: what is visible, and how a detector errs."""

import dataclasses
import math
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from simulated import behind_a_wall, numpy_pose, project, run_of, world_of

from sofjax.geometry import SE2, Camera, Mount
from sofjax.io.camera_file import CameraFile
from sofjax.simulation import (
    Detection,
    Scene,
    observe,
    webcam,
)

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


def test_a_world_with_more_edges_than_the_capacity_is_refused():
    with pytest.raises(ValueError, match="capacity is 8"):
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
