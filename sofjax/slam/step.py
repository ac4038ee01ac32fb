"""SoF-SLAM; Fig. 6 of the paper as one pure, jitted step."""

import jax
from jaxtyping import PRNGKeyArray

from sofjax.extraction.observation import Observation
from sofjax.slam.advance import advance
from sofjax.slam.choose import choose
from sofjax.slam.config import Setup
from sofjax.slam.consistency import doubt, through_unread
from sofjax.slam.extract import extract_sof
from sofjax.slam.fixed_lag import Mapped, with_fixed_lag
from sofjax.slam.map_update import update_map
from sofjax.slam.predict import predict
from sofjax.slam.reweight import local_map, reweight
from sofjax.slam.state import SlamState, StepInfo, initial_state


def one_round(
    setup: Setup, state: SlamState, observation: Observation
) -> tuple[SlamState, StepInfo, Mapped]:
    """One round of Fig. 6."""
    key, key_motion, key_slip, key_choice = jax.random.split(state.key, 4)
    # 1-3) move, and sample N particles by the motion model
    predicted = predict(setup, state, observation, key_motion, key_slip)
    # 4) put the segments on the floor, and extract SoF (Fig. 5) against a view a baseline away
    extracted = extract_sof(setup, state, observation, predicted)
    if setup.config.filter.doubting:
        predicted, extracted = doubt(setup, state, predicted, extracted)
    # 5) compare with the map by the sensor model, and choose
    local = local_map(setup, state.segment_map, extracted.measurements, predicted.T_world_robot)
    weighted = reweight(setup, predicted, extracted, local)
    chosen = choose(setup, predicted, extracted, local, weighted, key_choice)
    if setup.config.filter.doubting:
        extracted = through_unread(state, predicted, extracted, chosen.T_world_robot)
    # 6) integrate the observed segments into the map, as seen from the chosen pose
    updated = update_map(setup, state.segment_map, extracted, local, chosen)
    # 7) the next round starts from here
    after, info = advance(setup, state, extracted, local, weighted, chosen, updated, key)
    return after, info, Mapped(extracted.measurements, updated.new_slots)


class SofSlam(Setup):
    """SoF-SLAM for one camera on one robot: settings, camera and mount.

    Pure, and a pytree: `jax.vmap` runs it over seeds, settings, mounts and drives.
    """

    def init(self, key: PRNGKeyArray, capacity: int) -> SlamState:
        """The state before the first image, all particles at the origin of the world.

        **Arguments:**
        - `key`: a typed key, `jax.random.key(0)`.
        - `capacity`: M, the number of segments that an observation has room for.
        """
        return initial_state(self, key, capacity)

    @jax.jit
    def step(self, state: SlamState, observation: Observation) -> tuple[SlamState, StepInfo]:
        """One image; compiled once for all images of one capacity."""
        return with_fixed_lag(one_round)(self, state, observation)

    @jax.jit
    def run(self, state: SlamState, observations: Observation) -> tuple[SlamState, StepInfo]:
        """A whole log as one scan: the same as `step` for one image after the other.

        With `config.filter.soft` the sum of `info.log_evidence` is the log-evidence of the drive,
        a density whose constants are all there, with derivatives by the settings of motion and
        sensor, by the mount, and with `gate_each` by alpha, beta, Theta and its temperature in
        eq. (9). Going back keeps one state a step and computes the rest again.

        Which derivatives are right: with the random numbers fixed, and as long as none is
        resampled, it is that of the function to the last digit. What resampling owes to the
        weights is credited (`Particles.take`), so that for a given map the derivative of the
        evidence is unbiased and that of its logarithm off by 1/N, at the price of noise: use the
        mean of several keys. It is biased by how the map's decisions depend on the settings (what
        is initialised, known, merged, off the floor or forgotten; when the variance inflates) and
        by the paper's choice "winner". By `e_max`, and by whatever else only decides, it is zero.

        **Arguments:**
        - `observations`: leaves with a leading axis T.

        **Returns:** the last state, and the infos with a leading axis T.
        """
        one = lambda state, observation: self.step(state, observation)
        one = jax.checkpoint(one, prevent_cse=False)  # True gave wrong gradients under jit
        return jax.lax.scan(one, state, observations)
