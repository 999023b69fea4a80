"""Maps as the occupancy grids that ROS 2's map_server and the costmap filters of Nav2 read: an image and its YAML."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from evermap.errors import ConfigError, DataError
from evermap.geometry import se3
from evermap.io.files import write_atomic
from evermap.types import Landmarks

MOST_CELLS = 50_000_000
MARGIN_M = 1.0
"""Of free space around all landmarks."""


def write_grid(landmarks: Landmarks, path: str | Path, *, cell_m: float = 0.05, radius_m: float = 0.25) -> Path:
    """Write `path` (.yaml) and the image beside it (.pgm): each cell is as occupied as the landmarks there exist.

    With `mode: scale` a cell gets 100 times the greatest probability to exist of the landmarks that cover it: what is
    certain is kept out by Nav2's keepout filter, what is doubtful slows the robot by its speed filter.

    Args:
        landmarks: a map; one in space is seen from above.
        path: the YAML.
        cell_m: edge of a cell [m].
        radius_m: of the disc that stands for a landmark without a size, and the margin around a box [m].

    Raises:
        DataError: there is no landmark.
        ConfigError: the grid would have more than `MOST_CELLS` cells.
    """
    path = Path(path)
    if not len(landmarks):
        raise DataError("there is no landmark to draw", path=path, hint="a smaller --p-least")
    at = landmarks.position_m[:, :2]
    size = np.zeros((len(landmarks), 2)) if landmarks.size_m is None else np.nan_to_num(landmarks.size_m[:, :2])
    reach = np.hypot(*size.T) / 2.0 + radius_m
    low, high = (at - reach[:, None]).min(axis=0) - MARGIN_M, (at + reach[:, None]).max(axis=0) + MARGIN_M
    width, height = (max(math.ceil(span / cell_m), 1) for span in high - low)
    if width * height > MOST_CELLS:
        problem = f"the grid would have {width} x {height} cells"
        raise ConfigError(problem, path=path, field="cell_m", hint=f"larger cells than {cell_m:g} m")
    occupied = np.zeros((height, width), dtype=np.float32)
    ahead = np.tile([1.0, 0.0], (len(at), 1))
    if landmarks.rotation is not None:
        known = np.isfinite(landmarks.rotation).all(axis=1)
        axis = se3.rotation_of(np.hstack([np.zeros((known.sum(), 3)), landmarks.rotation[known]]))[:, :2, 0]
        ahead[known] = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    for k, p in enumerate(landmarks.p_exists.tolist()):
        first = np.floor((at[k] - reach[k] - low) / cell_m).astype(int)
        last = np.ceil((at[k] + reach[k] - low) / cell_m).astype(int)
        x, y = (low[i] + (np.arange(first[i], last[i]) + 0.5) * cell_m - at[k, i] for i in (0, 1))
        along = x[None] * ahead[k, 0] + y[:, None] * ahead[k, 1]
        across = y[:, None] * ahead[k, 0] - x[None] * ahead[k, 1]
        beyond = [np.maximum(np.abs(one) - half, 0.0) for one, half in zip((along, across), size[k] / 2.0, strict=True)]
        part = occupied[first[1] : last[1], first[0] : last[0]]
        np.maximum(part, np.where(np.hypot(*beyond) <= radius_m, p, 0.0), out=part)
    shade = np.rint(255.0 * (1.0 - occupied[::-1])).astype(np.uint8)  # the first row is the northernmost
    image, (west_m, south_m) = path.with_suffix(".pgm"), low.tolist()
    write_atomic(image, f"P5\n{width} {height}\n255\n".encode() + shade.tobytes())
    return write_atomic(
        path,
        f"image: {image.name}\nmode: scale\nresolution: {cell_m!r}\norigin: [{west_m!r}, {south_m!r}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.99\nfree_thresh: 0.01\n",
    )
