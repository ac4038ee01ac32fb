"""The images of a board, from which a camera is calibrated: found, read and searched for it."""

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np

from sofjax.io.errors import InputError
from sofjax.pipeline.progress import Progress, watched
from sofjax.vision import read_image
from sofjax.vision.boards import Board, Correspondences, find_points, recognise
from sofjax.vision.checkerboard import MIN_VIEWS

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}
MIN_CORNERS = 3  # along a side
HINTED = 4  # images in which other boards are looked for


@dataclasses.dataclass(frozen=True)
class Found:
    """What the images show."""

    width: int  # pixels
    height: int
    names: list[str]  # images in which the board was found
    views: list[Correspondences]  # of each
    board: Board  # as it was recognised
    left_out: dict[str, str]  # the other images, and why


def look(files: list[Path], board: Board, progress: Progress | None = None) -> Found:
    """Search every image for the board, one at a time; those of another size than most go.

    **Raises:** `InputError` if it is found in too few.
    """
    shapes = {file: image.shape for file in files if (image := read_image(file)) is not None}
    if not shapes:
        raise InputError(f"{files[0].parent}: none of the {len(files)} images can be read")
    shape = _most(shapes)
    right = [file for file in files if shapes.get(file) == shape]
    board = recognise(board, map(_read, right))
    names, views, left_out = [], [], {}
    for file in watched(files, progress):
        if file not in shapes:
            left_out[file.name] = "cannot be read as an image"
        elif shapes[file] != shape:
            left_out[file.name] = f"has {_by(shapes[file])} pixels and most have {_by(shape)}"
        elif (found := find_points(_read(file), board)) is None:
            left_out[file.name] = (
                f"no {board} {board.things} found: is the whole board in view, sharp and not too "
                "steep?"
            )
        else:
            names.append(file.name)
            views.append(found)
    if len(names) < MIN_VIEWS:
        raise InputError(
            f"{files[0].parent}: the {board} {board.things} were found in {len(names)} of "
            f"{len(files)} images, and {MIN_VIEWS} are needed at least; {_hint(right, board)}"
        )
    return Found(shape[1], shape[0], names, views, board, left_out)


def _read(file: Path) -> np.ndarray:
    image = read_image(file)
    assert image is not None, file
    return image


def _most(shapes: dict[Path, tuple[int, int]]) -> tuple[int, int]:
    """The size that most images have."""
    (shape, count), *others = Counter(shapes.values()).most_common(2)
    if others and others[0][1] == count:
        raise InputError(
            f"{next(iter(shapes)).parent}: as many images have {_by(shape)} pixels as "
            f"{_by(others[0][0])}; give those of one size, that of the drives"
        )
    return shape


def _hint(files: list[Path], board: Board) -> str:
    """Which other board it might be: squares were counted, one side wrongly, or across first."""
    images = [_read(file) for file in files[:HINTED]]
    columns, rows = board.columns, board.rows
    for sides in (
        *((columns - 1, rows - 1), (columns - 2, rows - 2), (columns, rows - 1)),
        *((columns - 1, rows), (columns + 1, rows + 1), (rows, columns)),
    ):
        if min(sides) < MIN_CORNERS:
            continue
        other = dataclasses.replace(board, columns=sides[0], rows=sides[1])
        other = recognise(other, images[:1])
        if all(find_points(image, other) is not None for image in images):
            return f"with --board {other} they are found"
    return {
        "chessboard": "--board counts inner corners, and the whole board must be in view, with a "
        "white rim",
        "charuco": "--board counts squares, and --marker and --square must be the board's",
    }.get(board.pattern, "--board counts circles along and across, and all must be in view, dark")


def files(given: list[Path]) -> list[Path]:
    """The images of a folder in the order of their names, or the files themselves."""
    found = []
    for path in given:
        if not path.exists():
            raise InputError(f"{path}: there is no such file or folder of images")
        try:
            inside = sorted(path.iterdir()) if path.is_dir() else [path]
        except OSError as error:
            raise InputError(f"{path}: the folder cannot be read ({error.strerror})") from None
        images = [file for file in inside if file.suffix.lower() in SUFFIXES and file.is_file()]
        if not images:
            known = ", ".join(sorted(SUFFIXES))
            raise InputError(f"{path}: no image there; images end in {known}")
        found += images
    return found


def _by(shape: tuple[int, int]) -> str:
    return f"{shape[1]}x{shape[0]}"
