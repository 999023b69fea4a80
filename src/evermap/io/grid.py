"""Maps as the grids that ROS 2's map_server and the costmap filters of Nav2 read: an image and its YAML."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from evermap.errors import ConfigError, DataError
from evermap.geometry import se3
from evermap.io.files import write_atomic
from evermap.types import FloatArray, Landmarks

MOST_CELLS = 50_000_000
MARGIN_M = 1.0
"""Margin of free space around all landmarks."""
LEAST_SPEED = 0.1
"""Minimum share of the maximum speed: Nav2 reads a limit of 0 as no limit."""


class Footprints(NamedTuple):
    """Footprints of landmarks on the floor: centres (L, 2), directions (L, 2) of their lengths, halves (L, 2) of their
    sizes; points have no size.
    """

    at: FloatArray
    ahead: FloatArray
    half: FloatArray

    @classmethod
    def of(cls, landmarks: Landmarks) -> Self:
        """Return those of a map; one in space is seen from above."""
        at = landmarks.position_m[:, :2]
        size = np.zeros((len(landmarks), 2)) if landmarks.size_m is None else np.nan_to_num(landmarks.size_m[:, :2])
        ahead = np.tile([1.0, 0.0], (len(at), 1))
        if landmarks.rotation is not None:
            known = np.isfinite(landmarks.rotation).all(axis=1)
            axis = se3.rotation_of(np.hstack([np.zeros((known.sum(), 3)), landmarks.rotation[known]]))[:, :2, 0]
            ahead[known] = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
        return cls(at, ahead, size / 2.0)

    def distance(self, row: int, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return how far points are from one of them, 0 within it; the shapes of x and y broadcast."""
        dx, dy = x - self.at[row, 0], y - self.at[row, 1]
        along = dx * self.ahead[row, 0] + dy * self.ahead[row, 1]
        across = dy * self.ahead[row, 0] - dx * self.ahead[row, 1]
        beyond = (np.maximum(np.abs(a) - b, 0.0) for a, b in zip((along, across), self.half[row], strict=True))
        return np.asarray(np.hypot(*beyond))


def write_grid(landmarks: Landmarks, path: str | Path, *, cell_m: float = 0.05, radius_m: float = 0.25) -> Path:
    """Write `path` (.yaml) and its image (.pgm): the occupancy of a cell is P(exists) of its landmarks.

    With `mode: scale` a cell gets 100 times the greatest probability to exist of the landmarks that cover it: what is
    certain is kept out by Nav2's keepout filter, what is doubtful costs more.

    Args:
        landmarks: a map; one in space is seen from above.
        path: the YAML.
        cell_m: edge of a cell [m].
        radius_m: of the disc that stands for a landmark without a size, and the margin around a box [m].

    Raises:
        DataError: there is no landmark.
        ConfigError: the grid would have more than `MOST_CELLS` cells.
    """
    occupied, origin_m = _drawn(landmarks, landmarks.p_exists, Path(path), cell_m, radius_m)
    return _written(Path(path), occupied, origin_m, cell_m, (0.01, 0.99))


def write_speed_mask(
    landmarks: Landmarks, p_wrong: FloatArray, path: str | Path, *, cell_m: float = 0.05, radius_m: float = 1.0
) -> Path:
    """Write `path` (.yaml) and its image (.pgm) as the mask of Nav2's speed filter: slow where the map may be wrong.

    A cell says by how many per cent of the greatest speed to drive slower (type 1, base 100, multiplier -1): 100 times
    the greatest `p_wrong` of the landmarks that are near it, and never so much that less than `LEAST_SPEED` remains.

    Args:
        landmarks: a map; one in space is seen from above.
        p_wrong: (L,) probability of each that it is not as the map says: gone, or there after all.
        path: the YAML.
        cell_m: edge of a cell [m].
        radius_m: how far around a landmark it is slow [m].

    Raises:
        DataError: there is no landmark.
        ConfigError: the grid would have more than `MOST_CELLS` cells.
    """
    slower = np.rint(100.0 * np.minimum(p_wrong, 1.0 - LEAST_SPEED)) / 100.0
    drawn, origin_m = _drawn(landmarks, slower, Path(path), cell_m, radius_m)
    about = "Mask of Nav2's speed filter; its CostmapFilterInfo: type 1, base 100.0, multiplier -1.0"
    return _written(Path(path), drawn, origin_m, cell_m, (0.0, 1.0), f"# {about}\n")


def _drawn(
    landmarks: Landmarks, value: FloatArray, path: Path, cell_m: float, radius_m: float
) -> tuple[FloatArray, list[float]]:
    """(H, W) the greatest value (L,) of what covers each cell, from south to north, and the corner of the first."""
    if not len(landmarks):
        raise DataError("there is no landmark to draw", path=path, hint="a smaller --p-least")
    feet = Footprints.of(landmarks)
    at, reach = feet.at, np.hypot(*feet.half.T) + radius_m
    low, high = (at - reach[:, None]).min(axis=0) - MARGIN_M, (at + reach[:, None]).max(axis=0) + MARGIN_M
    width, height = (max(math.ceil(span / cell_m), 1) for span in high - low)
    if width * height > MOST_CELLS:
        problem = f"the grid would have {width} x {height} cells"
        raise ConfigError(problem, path=path, field="cell_m", hint=f"larger cells than {cell_m:g} m")
    drawn = np.zeros((height, width), dtype=np.float32)
    for k, p in enumerate(value.tolist()):
        first = np.floor((at[k] - reach[k] - low) / cell_m).astype(int)
        last = np.ceil((at[k] + reach[k] - low) / cell_m).astype(int)
        x, y = (low[i] + (np.arange(first[i], last[i]) + 0.5) * cell_m for i in (0, 1))
        part = drawn[first[1] : last[1], first[0] : last[0]]
        np.maximum(part, np.where(feet.distance(k, x[None], y[:, None]) <= radius_m, p, 0.0), out=part)
    return drawn, low.tolist()


def _written(
    path: Path,
    value: FloatArray,
    origin_m: list[float],
    cell_m: float,
    thresholds: tuple[float, float],
    head: str = "",
) -> Path:
    """The image, dark where the value (H, W) is 1, and its YAML."""
    shade = np.rint(255.0 * (1.0 - value[::-1])).astype(np.uint8)  # the first row is the northernmost
    image, (west_m, south_m), (free, occupied) = path.with_suffix(".pgm"), origin_m, thresholds
    write_atomic(image, f"P5\n{value.shape[1]} {value.shape[0]}\n255\n".encode() + shade.tobytes())
    return write_atomic(
        path,
        f"{head}image: {image.name}\nmode: scale\nresolution: {cell_m!r}\norigin: [{west_m!r}, {south_m!r}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {occupied!r}\nfree_thresh: {free!r}\n",
    )
