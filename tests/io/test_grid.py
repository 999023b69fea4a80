"""Occupancy grids: each cell is as occupied as what covers it exists, where ROS looks for it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from evermap.errors import ConfigError, DataError
from evermap.geometry import se3
from evermap.io.nav2 import write_grid, write_speed_mask
from evermap.types import Landmarks, Up


def grid_of(path: Path) -> tuple[np.ndarray, float, np.ndarray]:
    """Occupancy (H, W) from south to north by the rules of map_server, the edge of a cell, and the origin.

    Image and YAML are read by Pillow and PyYAML, not by evermap.
    """
    about = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert about["mode"] == "scale"
    assert about["negate"] == 0
    with Image.open(path.parent / about["image"]) as image:
        assert (image.format, image.mode) == ("PPM", "L")
        p = 1.0 - np.asarray(image)[::-1] / 255.0
    low, high = about["free_thresh"], about["occupied_thresh"]
    scaled = np.clip((p - low) / (high - low), 0.0, 1.0)
    return scaled, about["resolution"], np.array(about["origin"][:2])


def at(grid: tuple[np.ndarray, float, np.ndarray], x: float, y: float) -> float:
    values, cell_m, origin = grid
    column, row = np.floor((np.array([x, y]) - origin) / cell_m).astype(int)
    return float(values[row, column])


def test_discs_as_dark_as_they_exist(tmp_path: Path) -> None:
    landmarks = Landmarks.at([1, 2, 3], [[0.0, 0.0], [3.0, -2.0], [3.1, -2.0]])
    landmarks.p_exists[:] = [1.0, 0.3, 0.6]
    grid = grid_of(write_grid(landmarks, tmp_path / "site.yaml", cell_m=0.02, radius_m=0.3))
    for x, y in np.random.default_rng(0).uniform([-0.9, -2.9], [3.9, 0.9], (400, 2)):
        far = np.hypot(*(landmarks.position_m - [x, y]).T)
        if np.abs(far - 0.3).min() < 0.02:
            continue  # at the edge of a disc a cell is both
        p = max((float(landmarks.p_exists[k]) for k in np.flatnonzero(far < 0.3)), default=0.0)
        assert at(grid, x, y) == pytest.approx(p, abs=0.02)


def test_boxes_as_they_are_turned(tmp_path: Path) -> None:
    turned = se3.exp(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.6]]))
    landmarks = Landmarks.in_space([5], [[1.0, 2.0, 0.4]], rotation=turned[:, 3:], size_m=np.array([[4.0, 1.0, 1.5]]))
    landmarks = replace(landmarks, up=Up(np.array([0.0, 0.0, 1.0]), 0.01, "stated"))
    grid = grid_of(write_grid(landmarks, tmp_path / "site.yaml", radius_m=0.0))
    for along, across, inside in ((1.9, 0.4, True), (-1.9, -0.4, True), (2.2, 0.0, False), (0.0, 0.7, False)):
        x, y, _ = se3.transform(np.concatenate([[1.0, 2.0, 0.4], turned[0, 3:]]), np.array([along, across, 0.0]))
        assert at(grid, x, y) == (1.0 if inside else 0.0)


def limit_of(path: Path, x: float, y: float) -> float:
    """Per cent of the greatest speed that Nav2's speed filter sets: 0 is no limit, as is what is out of bounds."""
    value = round(100.0 * at(grid_of(path), x, y))
    limit = 100.0 - 1.0 * value if value else 0.0
    return limit if 0.0 <= limit <= 100.0 else 0.0


def test_the_speed_mask_slows_where_the_map_may_be_wrong(tmp_path: Path) -> None:
    landmarks = Landmarks.at([1, 2, 3, 4], [[0.0, 0.0], [4.0, 0.0], [4.5, 0.0], [9.0, 0.0]])
    path = write_speed_mask(landmarks, np.array([0.001, 0.3, 0.62, 1.0]), tmp_path / "speed.yaml", radius_m=0.8)
    assert path.read_text().startswith("# Mask of Nav2's speed filter; its CostmapFilterInfo: type 1, base 100.0")
    assert limit_of(path, 0.0, 0.0) == 0.0  # what is sure sets no limit
    assert limit_of(path, 3.4, 0.0) == 70.0
    assert limit_of(path, 4.2, 0.3) == 38.0  # the slowest of both
    assert limit_of(path, 6.5, 0.0) == 0.0
    assert limit_of(path, 9.0, 0.7) == 10.0  # a limit of 0 would be none


def test_every_per_cent_arrives(tmp_path: Path) -> None:
    landmarks = Landmarks.at(range(91), [[3.0 * k, 0.0] for k in range(91)])
    path = write_speed_mask(landmarks, np.arange(91) / 100.0, tmp_path / "s.yaml", cell_m=0.5, radius_m=1.0)
    grid = grid_of(path)
    assert [round(100.0 * at(grid, 3.0 * k, 0.0)) for k in range(91)] == list(range(91))


def test_what_cannot_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no landmark to draw"):
        write_grid(Landmarks.at([], np.zeros((0, 2))), tmp_path / "site.yaml")
    far = Landmarks.at([1, 2], [[0.0, 0.0], [1e5, 1e5]])
    with pytest.raises(ConfigError, match=r"cells.*larger cells than 0\.05 m"):
        write_grid(far, tmp_path / "site.yaml")
    assert not list(tmp_path.iterdir())
