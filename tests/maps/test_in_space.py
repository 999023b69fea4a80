"""A living map in space, made by hand: stored, compared, explained, shown and exported as one in the plane."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from random_maps import assert_same, random_map
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.config import Config
from evermap.existence.sites import Evidence
from evermap.geometry import se3
from evermap.geometry.chunked import ChunkedCovariance, of_places
from evermap.io import read_landmarks
from evermap.maps.diff import diff, motion_of, net
from evermap.maps.living import LivingMap, Members, Places, Sites, Stays
from evermap.maps.store import Provenance, open_store
from evermap.maps.store.measured import pack_recording, unpack_recording
from evermap.maps.vicinity import Vicinity, in_chunks, near
from evermap.maps.why import why
from evermap.sensing.sightlines import SightLines, Views
from evermap.types import ChangeKind, FloatArray, MapChange

HOUR_S = 3600.0
POINT = (np.nan,) * 4
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def about(axis: int, angle_rad: float) -> FloatArray:
    """A quaternion."""
    turn = np.zeros(6)
    turn[3 + axis] = angle_rad
    return se3.exp(turn)[3:]


def the_map(stamp_s: float, *, moved: bool) -> LivingMap:
    """A lamp (1) with neither orientation nor second place; a tag (2) with two sites; a tag (3) at its only one."""
    stands = (0.05, 0.9) if moved else (0.9, 0.0)
    sites = Sites(
        np.arange(4), np.array([1, 2, 2, 3]), np.array([0.95, *stands, 0.8]), np.array([0.95, *stands, 0.8]),
        np.array([0.0, 0.0, stamp_s - 60.0, 0.0]), np.full(4, stamp_s),
    )  # fmt: skip
    kept = np.array([True, True, moved, True])
    places = Places(
        np.arange(4), np.array([1, 2, 2, 3]),
        np.array([[0.0, 0.0, 2.5], [3.0, 1.0, 1.2], [3.0, 1.0, 2.2], [-1.0, 2.0, 0.4]]),
        np.array([40, 30, 12, 25]), np.array([2, 1, 0, 5]),
        np.array([POINT, UPRIGHT, about(0, 0.5), about(2, 1.0)]),
        np.where(np.isfinite([POINT[0], 0, 0, 0])[:, None, None], 1e-3 * np.eye(3), np.nan),
    )[kept]  # fmt: skip
    count = len(places)
    stays = Stays(
        np.array([1, 2, 3, 2]), np.array([0, 1, 3, 2]), np.array([0, 1, 1, 1]),
        np.array([[0.0, 0.0, 2.5], [3.0, 1.0, 1.2], [-1.0, 2.0, 0.4], [3.0, 1.0, 2.2]]),
        np.array([-np.inf, -np.inf, -np.inf, stamp_s - 90.0]), np.array([0.0, 0.0, 1.0, stamp_s - 60.0]),
        np.full(4, stamp_s), np.array([np.inf, stamp_s - 80.0 if moved else np.inf, np.inf, np.inf]),
        np.array([0.0, 0.9 if moved else 0.0, 0.0, 0.0]),
    )[np.array([True, True, True, moved])]  # fmt: skip
    factor = np.random.default_rng(3).normal(size=(3 * count, 3 * count))
    lines = SightLines(
        *np.array([[0, 1, 3], [1, 2, 3], [7, 8, 9]]), np.array([3.0, 4.0, 5.0]), np.array([3.0, 5.0, 9.0])
    )
    return LivingMap(
        stamp_s=stamp_s,
        session_start_s=stamp_s - 100.0,
        members=Members(
            np.array([1, 2, 3]), np.array([0, 1, 1]), np.array([1, 2, 3]), np.array([True, False, False]),
            np.zeros(3, dtype=np.bool_),
        ),
        sites=sites[kept],
        places=places,
        stays=stays,
        covariance_m2=1e-4 * np.eye(3 * count) + 1e-5 * factor @ factor.T,
        sightlines=lines,
        views=Views(np.array([[0, 0], [1, 0], [2, 1]]), np.array([0, 3, 5]), np.full(3, stamp_s), np.ones(3)),
        class_names=("lamp", "tag"),
        n_cliques_ever=4,
        n_sites_ever=4,
    )  # fmt: skip


FIRST, SECOND = the_map(HOUR_S, moved=False), the_map(25 * HOUR_S, moved=True)
MOVED = MapChange((2,), ChangeKind.MOVED, HOUR_S, 25 * HOUR_S, (0.0, 0.0, 1.0), 0.5, 0.9, 12, 8)


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """The two of them as revisions."""
    path = tmp_path / "site.evermap"
    looked = Evidence(
        np.array([1, 2, 3]), np.full(3, 25 * HOUR_S), np.array([9, 12, 4]), np.array([0, 8, 1]), np.full(3, 9.0),
        np.array([5.0, 7.0, 2.0]), np.array([0.95, 0.95, 0.8]),
    )  # fmt: skip
    with open_store(path, create=True) as store:
        store.commit(FIRST, Provenance(recording="monday", stamp_from_s=0.0, stamp_to_s=HOUR_S), parent=0)
        about_it = Provenance(recording="tuesday", stamp_from_s=24 * HOUR_S, stamp_to_s=25 * HOUR_S)
        store.commit(SECOND, about_it, (MOVED,), looked, parent=1)
    return path


def run(*arguments: str | Path | int) -> str:
    result = CliRunner().invoke(app, ["map", *(str(argument) for argument in arguments)])
    assert result.exit_code == 0, result.output
    return result.stdout


def said(*arguments: str | Path | int) -> Any:
    return json.loads(run(*arguments, "--json"))


def test_it_reads_back_and_its_history_is_told(site: Path) -> None:
    with open_store(site) as store:
        assert_same(store.load(1), FIRST)
        assert_same(store.load(), SECOND)
        assert_same(store.changes(), (MOVED,))
        assert store.load(0).dim == 2  # nobody has said yet
    assert said("verify", site)["intact"] == [1, 2]
    assert "1 moved" in run("log", site)
    assert said("log", site)["revisions"][1]["changes"] == {"moved": 1}
    run("pin", site, 3)
    run("revert", site, 1)
    with open_store(site) as store:
        assert_same(store.load(), replace(FIRST, n_cliques_ever=4, n_sites_ever=4))


def test_differences_have_three_numbers_and_an_angle(site: Path) -> None:
    assert said("diff", site, 1)["changes"][0]["displacement_m"] == [0.0, 0.0, 1.0]
    assert run("diff", site, 1).startswith("landmark 2 turned by 28.6° and moved by (0.00, 0.00, +1.00) m between")
    (back,) = said("diff", site, 2, 1)["changes"]
    np.testing.assert_allclose(back["displacement_m"], [0.0, 0.0, -1.0])
    assert back["rotation_rad"] == pytest.approx(0.5)
    assert said("diff", site, 0)["grown"] == [1, 2, 3]
    with open_store(site) as store:
        assert diff(store, 2, 0).changes == ()


def test_several_sessions_are_composed_to_where_it_stands_and_how_it_is_turned() -> None:
    turned = replace(MOVED, displacement_m=(0.0, 0.0, 0.4))
    (change,) = net([((turned,), False), ((turned,), False)], FIRST, SECOND)
    np.testing.assert_allclose(change.displacement_m, (0.0, 0.0, 1.0))
    assert change.rotation_rad == pytest.approx(0.5)
    # turned where it stood is a change in space, and none if it is turned back
    places = FIRST.places
    for angle_rad, kinds in ((0.6, [ChangeKind.MOVED]), (0.1, [])):
        rotation = np.where(places.landmark_id[:, None] == 2, about(1, angle_rad), places.rotation)
        after = replace(FIRST, places=replace(places, rotation=rotation))
        found = net([((turned,), False), ((turned,), False)], FIRST, after)
        assert [one.kind for one in found] == kinds
    gone = replace(MOVED, kind=ChangeKind.VANISHED, displacement_m=(np.nan,) * 3)
    assert net([((gone,), False), ((), False)], FIRST, LivingMap()) == (gone,)


def test_motions_of_bodies() -> None:
    """Of three points, and of one with an orientation, against the motion that was made."""
    rng = np.random.default_rng(1)
    motion = se3.exp([1.0, 2.0, 3.0, 0.3, -0.4, 0.2])
    angle = float(np.linalg.norm([0.3, -0.4, 0.2]))
    was = np.hstack([rng.normal(size=(4, 3)), [about(k % 3, 0.3 * k) for k in range(4)]])
    now = se3.compose(motion, was)
    points = np.full((4, 4), np.nan)
    for turns, rows, wanted in (
        ((points, points), 4, angle), ((points, points), 2, 0.0), ((was[:, 3:], -now[:, 3:]), 1, angle),
    ):  # fmt: skip
        shift, turn = motion_of(was[:rows, :3], now[:rows, :3], (turns[0][:rows], turns[1][:rows]))
        np.testing.assert_allclose(shift, (now - was)[:rows, :3].mean(axis=0))
        assert turn == pytest.approx(wanted)


def test_why_and_show_tell_it(site: Path, tmp_path: Path) -> None:
    picture = tmp_path / "map.png"
    shown = said("show", site, "--figure", picture)["landmarks"]
    assert [[item[axis] for axis in ("x_m", "y_m", "z_m")] for item in shown] == SECOND.landmarks().position_m.tolist()
    assert shown[0]["rotation"] is None
    np.testing.assert_allclose(shown[1]["rotation"], about(0, 0.5))
    own = of_places(SECOND.covariance_m2, np.array([2]), 3)
    assert shown[1]["sigma_m"] == pytest.approx(np.sqrt(np.trace(own) / 3))
    assert "(3.00, 1.00, 2.20)" in run("show", site)
    assert picture.stat().st_size > 10_000
    assert "revision 2: landmark 2 turned by 28.6° and moved by (0.00, 0.00, +1.00) m" in run(
        "why", site, 2, "--figure", picture
    )
    with open_store(site) as store:
        assert "is believed to be there" in why(store, 2).headline


@pytest.mark.parametrize("ending", ["parquet", "geojson", "csv"])
def test_what_is_exported_reads_back(site: Path, tmp_path: Path, ending: str) -> None:
    out = tmp_path / f"map.{ending}"
    run("export", site, "--out", out)
    found, wanted = read_landmarks(out), SECOND.landmarks(p_least=0.5)
    np.testing.assert_array_equal(found.landmark_id, wanted.landmark_id)
    np.testing.assert_allclose(found.position_m, wanted.position_m)
    np.testing.assert_allclose(found.covariance_m2, wanted.covariance_m2)
    np.testing.assert_allclose(found.rotation, wanted.rotation)


@pytest.mark.parametrize("odometry", [True, False])
def test_recordings_in_space_are_kept_bit_by_bit(odometry: bool) -> None:
    import sys

    sys.path.insert(0, str(Path(__file__).parents[1] / "metrics"))
    from synthetic_run import make_spatial_run

    recording, _ = make_spatial_run(duration_s=10.0)
    recording = replace(recording, truth=None, true_landmarks=None, warnings=())
    recording = recording if odometry else replace(recording, odometry=None)
    recording = replace(recording, symmetries={"can": ("axis:z", "180:x")} if odometry else {})
    data = pack_recording(recording)
    assert data == pack_recording(recording)
    assert_same(unpack_recording(data), recording)


def test_a_large_map_in_space_is_in_chunks_of_which_a_part_is_put_back(tmp_path: Path) -> None:
    config = Config().model_copy(update={"living": Config().living.model_copy(update={"whole_places": 8})})
    small = random_map(4, cliques=40, dim=3)
    large = in_chunks(small, config.living)
    assert isinstance(large.covariance_m2, ChunkedCovariance)
    np.testing.assert_allclose(large.landmarks().covariance_m2, small.landmarks().covariance_m2)
    with open_store(tmp_path / "m.evermap", create=True) as store:
        store.commit(large, Provenance(), parent=0)
        found = store.load()
    every = np.arange(len(small.places))
    assert isinstance(found.covariance_m2, ChunkedCovariance)
    np.testing.assert_array_equal(found.covariance_m2.of(every), large.covariance_m2.of(every))
    some, box = near(large, np.array([[0.0, 0.0, 5.0], [2.0, 0.0, 6.0]]), 4.0)
    away = np.abs(large.places.position_m[:, :2] - [1.0, 0.0])
    assert np.isin(large.sites.clique_id[large.places.site_id[(away < [1.0, 4.0]).all(axis=1)]], some).all()
    np.testing.assert_allclose(box, [-4.0, -4.0, 6.0, 4.0])
    vicinity = Vicinity.of(large, some, config.living, box)
    assert vicinity.part.dim == 3
    again = vicinity.put_back(vicinity.part)
    assert_same(again.places, large.places)
    assert isinstance(again.covariance_m2, ChunkedCovariance)
    np.testing.assert_allclose(again.covariance_m2.each_m2, large.covariance_m2.each_m2, atol=1e-9)
