"""Corridors, robots that are driven through them, and what their cameras see.

A world, a robot setup and a seed make a simulated run. A simulated run is drawn and recorded as a
drive's folder, or seen as segments directly in JAX:

    world, setup = make_world("eight", seed=3), RobotSetup()
    run = simulate_run(world, setup, seed=3)
    record(path, world, setup, run)
    observe(Scene.of(world), setup.camera_file.camera, run.mounts, run.poses(), run.motions(), key)
"""

from sofjax.simulation.dataset import record as record
from sofjax.simulation.rendering.renderer import Imaging as Imaging
from sofjax.simulation.rendering.renderer import Renderer as Renderer
from sofjax.simulation.robot import Driver as Driver
from sofjax.simulation.robot import Odometer as Odometer
from sofjax.simulation.segments.detection import Detection as Detection
from sofjax.simulation.segments.observe import Scene as Scene
from sofjax.simulation.segments.observe import observe as observe
from sofjax.simulation.simulate import RobotSetup as RobotSetup
from sofjax.simulation.simulate import SimulatedRun as SimulatedRun
from sofjax.simulation.simulate import random_setup as random_setup
from sofjax.simulation.simulate import simulate_run as simulate_run
from sofjax.simulation.simulate import webcam as webcam
from sofjax.simulation.world.catalogue import WORLDS as WORLDS
from sofjax.simulation.world.catalogue import around as around
from sofjax.simulation.world.catalogue import furnish as furnish
from sofjax.simulation.world.catalogue import make_world as make_world
from sofjax.simulation.world.types import Areas as Areas
from sofjax.simulation.world.types import FloorLines as FloorLines
from sofjax.simulation.world.types import World as World
from sofjax.simulation.world.types import rectangle as rectangle
