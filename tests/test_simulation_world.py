"""Plans, worlds and robots of the simulator."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from simulated import SAMPLES, run_of, world_of

from sofjax.geometry import SE2
from sofjax.simulation import (
    Driver,
    Odometer,
    RobotSetup,
    make_world,
    simulate_run,
)
from sofjax.simulation.robot import clearance, drive_along, read_path
from sofjax.simulation.world.floors import BLOCK_SPACING, BLOCK_WIDTH
from sofjax.simulation.world.plan import inside, offset_walls, parts_inside, union_walls


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
