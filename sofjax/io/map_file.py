"""The map of floor segments as GeoJSON: LineStrings in world metres."""

import json
import math
from pathlib import Path

import numpy as np

from sofjax.io.errors import InputError
from sofjax.io.text import TABLE_BYTES, read_text, write_atomically


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
        document = json.loads(read_text(path, "the map", TABLE_BYTES))
        features = document["features"]
        segments, seen = [], []
        for feature in features:
            if feature["geometry"]["type"] != "LineString":
                continue
            points = np.array([p[:2] for p in feature["geometry"]["coordinates"]], float)
            points = points.reshape(-1, 2)
            segments += list(np.stack([points[:-1], points[1:]], axis=1))
            seen += [int((feature.get("properties") or {}).get("seen", 0))] * (len(points) - 1)
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
    return endpoints, np.array(seen, int)
