"""The map of floor segments as GeoJSON: LineStrings in world metres."""

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from sofjax.io.errors import InputError, quoted
from sofjax.io.json_text import read_json
from sofjax.io.numbers import MAX_SEGMENTS, check_segment
from sofjax.io.text import write_atomically

MAX_SEEN = 2**31 - 1


def write_map(
    path: Path, endpoints_world: np.ndarray, seen: np.ndarray, height: np.ndarray | None = None
) -> None:
    """Write segments as a FeatureCollection, a feature a line of the file.

    **Arguments:**
    - `endpoints_world`: [K, 2, 2], metres.
    - `seen`: [K], how many images each was seen in.
    - `height`: [K], estimated height of each line over the floor, metres, if known.
    """
    features = []
    for i, endpoints in enumerate(np.asarray(endpoints_world, float)):
        properties: dict[str, int | float] = {"seen": int(seen[i])}
        if height is not None and math.isfinite(height[i]):
            properties["height"] = round(float(height[i]), 4)
        line = {"type": "LineString", "coordinates": np.round(endpoints, 5).tolist()}
        feature = {"type": "Feature", "properties": properties, "geometry": line}
        features.append(json.dumps(feature, allow_nan=False))
    head = '{"type": "FeatureCollection", "frame": "world", "unit": "metre", "features": [\n'
    write_atomically(Path(path), head + ",\n".join(features) + "\n]}\n")


def read_map(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The segments [K, 2, 2] in world metres, and how often each was seen [K].

    A line of several points is as many segments; features that are no LineString are passed over.

    **Raises:** `InputError` that names the feature.
    """
    path = Path(path)
    document = read_json(path, "the map")
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise InputError(f"{path}: must be GeoJSON, a FeatureCollection of LineStrings in metres")
    endpoints, seen = [], []
    for number, feature in enumerate(features, start=1):
        where = f"{path}, feature {number}"
        try:
            if feature["geometry"]["type"] != "LineString":
                continue
            points = [_point(where, *p[:2]) for p in feature["geometry"]["coordinates"]]
            count = (feature.get("properties") or {}).get("seen", 0)
        except (LookupError, TypeError, AttributeError):
            raise InputError(
                f"{where}: must be a GeoJSON feature with a geometry, such as a LineString of "
                "[x, y] in metres"
            ) from None
        if type(count) is not int or not 0 <= count <= MAX_SEEN:
            raise InputError(f"{where}: 'seen' is {quoted(count)}; it must be a number of images")
        for ends in itertools.pairwise(points):
            check_segment(where, *ends[0], *ends[1])
            endpoints.append(ends)
            seen.append(count)
    if len(endpoints) > MAX_SEGMENTS:
        raise InputError(f"{path}: {len(endpoints)} segments are too many; at most {MAX_SEGMENTS}")
    return np.array(endpoints, float).reshape(-1, 2, 2), np.array(seen, int)


def _point(where: str, x: Any, y: Any) -> tuple[int | float, int | float]:
    for value in (x, y):
        if type(value) not in (int, float):
            raise InputError(f"{where}: a coordinate is {quoted(value)}; it must be metres")
    return x, y
