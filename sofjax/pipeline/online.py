"""While driving: the filter's step for one image after the other, searched ahead of time."""

import time
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import jax

from sofjax.extraction.observation import Observation
from sofjax.io.drive import Drive
from sofjax.pipeline.settings import RunSettings
from sofjax.slam import SofSlam
from sofjax.slam.state import SlamState, StepInfo
from sofjax.vision import Frontend, ImageSegments, observations

AHEAD = 8  # images that are searched for segments before the filter asks for them


class Frame(NamedTuple):
    """One image done."""

    view: ImageSegments
    observation: Observation
    info: StepInfo  # on the host
    seconds: dict[str, float]  # that it waited for the view, and that the step took
    state: SlamState


def steps(settings: RunSettings, drive: Drive, frontend: Frontend) -> Iterator[Frame]:
    """Fig. 6 for one image of a drive after the other."""
    slam = SofSlam(settings.slam, drive.camera_file.camera, drive.camera_file.mount)
    state = slam.init(jax.random.key(settings.seed), settings.frontend.capacity)
    with closing(views(frontend, drive.image_files)) as coming:
        begun = time.perf_counter()
        for view, observed in observations(drive, coming):
            waited = time.perf_counter()
            state, info = slam.step(state, observed)
            info = jax.device_get(info)
            stepped = time.perf_counter()
            seconds = {"wait": waited - begun, "step": stepped - waited}
            yield Frame(view, observed, info, seconds, state)
            begun = time.perf_counter()


def views(frontend: Frontend, files: Sequence[Path]) -> Generator[ImageSegments, None, None]:
    """The views of the images in order, made ahead of time by a thread of their own."""
    worker = ThreadPoolExecutor(max_workers=1)
    try:
        coming = [worker.submit(frontend.view, file) for file in files[:AHEAD]]
        for i in range(len(files)):
            view = coming.pop(0).result()
            if i + AHEAD < len(files):
                coming.append(worker.submit(frontend.view, files[i + AHEAD]))
            yield view
    finally:
        worker.shutdown(cancel_futures=True)
