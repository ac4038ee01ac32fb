"""Particles: weights, effective size, and how the next generation is drawn; III.A."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sofjax.geometry.matrices import inverse_2x2
from sofjax.geometry.se2 import SE2
from sofjax.motion import OdometerBias


class Particles(eqx.Module):
    """N hypotheses of the robot's pose and of its odometer's errors."""

    T_world_robot: SE2  # [N]
    bias: OdometerBias  # mean [N, 4]
    log_weight: Float[Array, "N"]  # normalised: logsumexp = 0

    def take(self, index: Int[Array, "N"], credit: bool = False) -> "Particles":
        """The chosen particles, with equal weights.

        With `credit` these have the derivative of the log weights of the chosen, and through it
        the next evidence what the choice owes to the weights: w / stop_gradient(w), by which its
        derivative is right in the mean over the choices; Ścibior and Wood, Differentiable particle
        filtering without modifying the forward pass, 2021.
        """
        N = self.log_weight.shape[0]
        T = SE2(self.T_world_robot.xy[index], self.T_world_robot.yaw[index])
        bias = OdometerBias(self.bias.mean[index], self.bias.covariance)
        log_weight = jnp.full(N, -jnp.log(N), float)
        if credit:
            chosen = self.log_weight[index]
            log_weight += chosen - jax.lax.stop_gradient(chosen)
        return Particles(T, bias, log_weight)

    def moved_to(self, T_world_robot: SE2, bias: Float[Array, "4"]) -> "Particles":
        """All moved alike, so that their weighted means are this pose and these errors."""
        mean = mean_pose(self)
        xy = self.T_world_robot.xy + (T_world_robot.xy - mean.xy)
        yaw = self.T_world_robot.yaw + (T_world_robot.yaw - mean.yaw)
        each = self.bias.mean + (bias - mean_bias(self))
        return Particles(SE2(xy, yaw), OdometerBias(each, self.bias.covariance), self.log_weight)


def effective_size(log_weight: Float[Array, "N"]) -> Float[Array, ""]:
    """1 / sum w² of normalised weights: N if all are equal, 1 if one has everything."""
    return jnp.exp(-jax.nn.logsumexp(2 * log_weight))


def systematic(offset: Float[Array, ""], log_weight: Float[Array, "N"]) -> Int[Array, "N"]:
    """Indices drawn by systematic resampling, with N equally spaced offsets.

    **Arguments:**
    - `offset`: where the first stands, a uniform number of [0, 1).
    """
    N = log_weight.shape[0]
    cumulative = jnp.cumsum(jnp.exp(log_weight))
    offsets_up_to = jnp.ceil(N * cumulative / cumulative[-1] - offset).astype(int)
    return jnp.repeat(jnp.arange(N), jnp.diff(offsets_up_to, prepend=0), total_repeat_length=N)


def resample_observable(
    offsets: Float[Array, "2"],
    particles: Particles,
    T_tried: SE2,
    log_likelihood: Float[Array, "N"],
    free: Float[Array, ""],
) -> Particles:
    """The next generation, by a likelihood that says nothing of where along a direction one is.

    Drawn as a whole, after some time all particles would have the place along it and the odometer's
    scale of one ancestor, by chance, and be sure of them. So each takes of a drawn one what was
    seen, the place across and the yaw, and keeps its own of what was not. The errors in turning
    follow by regression on what is taken, as the yaw is what they are learned by.

    **Arguments:**
    - `offsets`: uniform numbers of [0, 1), to draw what was not seen and what was.
    - `T_tried`: [N] the poses that were compared: those of the particles and what these were tried
      with besides, such as a slip of the wheels. Of that too only what was seen is taken.
    - `free`: the direction, radians in the world.

    **Returns:** particles of equal weights.
    """
    own = systematic(offsets[0], particles.log_weight)  # all, each once, if their weights are equal
    log_seen = log_likelihood[own]
    seen = own[systematic(offsets[1], log_seen - jax.nn.logsumexp(log_seen))]
    particles = particles.take(own)

    middle = mean_pose(particles)
    turned = SE2(jnp.zeros(2), free)
    local = lambda T: (turned.inverse().apply(T.xy - middle.xy), T.yaw - middle.yaw)
    (xy, yaw), (tried_xy, tried_yaw) = map(
        local, (particles.T_world_robot, jax.tree.map(lambda a: a[seen], T_tried))
    )
    before = jnp.stack([xy[:, 1], yaw], axis=1)
    after = jnp.stack([tried_xy[:, 1], tried_yaw], axis=1)
    b = particles.bias.mean
    tiny = 1e-12 * jnp.eye(2)  # for a cloud in one point
    by_seen = inverse_2x2(before.T @ before + tiny) @ (before.T @ (b - b.mean(axis=0)))
    by_seen = by_seen.at[:, 0].set(0)  # scale and yaw go together by chance, which would add up
    xy = middle.xy + turned.apply(jnp.stack([xy[:, 0], tried_xy[:, 1]], axis=1))
    return Particles(
        SE2(xy, middle.yaw + tried_yaw),
        OdometerBias(b + (after - before) @ by_seen, particles.bias.covariance),
        particles.log_weight,
    )


def most_likely(log_weight: Float[Array, "N"]) -> Int[Array, "N"]:
    """The paper's choice: the single most likely particle, N times."""
    return jnp.full(log_weight.shape, jnp.argmax(log_weight))


def mean_pose(particles: Particles) -> SE2:
    """Weighted mean; of the yaw too, which is not wrapped and so has no jump within the cloud."""
    w = jnp.exp(particles.log_weight)
    return SE2(w @ particles.T_world_robot.xy, w @ particles.T_world_robot.yaw)


def mean_bias(particles: Particles) -> Float[Array, "4"]:
    """Weighted mean of the odometer's systematic errors."""
    return jnp.exp(particles.log_weight) @ particles.bias.mean


def pose_covariance(particles: Particles) -> Float[Array, "3 3"]:
    """Weighted covariance of (x, y, yaw), metres and radians.

    It is that of the pose in the map, which all particles share: what the map is wrong by is not
    in it.
    """
    mean, T = mean_pose(particles), particles.T_world_robot
    d = jnp.stack([T.xy[:, 0] - mean.xy[0], T.xy[:, 1] - mean.xy[1], T.yaw - mean.yaw])
    w = jnp.exp(particles.log_weight)  # last, as products of thin matrices are slow in batches
    return d[:, None] * d @ w
