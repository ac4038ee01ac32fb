"""Settings of the method, and what stays the same over a drive."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp

from sofjax._checks import check_fields
from sofjax.extraction.association import Association
from sofjax.geometry.camera import Camera, Mount
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.motion import MotionModel
from sofjax.segment_map import MapConfig

FILTER_CHOICES = ("resample", "winner")
LENGTHS = ("heights", "metres")
RESOLVING = 260.0  # pixels, the focal length at which ranges are as the settings have them


class FilterConfig(eqx.Module):
    """How many particles, and how the next generation is chosen."""

    particles: int = eqx.field(static=True, default=1000)  # N, number of particles
    choice: str = eqx.field(static=True, default="resample")  # or "winner", as in the paper
    effective_share: float = 0.5  # resampled below this effective size, a share of N
    gate_each: bool = eqx.field(
        static=True, default=False
    )  # Fig. 6, step 4: SoF for every particle
    soft: bool = eqx.field(static=True, default=False)  # for derivatives; see `SofSlam.run`
    doubts: bool = eqx.field(
        static=True, default=True
    )  # images that contradict the odometer are not used; never with `soft`
    max_depth: float = 8.0  # camera heights: farther segments are not used

    def __check_init__(self) -> None:
        check_fields(
            self,
            choices={"choice": FILTER_CHOICES},
            whole_from={"particles": 1},
            at_least_zero=("effective_share",),
            positive=("max_depth",),
        )

    @property
    def doubting(self) -> bool:
        """Whether images are compared with the odometer's reading; a density has no such choice."""
        return self.doubts and not self.soft


class FixedLagConfig(eqx.Module):
    """How many keyframes stay open while driving."""

    keyframes: int = eqx.field(static=True, default=0)  # W, open keyframes; 0: no window
    lines: int = eqx.field(static=True, default=128)  # J, nearest map lines, solved for too
    step: float = 0.2  # camera heights between keyframes, or ...
    turn: float = 0.15  # ... radians, whichever comes first

    def __check_init__(self) -> None:
        check_fields(self, whole_from={"keyframes": 0, "lines": 1}, at_least_zero=("step", "turn"))


class SlamConfig(eqx.Module):
    """Every setting of the method, beside the part that reads it."""

    association: Association = Association()
    motion: MotionModel = MotionModel()
    sensor: SensorModel = SensorModel()
    segment_map: MapConfig = MapConfig()
    filter: FilterConfig = FilterConfig()
    window: FixedLagConfig = FixedLagConfig()
    lengths: str = eqx.field(static=True, default="heights")  # or "metres", as in the paper

    def __check_init__(self) -> None:
        check_fields(self, choices={"lengths": LENGTHS})

    def in_metres(self, camera: Camera, mount: Mount) -> "SlamConfig":
        """The settings with their lengths in metres, for one camera; those settings themselves if
        they are so already.

        A length is so many camera heights: a robot half as high sees the same images half as far
        away. At a range of r heights a pixel is (r² + 1) / f heights of floor: a range is where
        that is as much as with a focal length f of `RESOLVING` at the range of the settings.
        """
        if self.lengths == "metres":
            return self
        h, f = mount.height, jnp.sqrt(camera.K[..., 0, 0] * camera.K[..., 1, 1])
        far = lambda r: h * jnp.sqrt(jnp.maximum((r**2 + 1) * f / RESOLVING - 1, 1))
        s, m = self, self.segment_map
        s = eqx.tree_at(
            lambda s: (
                s.association.baseline_distance, s.filter.max_depth, s.window.step,
                s.segment_map.range, s.segment_map.length, s.segment_map.merge_distance,
                s.segment_map.join_gap, s.segment_map.rho_drift,
            ),
            s,
            (
                h * s.association.baseline_distance, far(s.filter.max_depth), h * s.window.step,
                far(m.range), 2 * far(m.length / 2), h * m.merge_distance,
                h * m.join_gap, h * m.rho_drift,
            ),
        )  # fmt: skip
        return dataclasses.replace(s, lengths="metres")


class Setup(eqx.Module):
    """What stays the same over a drive: the settings, the camera and where it is mounted.

    The lengths of its settings are in metres, whatever those were that it was made of.
    """

    config: SlamConfig
    camera: Camera
    mount: Mount

    def __init__(self, config: SlamConfig, camera: Camera, mount: Mount) -> None:
        arguments: dict[str, tuple[object, type]] = {
            "config": (config, SlamConfig), "camera": (camera, Camera), "mount": (mount, Mount),
        }  # fmt: skip
        for name, (given, kind) in arguments.items():
            if not isinstance(given, kind):
                raise ValueError(
                    f"{type(self).__name__}(config, camera, mount): {name} must be a "
                    f"{kind.__name__}, not a {type(given).__name__}"
                )
        self.config, self.camera, self.mount = config.in_metres(camera, mount), camera, mount
