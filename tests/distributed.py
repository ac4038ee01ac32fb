"""One drive and one cloud on eight forced devices and on one; a program of its own.

The number of devices is settled when JAX starts: `test_distributed.py` runs this file.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_slam
from conftest import jit_quickly

from sofjax import LineNoise, SofSlam, log_likelihood, slam
from sofjax.geometry import SE2, Segments

T, N = 12, test_slam.N
AUTO = (jax.sharding.AxisType.Auto,)


def main():
    mesh = jax.make_mesh((8,), ("particles",), axis_types=AUTO)
    shared = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("particles"))
    copied = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        given = (test_slam.CAMERA, test_slam.MOUNT, test_slam.drive()[1])
        camera, mount, log = jax.tree.map(
            lambda a: a.astype(float) if a.dtype == "float32" else a, given
        )
        log = jax.tree.map(lambda a: a[:T], log)
        run = jit_quickly(SofSlam.run.__wrapped__)
        state = SofSlam(test_slam.CONFIG, camera, mount).init(jax.random.key(0), test_slam.M)
        here = run(SofSlam(test_slam.CONFIG, camera, mount), state, log)
        everywhere = jax.device_put((camera, mount), copied)
        there = run(
            SofSlam(test_slam.CONFIG, *everywhere),
            slam.shard(state, mesh),
            jax.device_put(log, copied),
        )
        assert there[0].particles.T_world_robot.xy.sharding.is_equivalent_to(shared, 2)
        assert there[1].matched[-1] > 3 and there[1].effective_size.min() < N / 2  # resampled
        for a, b in zip(test_slam.numbers(here), test_slam.numbers(there), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)

    three = jax.make_mesh((3,), ("particles",), axis_types=AUTO, devices=jax.devices()[:3])
    with pytest.raises(ValueError, match="64 particles cannot be shared alike by 3 devices"):
        slam.shard(test_slam.start(), three)

    rng = np.random.default_rng(0)
    middles = rng.uniform(-4, 4, size=(100, 1, 2))
    segments = jnp.asarray(middles + rng.uniform(-1, 1, size=(100, 2, 2)), "float32")
    segment_map = Segments(segments, jnp.ones(100, bool))
    observed = Segments(segments[:30], jnp.ones(30, bool))
    cloud = jnp.asarray(rng.normal(0, 0.05, size=(4096, 3)), "float32")
    particles = SE2(cloud[:, :2], cloud[:, 2])
    for soft in (False, True):
        arguments = (LineNoise(0.05, 0.03, 9.0),)
        here = log_likelihood(particles, observed, segment_map, *arguments, soft=soft)
        there = log_likelihood(
            jax.device_put(particles, shared),
            *jax.device_put((observed, segment_map), copied),
            *arguments,
            soft=soft,
        )
        assert there.sharding.is_equivalent_to(shared, 1) and np.ptp(np.asarray(here)) > 10
        np.testing.assert_allclose(here, there, rtol=1e-5, atol=1e-5)


if __name__ == "__main__":
    main()
