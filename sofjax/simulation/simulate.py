"""A simulated run: a robot driven through a world, its true motion and its odometer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sofjax.geometry import SE2, Camera, Mount
from sofjax.geometry.camera import rotation_robot_camera, rotation_z
from sofjax.io.camera_file import CameraFile, horizon_image
from sofjax.io.errors import InputError
from sofjax.io.trajectory import Trajectory
from sofjax.simulation.robot import Driver, Odometer, drive_along, increments, read_path
from sofjax.simulation.world.catalogue import check_waypoints
from sofjax.simulation.world.plan import inside
from sofjax.simulation.world.types import World

PAPER_MOUNT = Mount.create(height=1.0, pitch=math.radians(12), x=0.1)


def webcam(
    mount: Mount = PAPER_MOUNT,
    focal: float = 291.0,
    width: int = 320,
    height: int = 240,
    distortion: Sequence[float] | np.ndarray = (-0.09, 0.03, 0.0006, -0.0004, 0.0),
) -> CameraFile:
    """A camera like the paper's, on top of the robot; pixels. Section IV.A."""
    K = jnp.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]], float)
    camera = Camera(K, width, height)
    return CameraFile(camera, mount, np.array(distortion, float), "plumb_bob", "simulated")


@dataclass(frozen=True)
class RobotSetup:
    """A robot with its camera, its odometer and its driver."""

    camera_file: CameraFile = field(default_factory=webcam)
    driver: Driver = field(default_factory=Driver)
    odometer: Odometer = field(default_factory=Odometer)
    image_rate: float = 10.0  # images a second
    odometry_rate: float = 25.0  # readings a second
    dropped: float = 0.01  # share of the readings that are lost
    vibration: float = math.radians(0.1)  # radians, of the mount's pitch and roll at full speed

    def __post_init__(self) -> None:
        """Refuse numbers that cannot be, in a sentence."""
        odometer, driver = self.odometer, self.driver
        for name, value in (
            ("vibration in degrees", math.degrees(self.vibration)),
            ("share of dropped readings", self.dropped),
            ("noise of the odometer's distance", odometer.distance_noise),
            ("noise of the odometer's heading", odometer.heading_noise),
            ("noise of the odometer's turns", odometer.turn_noise),
            ("number of slips per metre", odometer.slip),
            ("jitter of the steering", driver.jitter),
            ("scale of the odometer's distance", odometer.distance),
            ("scale of the odometer's left turns", odometer.left),
            ("scale of the odometer's right turns", odometer.right),
        ):
            if not 0 <= float(value) < math.inf:
                raise InputError(f"the {name} is {float(value):g}; it must be 0 or more")
        if self.dropped > 0.9:
            raise InputError(
                f"of the readings a share of {self.dropped:g} is dropped; at most 0.9 may be"
            )
        for name, value, unit in (
            ("speed", driver.speed, "metres a second"),
            ("turn rate", driver.turn_rate, "radians a second"),
            ("image rate", self.image_rate, "images a second"),
            ("odometry rate", self.odometry_rate, "readings a second"),
        ):
            if not 0 < value < math.inf:
                raise InputError(f"the {name} is {value:g}; it must be more than 0 {unit}")
        if driver.speed > 2:
            raise InputError(
                f"at {driver.speed:g} m/s a robot cannot take these bends; at most 2 may be"
            )


def random_setup(seed: int) -> RobotSetup:
    """A robot unlike others: its camera, the camera's place, and the errors of its odometer."""
    rng = np.random.default_rng([seed, 37])
    mount = Mount.create(
        height=float(rng.uniform(0.4, 1.2)),
        pitch=math.radians(rng.uniform(10, 25)),
        x=float(rng.uniform(-0.1, 0.3)),
        y=float(rng.uniform(-0.08, 0.08)),
        roll=math.radians(rng.normal(0, 0.7)),
        yaw=math.radians(rng.normal(0, 1.5)),
    )
    camera_file = webcam(mount, focal=float(rng.uniform(240, 330)))
    number = lambda value: jnp.asarray(value, float)
    odometer = Odometer(
        distance=number(rng.normal(1, 0.012)),
        left=number(rng.normal(1.02, 0.035)),
        right=number(rng.normal(1.02, 0.035)),
        bend=number(rng.normal(0, 0.003)),
        distance_noise=number(rng.uniform(0.001, 0.008)),
        heading_noise=number(rng.uniform(0.001, 0.006)),
        turn_noise=number(rng.uniform(0.003, 0.02)),
        slip=number(rng.uniform(0, 0.05)),
    )
    driver = Driver(speed=float(rng.uniform(0.4, 0.9)), jitter=float(rng.uniform(0.02, 0.1)))
    return RobotSetup(camera_file, driver, odometer)


@dataclass(frozen=True)
class SimulatedRun:
    """A robot driven through a world: the truth, and what its odometer read."""

    truth: Trajectory  # at the images
    turn_rate: np.ndarray  # [T] radians per second, at the images
    odometry: Trajectory  # as read, in the odometer's own frame
    mounts: Mount  # leading T: the mount as it shook at each image

    def motions(self) -> SE2:
        """The odometer's readings between the images, with a leading T: what `observe` takes."""
        return increments(self.odometry.at(self.truth.stamps))

    def poses(self) -> SE2:
        """The true T_world_robot at the images, with a leading T."""
        return SE2(jnp.asarray(self.truth.xy), jnp.asarray(self.truth.yaw))

    def camera_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """The true R_world_camera [T, 3, 3] and optical centres C [T, 3], metres, at the images."""
        R_world_camera, C = _camera_pose(self.mounts, self.poses())
        return np.asarray(R_world_camera, float), np.asarray(C, float)


def simulate_run(
    world: World, setup: RobotSetup, seed: int = 0, max_images: int | None = None
) -> SimulatedRun:
    """Drive a robot along a world's waypoints.

    **Raises:** `InputError` for waypoints that lead through a wall, and for an impossible setup.
    """
    check_setup(world, setup)
    check_waypoints(world.corridors, world.waypoints)
    rng = np.random.default_rng([seed, 41])
    path = drive_along(world.waypoints, setup.driver, rng)
    stamps = np.arange(0, path.stamps[-1], 1 / setup.image_rate)[:max_images]
    truth = path.at(stamps)
    read_at = path.at(np.arange(0, stamps[-1] + 1 / setup.odometry_rate, 1 / setup.odometry_rate))
    odometry = read_path(setup.odometer, read_at, jax.random.key(seed))
    kept = rng.random(len(odometry.stamps)) >= setup.dropped
    kept[[0, -1]] = True
    odometry = Trajectory(odometry.stamps[kept], odometry.xy[kept], odometry.yaw[kept])
    before, after = path.at(stamps - 0.02), path.at(stamps + 0.02)
    speed = np.linalg.norm(after.xy - before.xy, axis=-1) / 0.04
    shake = (
        setup.vibration
        * (speed / setup.driver.speed)[:, None]
        * rng.standard_normal((len(stamps), 2))
    )
    turn_rate = (after.yaw - before.yaw) / 0.04
    simulated = SimulatedRun(truth, turn_rate, odometry, _shaken(setup.camera_file.mount, shake))
    C = simulated.camera_poses()[1]
    for outside in C[~inside(world.corridors, C[:, :2])][:1]:
        raise InputError(
            f"the camera goes through a wall at ({outside[0]:.2f}, {outside[1]:.2f}); its place on "
            "the robot must be nearer to the middle"
        )
    return simulated


def _shaken(mount: Mount, shake: np.ndarray) -> Mount:
    """The mount at each image, its pitch and roll moved by `shake` [T, 2] radians."""

    @jax.jit
    @jax.vmap
    def one(moved: Array) -> Mount:
        return mount.tilted(moved[0], moved[1])

    return one(jnp.asarray(shake, mount.pitch.dtype))


def check_setup(world: World, setup: RobotSetup) -> None:
    """Refuse a camera that cannot see this world's floor, in a sentence."""
    camera, mount = setup.camera_file.camera, setup.camera_file.mount
    height = float(mount.height)
    if not 0 < height < world.ceiling:
        where = "in or under the floor" if height <= 0 else "above the ceiling"
        raise InputError(
            f"a camera {height:g} m high is {where}; it must be between 0 and {world.ceiling:.2f} m"
        )
    right, bottom = camera.width - 1, camera.height - 1
    corners = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1]])
    if (
        corners @ horizon_image(np.asarray(camera.K), float(mount.pitch), float(mount.roll)) <= 0
    ).all():
        raise InputError(
            f"with a pitch of {math.degrees(mount.pitch):g} degrees the camera sees no floor; "
            "pitch > 0 looks down"
        )


@jax.jit
@jax.vmap
def _camera_pose(mount: Mount, T_world_robot: SE2) -> tuple[Array, Array]:
    C = jnp.append(T_world_robot.apply(mount.T_robot_nadir.xy), mount.height)
    return rotation_z(T_world_robot.yaw) @ rotation_robot_camera(mount), C
