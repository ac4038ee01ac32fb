"""Corridors, robots that are driven through them, and what their cameras see.

A world, a rig and a seed make a ride; a ride is drawn and recorded as a drive's folder, or seen
as segments straight in JAX:

    world, rig = make_world("eight", seed=3), Rig()
    ride = take_ride(world, rig, seed=3)
    record(path, world, rig, ride)
    observe(Scene.of(world), rig.camera_file.camera, ride.mounts, ride.poses(), ride.motions(), key)
"""

from sofjax.simulation.dataset import record as record
from sofjax.simulation.rendering.renderer import Imaging as Imaging
from sofjax.simulation.rendering.renderer import Renderer as Renderer
from sofjax.simulation.robot import Driver as Driver
from sofjax.simulation.robot import Odometer as Odometer
from sofjax.simulation.segments.detection import Detection as Detection
from sofjax.simulation.segments.observe import Scene as Scene
from sofjax.simulation.segments.observe import observe as observe
from sofjax.simulation.simulate import Ride as Ride
from sofjax.simulation.simulate import Rig as Rig
from sofjax.simulation.simulate import random_rig as random_rig
from sofjax.simulation.simulate import take_ride as take_ride
from sofjax.simulation.simulate import webcam as webcam
from sofjax.simulation.world.catalogue import WORLDS as WORLDS
from sofjax.simulation.world.catalogue import around as around
from sofjax.simulation.world.catalogue import furnish as furnish
from sofjax.simulation.world.catalogue import make_world as make_world
from sofjax.simulation.world.types import Areas as Areas
from sofjax.simulation.world.types import Lines as Lines
from sofjax.simulation.world.types import World as World
from sofjax.simulation.world.types import rectangle as rectangle
