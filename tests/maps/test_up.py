"""A map of which up is known or not: stored, exported, drawn; files for Nav2 are projected along it, or refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image
from random_maps import assert_same, random_map
from scipy.spatial.transform import Rotation
from test_in_space import HOUR_S, the_map
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.geometry.upright import combine_ups, is_contradiction, level_map
from evermap.io import read_landmarks
from evermap.maps.living import LivingMap
from evermap.maps.store import Provenance, open_store
from evermap.maps.store.content import pack, unpack
from evermap.types import Landmarks, Up

CAMERA = Rotation.from_euler("xyz", [-np.pi / 2, 0.0, -np.pi / 2])
"""Of a map whose frame is that of a camera, x right, y down, z ahead."""


def up_along(x: float, y: float, z: float, sigma_rad: float = 0.02, source: str = "plane of motion") -> Up:
    direction = np.array([x, y, z])
    return Up(direction / np.linalg.norm(direction), sigma_rad, source)


def rig_map(up: Up | None = None) -> LivingMap:
    """The map by hand in the frame of a camera: up is -y there."""
    level = the_map(HOUR_S, moved=False)
    places = replace(level.places, position_m=CAMERA.inv().apply(level.places.position_m))
    return replace(level, places=places, up=up or Up())


def stored(path: Path, living: LivingMap) -> Path:
    with open_store(path, create=True) as store:
        store.commit(living, Provenance(), parent=0)
    return path


def run(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, ["map", *map(str, arguments)])


def dark_cells(path: Path) -> np.ndarray:
    """(K, 2) middles of the cells of a mask that are anything but free, by PyYAML and Pillow."""
    about = yaml.safe_load(path.read_text(encoding="utf-8"))
    with Image.open(path.parent / about["image"]) as image:
        rows, columns = np.nonzero(np.asarray(image)[::-1] < 255)
    return (np.column_stack([columns, rows]) + 0.5) * about["resolution"] + np.array(about["origin"][:2])


def test_it_is_stored_and_read_back(tmp_path: Path) -> None:
    living = rig_map(up_along(0.1, -1.0, 0.0))
    with open_store(stored(tmp_path / "rig.evermap", living)) as store:
        found = store.load()
    assert_same(found, living)
    assert found.landmarks().up.text == living.up.text
    assert run("verify", tmp_path / "rig.evermap").exit_code == 0


def test_maps_that_do_not_know_it_have_the_bytes_that_they_had(tmp_path: Path) -> None:
    """So older ones read as unknown in space, as known in the plane, and an older evermap reads those."""
    for living in (rig_map(), random_map(3)):
        name, chunks = pack(living)
        assert "up." not in str([chunk.raw for chunk in chunks.values()])
        found = unpack(name, lambda names, chunks=chunks: {one: chunks[one].stored() for one in names})
        assert found.landmarks().up.is_known == (living.dim == 2)
    older = tmp_path / "old.evermap"
    older.write_bytes((Path(__file__).parent / "data" / "schema_2.evermap").read_bytes())
    with open_store(older) as store:
        assert store.load().landmarks().up.source == "plane"


def test_a_damaged_one_is_noticed() -> None:
    name, chunks = pack(rig_map(Up(np.array([0.0, -2.0, 0.0]), 0.02, "imu")))
    with pytest.raises(Exception, match="'up' is not a direction"):
        unpack(name, lambda names: {one: chunks[one].stored() for one in names})


def test_nav2_refuses_a_map_without_a_floor(tmp_path: Path) -> None:
    site, graph = stored(tmp_path / "rig.evermap", rig_map()), tmp_path / "graph.geojson"
    graph.write_text('{"type": "FeatureCollection", "features": []}', encoding="utf-8")
    for out, more in (
        ("keepout.yaml", []),
        ("speed.yaml", ["--speed-mask"]),
        ("open.geojson", ["--route-graph", graph]),
    ):
        done = run("nav2", site, "--out", tmp_path / out, *more)
        assert done.exit_code == 2
        assert "the map has no floor, since up is unknown" in done.output
        assert "--up" in done.output
        assert not (tmp_path / out).exists()
    doubtful = stored(tmp_path / "doubtful.evermap", rig_map(up_along(0.0, -1.0, 0.0, sigma_rad=0.3)))
    assert "only (0.000, -1.000, 0.000) within 17.2 deg" in run("nav2", doubtful, "--out", tmp_path / "k.yaml").output


@pytest.mark.parametrize("by_option", [False, True])
def test_masks_are_projected_along_up(tmp_path: Path, by_option: bool) -> None:
    """Discs where the landmarks are on the floor, not on the wall that the camera looked at."""
    living = rig_map(None if by_option else up_along(0.0, -1.0, 0.0))
    site = stored(tmp_path / "rig.evermap", living)
    option = ["--up", "0,-3,0"] if by_option else []
    done = run("nav2", site, "--out", tmp_path / "keepout.yaml", "--radius-m", "0.2", *option, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["up"]["direction"] == [0.0, -1.0, 0.0]
    landmarks = living.landmarks(p_least=0.5)
    # turned by the shortest way: x stays, and what is ahead of the camera is y
    on_floor = np.column_stack([landmarks.position_m[:, 0], landmarks.position_m[:, 2]])
    dark = dark_cells(tmp_path / "keepout.yaml")
    away = np.linalg.norm(dark[:, None] - on_floor, axis=2)
    assert away.min(axis=1).max() < 0.2 + 0.05
    assert (away.min(axis=0) < 0.05).all()
    head = (tmp_path / "keepout.yaml").read_text(encoding="utf-8").splitlines()[0]
    assert head.startswith("# Frame: that of the map, turned so that up is z")


def test_what_is_level_keeps_its_axes() -> None:
    landmarks = replace(the_map(HOUR_S, moved=False).landmarks(), up=up_along(0.02, -0.01, 1.0))
    assert level_map(landmarks).position_m is not None
    np.testing.assert_array_equal(level_map(landmarks).position_m, landmarks.position_m)


def test_options_that_say_nothing_are_refused(tmp_path: Path) -> None:
    site = stored(tmp_path / "rig.evermap", rig_map())
    for text in ("up", "0,0", "0,0,0", "0,nan,1"):
        done = run("export", site, "--out", tmp_path / "k.yaml", "--up", text)
        assert done.exit_code == 2
        assert "is no direction" in done.output
    flat = stored(tmp_path / "flat.evermap", random_map(1))
    assert "the map is in the plane" in run("export", flat, "--out", tmp_path / "k.yaml", "--up", "0,0,1").output


def test_it_is_shown_and_exported_with_the_map(tmp_path: Path) -> None:
    up = up_along(0.0, -1.0, 0.2)
    site = stored(tmp_path / "rig.evermap", rig_map(up))
    assert f"up: {up.text}" in run("show", site).stdout
    assert json.loads(run("show", site, "--json").stdout)["up"]["source"] == "plane of motion"
    for ending in ("parquet", "geojson"):
        run("export", site, "--out", tmp_path / f"map.{ending}")
        found = read_landmarks(tmp_path / f"map.{ending}")
        np.testing.assert_allclose(found.up.direction, up.direction)
        assert (found.up.sigma_rad, found.up.source) == (up.sigma_rad, up.source)


def test_figures_are_from_above_where_that_is_known() -> None:
    above, side = rig_map(up_along(0.0, -1.0, 0.0)).plot().axes
    assert (above.get_title(loc="left"), side.get_title(loc="left")) == ("from above", "from the side")
    assert (above.get_xlabel(), side.get_ylabel()) == ("x, levelled [m]", "z, levelled [m]")
    height = rig_map().landmarks().position_m[:, 1]
    low, high = side.get_ylim()
    assert low < (-height).min()
    assert high > (-height).max()
    unknown = rig_map().plot().axes[0]
    assert unknown.get_title(loc="left") == "up unknown: along the map's z"
    assert unknown.get_xlabel() == "x [m]"


def test_opinions_are_combined_by_their_information() -> None:
    one, other = up_along(0.02, 0.0, 1.0, 0.04, "tf"), up_along(0.0, 0.0, 1.0, 0.02, "imu")
    both = combine_ups(one, other)
    assert both.source == "imu, tf"
    assert both.sigma_rad == pytest.approx((1.0 / 0.04**2 + 1.0 / 0.02**2) ** -0.5)
    assert both.direction[0] == pytest.approx(0.02 * 0.2, rel=0.01)
    many = one
    for _ in range(30):
        many = combine_ups(many, one)
    assert many.sigma_rad == 0.03  # the floor has the same slope every day
    wrong = up_along(1.0, 0.0, 1.0, 0.03, "tf")
    assert is_contradiction(other, wrong)
    assert combine_ups(other, wrong) is other
    assert combine_ups(Up(), one) is one
    assert combine_ups(other, up_along(1.0, 0.0, 0.0, 0.5, "stated")).source == "stated"


def test_landmarks_in_the_plane_know_it() -> None:
    assert Landmarks.at([1], [[0.0, 0.0]]).up.is_known
    assert not Landmarks.in_space([1], [[0.0, 0.0, 0.0]]).up.is_known
