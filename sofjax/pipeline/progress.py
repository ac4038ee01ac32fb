"""How far a loop over the images has come, to be shown."""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Progress = Callable[[int, int], None]  # called after each image: how many are done, of how many
Item = TypeVar("Item")


def watched(items: Iterable[Item], progress: Progress | None) -> Iterator[Item]:
    """The same items; `progress` is called when the next one is asked for."""
    items = list(items)
    for done, item in enumerate(items, start=1):
        yield item
        if progress is not None:
            progress(done, len(items))
