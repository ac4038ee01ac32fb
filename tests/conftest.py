"""Strict JAX for every test: no silent promotion of types, and float64 where a test asks for it."""

import functools
import gc
import os
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sofjax.geometry import Camera, Mount

jax.config.update("jax_numpy_dtype_promotion", "strict")

CACHE = "JAX_COMPILATION_CACHE_DIR"
CACHED_FROM = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"  # 1 by default, and most are shorter


def pytest_configure(config: pytest.Config) -> None:
    """All workers, and all that they start, compile a program once and read it after that."""
    if CACHE not in os.environ:
        folder = tempfile.TemporaryDirectory(prefix="sofjax-tests-", ignore_cleanup_errors=True)
        config.add_cleanup(folder.cleanup)
        os.environ |= {CACHE: folder.name, CACHED_FROM: "0"}
        jax.config.update(CACHE.lower(), folder.name)
        jax.config.update(CACHED_FROM.lower(), 0.0)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """All tests of a file in one worker: what they share is made and traced once."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)


@pytest.fixture
def x64():
    """The laws hold to many digits; in float32 they would hide in the rounding."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def rng():
    return np.random.default_rng(20240)


# for what runs once or twice: most of a test's time is the compiler's
jit_quickly = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
QUICK = {"XLA_FLAGS": "--xla_backend_optimization_level=0"}  # the same for a process


def as_float32(tree):
    return jax.tree.map(lambda a: a.astype("float32") if a.dtype == "float64" else a, tree)


def make_camera(focal=270.0):
    K = jnp.array([[focal, 0.0, 159.5], [0.0, focal, 119.5], [0.0, 0.0, 1.0]])
    return Camera(K, width=320, height=240)


@pytest.fixture
def camera():
    return make_camera()


@pytest.fixture
def mount():
    """A camera 60 cm over the floor, a little ahead of the axle and looking 15 degrees down."""
    return Mount.create(height=0.6, pitch=0.2618, x=0.05)


@pytest.fixture
def mounts(rng):
    """Mounts of every tilt and lever arm."""
    return [
        Mount.create(
            height=rng.uniform(0.1, 1.5),
            pitch=rng.uniform(-0.1, 0.7),
            x=rng.uniform(-0.4, 0.4),
            y=rng.uniform(-0.4, 0.4),
            roll=rng.uniform(-0.3, 0.3),
            yaw=rng.uniform(-3, 3),
        )
        for _ in range(8)
    ]


MAPS = 30_000  # of a process's memory: every compiled program takes some, and Linux allows 65,530


@pytest.fixture(autouse=True)
def room_for_programs():
    """A worker that has compiled hundreds of programs forgets them before it runs out of maps."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MAPS:
        jax.clear_caches()
        gc.collect()
