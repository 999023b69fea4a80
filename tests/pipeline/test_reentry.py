"""All sessions of a map once more: the map is the one that they give from the beginning, and is there whole or not."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import evermap as em
from evermap.cli.main import app
from evermap.config import Config, load_config
from evermap.errors import DataError, InputError
from evermap.maps.living import LivingMap
from evermap.maps.store import Provenance, RevisionKind, open_store, verify_store
from evermap.maps.store.measured import RECORDING, pack_recording, unpack_recording
from evermap.maps.store.sql import SqlStore
from evermap.runs.reentry import reenter
from evermap.runs.replay import UnbridgedError
from evermap.runs.sessions import begin_map, enter_session
from evermap.types import SensorKind
from evermap_studies.sim import BuildingConfig, simulate_building

SESSIONS = simulate_building(BuildingConfig(days=4, patrol_s=35.0), 3).sessions
OTHER = load_config(None, ["living.learn_sight=false", "living.returns=false"], {})


def built(path: Path | str, order: tuple[int, ...], config: Config | None = None) -> LivingMap:
    with open_store(path, create=True) as store:
        for k in order:
            enter_session(store, SESSIONS[k], config).commit(store, config)
        return store.load()


@cache
def built_in(order: tuple[int, ...]) -> bytes:
    """The file of a map into which sessions came in this order; each beginning of an order is computed once."""
    with tempfile.TemporaryDirectory() as folder:
        path = begun(Path(folder) / "site.evermap", *order[:-1]) if order[1:] else Path(folder) / "site.evermap"
        built(path, order[-1:])
        return path.read_bytes()


def begun(path: Path, *order: int) -> Path:
    """A map of a test's own into which sessions came in this order."""
    path.write_bytes(built_in(order))
    return path


def stored(path: Path) -> LivingMap:
    with open_store(path) as store:
        return store.load()


def assert_same(a: LivingMap, b: LivingMap) -> None:
    """But for the numbers of cliques and sites, which count up."""
    one, other = a.landmarks(), b.landmarks()
    np.testing.assert_array_equal(one.landmark_id, other.landmark_id)
    for name in ("position_m", "covariance_m2", "p_exists", "n_hits", "n_misses", "last_seen_s"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0.0, atol=1e-12, err_msg=name)
    for name in ("elsewhere_s", "first_s", "last_s", "gone_s", "p_gone"):
        np.testing.assert_allclose(np.sort(getattr(a.stays, name)), np.sort(getattr(b.stays, name)), err_msg=name)
    assert (a.stamp_s, a.clock) == (b.stamp_s, b.clock)


@pytest.fixture(scope="module")
def otherwise(tmp_path_factory: pytest.TempPathFactory) -> LivingMap:
    """The map of all sessions with other settings."""
    return built(tmp_path_factory.mktemp("otherwise") / "site.evermap", (0, 1, 2, 3), OTHER)


def test_other_settings_give_the_map_that_they_give_from_the_beginning(tmp_path: Path) -> None:
    path, work = tmp_path / "site.evermap", tmp_path / "again.evermap"
    before, otherwise = stored(begun(path, 1, 0)), built(tmp_path / "otherwise.evermap", (0, 1), OTHER)
    data = path.read_bytes()
    found = reenter(str(path), work, OTHER)
    assert (found.sessions, found.kept, found.parent, found.revision, found.adopted) == (2, 0, 2, 5, False)
    assert path.read_bytes() == data
    with open_store(work) as store:
        assert_same(store.load(), otherwise)
        assert [item.provenance.recording for item in store.log()[3:]] == [one.name for one in SESSIONS[:2]]
    found = reenter(str(path), work, OTHER, adopt=True)
    assert (found.kept, found.adopted) == (2, True)  # nothing is entered again
    with open_store(path) as store:
        assert_same(store.load(), otherwise)
        assert store.lineage() == (3, 4, 5)
        assert len(store.evidence()) > 0
        assert sorted(item.name for item in store.attachments()) == ["recording"] * 2 + ["trajectory"] * 2
        store.revert(2)
        assert_same(store.load(), before)
    assert verify_store(path).sound


def test_what_operators_said_stays_at_its_time_and_surveyed_landmarks_are_the_beginning(tmp_path: Path) -> None:
    path, work = tmp_path / "site.evermap", tmp_path / "again.evermap"
    survey = stored(begun(tmp_path / "first.evermap", 0)).landmarks()
    with open_store(path, create=True) as store:
        begin_map(store, survey, SESSIONS[0], "survey.csv")
        for k in (0, 1):
            enter_session(store, SESSIONS[k]).commit(store)
            name = int(store.load().members.landmark_id[k])
            store.commit(
                store.load().edited(name, pinned=True), Provenance(kind=RevisionKind.EDIT, note=f"{name}"),
                parent=store.head(),
            )  # fmt: skip
        expected = store.load()
    reenter(str(path), work, adopt=True)
    with open_store(path) as store:
        assert_same(store.load(), expected)
        np.testing.assert_array_equal(store.load().members.pinned, expected.members.pinned)
        assert [item.provenance.kind.value for item in store.log()[5:]] == ["revert", *["session", "edit"] * 2]


@pytest.mark.slow
def test_what_was_stopped_is_continued(tmp_path: Path, otherwise: LivingMap, monkeypatch: pytest.MonkeyPatch) -> None:
    path, work = tmp_path / "site.evermap", tmp_path / "again.evermap"
    begun(path, 0, 1, 2, 3)
    whole, count = em.run_session, 0

    def counted(*given: Any, **named: Any) -> em.Session:
        nonlocal count
        count += 1
        if count == 3:
            raise KeyboardInterrupt
        return whole(*given, **named)

    monkeypatch.setattr("evermap.pipeline.run_session", counted)
    with pytest.raises(KeyboardInterrupt):
        reenter(str(path), work, OTHER, adopt=True)
    assert not work.exists()
    with open_store(path) as store:
        assert store.head() == 4
    found = reenter(str(path), work, OTHER, adopt=True)
    assert (found.kept, count) == (2, 5)
    with open_store(path) as store:
        assert_same(store.load(), otherwise)
    assert reenter(str(path), work).kept == 0  # with other settings nothing is taken over
    assert [item.name for item in tmp_path.iterdir() if item.name.startswith(".")] == []


@pytest.mark.slow
def test_a_session_that_comes_meanwhile_is_entered_too(
    site_address: str, tmp_path: Path, otherwise: LivingMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    built(site_address, (0, 2, 3))
    extend, late = SqlStore.extend, [1]

    def overtaken(store: SqlStore, other: SqlStore) -> int:
        for k in late:
            late.remove(k)
            built(site_address, (k,))
        return extend(store, other)

    monkeypatch.setattr(SqlStore, "extend", overtaken)
    found = reenter(site_address, tmp_path / "again.evermap", OTHER, adopt=True)
    assert (found.sessions, found.kept, found.parent, found.revision) == (4, 1, 4, 9)
    with open_store(site_address) as store:
        assert_same(store.load(), otherwise)
    assert verify_store(site_address).sound


def test_where_a_session_is_not_found_any_more_the_map_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "site.evermap"
    begun(path, 0, 1)
    data, whole = path.read_bytes(), em.run_session

    def elsewhere(recording: em.Recording, *given: Any, **named: Any) -> em.Session:
        if recording.name == SESSIONS[1].name:
            raise DataError("too few landmarks")
        return whole(recording, *given, **named)

    monkeypatch.setattr("evermap.pipeline.run_session", elsewhere)
    with pytest.raises(UnbridgedError, match="revision 2 cannot be brought in again: too few"):
        reenter(str(path), tmp_path / "again.evermap", adopt=True)
    assert path.read_bytes() == data


@pytest.mark.slow
def test_sites_are_entered_alike_in_one_process_and_in_many(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    for site, order in {"dock": (0,), "hall": (2, 0)}.items():
        begun(tmp_path / f"{site}.evermap", *order)
    with open_store(tmp_path / "new.evermap", create=True):
        pass

    def run(*more: str) -> dict[str, Any]:
        words = ["map", "reenter", "--store", str(tmp_path), *more, "--json", "--set", "living.returns=false"]
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, result.output
        told: dict[str, Any] = json.loads(result.stdout)["sites"]
        return told

    one = run("--out", str(tmp_path / "one"), "--workers", "1")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        many = run("--out", str(tmp_path / "many"), "--workers", cluster.scheduler_address)
    assert one == many
    assert one["new"]["sessions"] == 0
    for site in ("dock", "hall"):
        with (
            open_store(tmp_path / "one" / f"{site}.evermap") as a,
            open_store(tmp_path / "many" / f"{site}.evermap") as b,
        ):
            for name in ("landmark_id", "position_m", "covariance_m2", "p_exists"):
                np.testing.assert_array_equal(getattr(a.load().landmarks(), name), getattr(b.load().landmarks(), name))


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "site.evermap"
    begun(path, 0)
    with open_store(path) as store:  # a session without its recording
        store.commit(store.load(), Provenance(stamp_from_s=1e9, stamp_to_s=2e9), parent=1)
    data = path.read_bytes()
    for words in (["--adopt"], ["--workers", "0"], ["--workers", "many"]):
        result = CliRunner().invoke(app, ["map", "reenter", str(path), "--out", str(tmp_path / "out"), *words])
        assert result.exit_code == 2
        assert result.stderr.count("\n") == 1, result.stderr
    assert path.read_bytes() == data


FORMER = Path(__file__).parents[1] / "maps" / "data" / "kept_before_kinds.evermap"
"""Two drives by the template, entered when recordings had neither data sheets of sensors nor looks of landmarks."""


def test_recordings_that_an_older_evermap_kept_are_entered_again(tmp_path: Path) -> None:
    path = tmp_path / "site.evermap"
    path.write_bytes(FORMER.read_bytes())
    with open_store(path) as store:
        before = store.load()
        kept = [unpack_recording(store.attached(one)) for one in store.attachments() if one.name == RECORDING]
    assert len(kept) == 2
    for recording in kept:
        assert isinstance(recording, em.Recording)
        assert (recording.sensor.kind, recording.sensor.sigma_scale) == (None, None)
        assert recording.detections.feature_names == ()
    assert (reenter(str(path), tmp_path / "again.evermap", adopt=True).sessions, before.n_cliques_ever) == (2, 6)
    after = stored(path)
    np.testing.assert_array_equal(after.landmarks().landmark_id, before.landmarks().landmark_id)
    np.testing.assert_allclose(after.landmarks().position_m, before.landmarks().position_m, atol=0.01)


def test_a_kind_of_sensor_is_kept_and_one_of_a_newer_evermap_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = begun(tmp_path / "site.evermap", 0)
    sensed = replace(SESSIONS[1], sensor=replace(SESSIONS[1].sensor, kind=SensorKind.LASER))
    again = unpack_recording(pack_recording(sensed))
    assert isinstance(again, em.Recording)
    assert again.sensor.kind is SensorKind.LASER
    with open_store(path) as store:
        enter_session(store, sensed).commit(store)
    monkeypatch.setattr("evermap.maps.store.measured.SensorKind", StrEnum("SensorKind", ["UWB"]))
    with pytest.raises(InputError, match=r"site\.evermap: revision 2: .*'laser' is not a valid.*a newer one\)"):
        reenter(str(path), tmp_path / "again.evermap")
