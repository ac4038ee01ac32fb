"""The map of floor segments as GeoJSON: LineStrings in world metres."""

import json
import math
from pathlib import Path

import numpy as np

from sofjax.io.errors import InputError, quoted
from sofjax.io.text import DOCUMENT_BYTES, read_text, write_atomically

FARTHEST = 1e7  # metres from the origin; the northings of UTM end there
LONGEST = 10_000.0  # metres of a segment


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
        properties = {"seen": int(seen[i])}
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
    """
    try:
        document = json.loads(read_text(path, "the map", DOCUMENT_BYTES))
        features = document["features"]
        segments, seen = [], []
        for feature in features:
            if feature["geometry"]["type"] != "LineString":
                continue
            points = np.array([p[:2] for p in feature["geometry"]["coordinates"]], float)
            points = points.reshape(-1, 2)
            segments += list(np.stack([points[:-1], points[1:]], axis=1))
            count = (feature.get("properties") or {}).get("seen", 0)
            seen += [_count(path, count)] * (len(points) - 1)
        endpoints = np.array(segments, float).reshape(-1, 2, 2)
    except InputError:
        raise
    except json.JSONDecodeError as error:
        raise InputError(f"{path}, line {error.lineno}: not JSON: {error.msg}") from None
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
        raise InputError(
            f"{path}: must be GeoJSON, a FeatureCollection of LineStrings in metres"
        ) from None
    if not np.isfinite(endpoints).all():
        raise InputError(f"{path}: a coordinate is not finite")
    check_segments(f"{path}", endpoints)
    return endpoints, np.array(seen, int)


def check_segments(where: str, endpoints: np.ndarray) -> None:
    """Refuse segments [K, 2, 2] that are no line on a floor."""
    length = np.abs(endpoints[:, 1] - endpoints[:, 0]).max(axis=1, initial=0)
    for what, metres, most in (("segment", length, LONGEST), ("coordinate", endpoints, FARTHEST)):
        largest = np.abs(metres).max(initial=0)
        if largest > most:
            raise InputError(
                f"{where}: a {what} of {largest:.3g} m; it must be in metres, {most:g} at most"
            )


def _count(path: Path, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**31:
        raise InputError(f"{path}: 'seen' is {quoted(value)}; it must be a whole number of images")
    return value
