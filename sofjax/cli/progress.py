"""A bar on the terminal for the loops over images."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sofjax.pipeline.progress import Progress


@contextmanager
def bar(total: int, description: str, unit: str = " images") -> "Iterator[Progress]":
    """A function that shows how many of all images are done."""
    from tqdm import tqdm

    with tqdm(total=total, desc=description, unit=unit, disable=None) as shown:

        def show(done: int, of: int) -> None:
            shown.update()
            if done == 1:
                shown.unpause()  # compiling is no part of the frames a second
            if done == of:
                shown.close()

        yield show
