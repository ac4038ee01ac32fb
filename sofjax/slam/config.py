"""Settings of the method, and what stays the same over a drive."""

import equinox as eqx

from sofjax._checks import check_fields
from sofjax.extraction.association import Association
from sofjax.geometry.camera import Camera, Mount
from sofjax.likelihood.sensor_model import SensorModel
from sofjax.motion import MotionModel
from sofjax.segment_map import MapConfig

FILTER_CHOICES = ("resample", "winner")


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
    max_depth: float = 8.0  # metres: farther segments are not used

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
    step: float = 0.2  # metres between keyframes, or ...
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


class Setup(eqx.Module):
    """What stays the same over a drive: the settings, the camera and where it is mounted."""

    config: SlamConfig
    camera: Camera
    mount: Mount

    def __check_init__(self) -> None:
        for name, kind in (("config", SlamConfig), ("camera", Camera), ("mount", Mount)):
            given = getattr(self, name)
            if not isinstance(given, kind):
                raise ValueError(
                    f"{type(self).__name__}(config, camera, mount): {name} must be a "
                    f"{kind.__name__}, not a {type(given).__name__}"
                )
