"""The map: its settings, and what is kept of each line."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sofjax._checks import check_fields
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments

MAP_RULES = ("kalman", "gamma")


class MapConfig(eqx.Module):
    """How the map grows; the paper's R and L, and what goes past it."""

    rule: str = eqx.field(static=True, default="kalman")  # or "gamma", eq. (14)
    classify: bool = eqx.field(
        static=True, default=True
    )  # estimate the apparent scale, tell floor from off-floor
    directed: bool = eqx.field(static=True, default=False)  # tell a line's edges apart
    capacity: int = eqx.field(static=True, default=1024)  # K, lines that the map has room for
    nearby: int = eqx.field(static=True, default=384)  # map lines that an image may show, at most
    candidates: int = eqx.field(static=True, default=4)  # C, map lines compared per measurement
    range: float = 5.0  # R, camera heights: what is farther does not extend a segment
    length: float = 10.0  # L = 2 R, camera heights: a longer segment rests
    rest: int = 10  # steps that a longer segment rests
    merge_distance: float = 0.01  # camera heights between doubled lines
    merge_angle: float = 0.035  # radians
    join_gap: float = 0.3  # camera heights between two pieces of one line
    scale_sigma: float = 0.3  # prior of a line that does not lie on the floor
    scale_above: float = 1.04  # an apparent scale between these two is taken for floor: nothing ...
    scale_below: float = 0.7  # ... lies little under a floor, and reflections lie deep
    scale_gate: float = 3.0  # standard deviations from 1 that tell a line from the floor
    scale_held: float = 0.03  # its standard deviation up to which a floor line is held at 1, ...
    scale_known: float = 0.05  # ... and below which a line may be one of the final map
    rho_drift: float = 0.002  # camera heights: no map line is known better than ...
    theta_drift: float = 0.002  # ... this, radians
    recall: int = 1_000_000  # steps unseen after which a line is not looked for any more
    forget: int = 50  # steps unseen after which a line of few measurements is dropped
    min_updates: int = 5  # measurements that make a line one of the final map, ...
    min_share: float = 0.25  # ... and their share of the images in which it should have been seen

    def __check_init__(self) -> None:
        check_fields(
            self,
            choices={"rule": MAP_RULES},
            whole_from={"capacity": 1, "nearby": 1, "candidates": 1},
            positive=("range", "length", "scale_sigma", "scale_above", "scale_below"),
            at_least_zero=(
                "rest", "merge_distance", "merge_angle", "join_gap", "scale_gate", "scale_held",
                "scale_known", "rho_drift", "theta_drift", "recall", "forget", "min_updates",
                "min_share",
            ),
        )  # fmt: skip


class SegmentMap(eqx.Module):
    """K slots for map segments."""

    segments_world: Segments  # [K], metres
    anchor: SE2  # [K] T_world_nadir of the first measurement
    line: Float[Array, "K 3"]  # (rho, theta, apparent scale) in the anchor
    covariance: Float[Array, "K 3 3"]
    updates: Int[Array, "K"]  # delta of eq. (14)
    resting: Int[Array, "K"]  # steps left
    unseen: Int[Array, "K"]  # steps since the last measurement
    expected: Int[Array, "K"]  # images in which its middle was in view

    @property
    def valid(self) -> Bool[Array, "K"]:
        return self.segments_world.valid

    def take(self, slots: Int[Array, "L"]) -> "SegmentMap":
        """A map of these slots; K stands for none."""
        there = slots < self.updates.shape[0]
        some = jax.tree.map(lambda a: a.at[slots].get(mode="clip"), self)
        return eqx.tree_at(lambda m: m.segments_world.valid, some, some.valid & there)

    def put(self, slots: Int[Array, "L"], some: "SegmentMap") -> "SegmentMap":
        """The map with `some` back in the slots that they were taken from."""
        return jax.tree.map(lambda a, b: a.at[slots].set(b, mode="drop"), self, some)


def empty_map(config: MapConfig) -> SegmentMap:
    """A map of `config.capacity` empty slots."""
    K = config.capacity
    return SegmentMap(
        segments_world=Segments(jnp.zeros((K, 2, 2)), jnp.zeros(K, bool)),
        anchor=SE2(jnp.zeros((K, 2)), jnp.zeros(K)),
        line=jnp.zeros((K, 3)).at[:, 2].set(1),
        covariance=jnp.broadcast_to(jnp.eye(3), (K, 3, 3)),
        updates=jnp.zeros(K, int),
        resting=jnp.zeros(K, int),
        unseen=jnp.zeros(K, int),
        expected=jnp.zeros(K, int),
    )
