"""Corridors, robots that are driven through them, and what their cameras see.

A world, a rig and a seed make a ride; a ride is drawn and recorded as a drive's folder, or seen
as segments straight in JAX:

    world, rig = make_world("eight", seed=3), Rig()
    ride = take_ride(world, rig, seed=3)
    record(path, world, rig, ride)
    observe(Scene.of(world), rig.camera_file.camera, ride.mounts, ride.poses(), ride.motions(), key)
"""

from sofjax.simulation.catalogue import WORLDS as WORLDS
from sofjax.simulation.catalogue import around as around
from sofjax.simulation.catalogue import furnish as furnish
from sofjax.simulation.catalogue import make_world as make_world
from sofjax.simulation.detection import Detection as Detection
from sofjax.simulation.drawing import Artist as Artist
from sofjax.simulation.drawing import Imaging as Imaging
from sofjax.simulation.recording import record as record
from sofjax.simulation.rides import Ride as Ride
from sofjax.simulation.rides import Rig as Rig
from sofjax.simulation.rides import random_rig as random_rig
from sofjax.simulation.rides import take_ride as take_ride
from sofjax.simulation.rides import webcam as webcam
from sofjax.simulation.robots import Driver as Driver
from sofjax.simulation.robots import Odometer as Odometer
from sofjax.simulation.segments import Scene as Scene
from sofjax.simulation.segments import observe as observe
from sofjax.simulation.worlds import Areas as Areas
from sofjax.simulation.worlds import Lines as Lines
from sofjax.simulation.worlds import World as World
from sofjax.simulation.worlds import rectangle as rectangle
