"""The likelihood of poses in the state of a running filter."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sofjax.geometry.angles import wrap
from sofjax.geometry.se2 import SE2
from sofjax.geometry.segments import Segments
from sofjax.likelihood.batch.arguments import check_poses, check_segments, check_type
from sofjax.likelihood.measurements import measure
from sofjax.likelihood.tracking import pixels_and_weight
from sofjax.slam.config import Setup
from sofjax.slam.reweight import hard_log_likelihood, local_map
from sofjax.slam.state import SlamState


def pose_log_likelihood(
    slam: Setup, state: SlamState, segments_image: Segments, T_world_robot: SE2
) -> Float[Array, "*poses"]:
    """log L of one pose or of many, as a step of the filter would weight them; III.A.

    The candidate lines are taken about the mean of the poses, as a step takes them about the mean
    of its particles: right for poses of one cloud, some decimetres and degrees wide. A pose that
    is farther from the mean gets a lower bound, since a line that is no candidate explains
    nothing. Poses anywhere are compared by `image_log_likelihood`. It has derivatives by the poses
    and by `slam.mount`, with the associations held.

    **Arguments:**
    - `segments_image`: M segments, pixels of the undistorted image.
    - `T_world_robot`: poses [*poses], metres and radians.

    **Returns:** log L without constants; 0 where the image shows no segment of the floor. A
    ValueError names an argument that cannot be used.
    """
    check_type("slam", slam, Setup, "a SofSlam")
    check_type("state", state, SlamState, "a SlamState")
    check_segments("segments_image", segments_image)
    check_poses("T_world_robot", T_world_robot)
    if not T_world_robot.yaw.size:
        return jnp.zeros(T_world_robot.yaw.shape)
    return _pose_log_likelihood(slam, state, segments_image, T_world_robot)


@jax.jit
def _pose_log_likelihood(
    slam: Setup, state: SlamState, segments_image: Segments, T_world_robot: SE2
) -> Float[Array, "*poses"]:
    poses = T_world_robot.yaw.shape
    xy, yaw = T_world_robot.xy.reshape(-1, 2), T_world_robot.yaw.reshape(-1)
    yaw = yaw[0] + wrap(yaw - yaw[0])  # a whole turn more is the same pose
    mean = jax.lax.stop_gradient(SE2(xy.mean(axis=0), yaw.mean()))
    config = slam.config
    variance, weight = pixels_and_weight(config.sensor, state.variance_inflation)
    measurements = measure(
        config.sensor, slam.camera, slam.mount, segments_image, config.filter.max_depth, variance
    )
    local = local_map(slam, state.segment_map, measurements, mean)
    nadirs = local.in_its_frame(SE2(xy, yaw) @ slam.mount.T_robot_nadir)
    used = jnp.broadcast_to(measurements.valid[:, None], (len(measurements.valid), len(yaw)))
    return (weight * hard_log_likelihood(slam, measurements, local, nadirs, used)).reshape(poses)
