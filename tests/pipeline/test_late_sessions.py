"""Sessions that arrive late: the map is the one that the right order gives."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evermap as em
from evermap.config import RETIRED, Config, parse_config, to_toml
from evermap.errors import DataError, InputError
from evermap.maps.diff import diff, story_of
from evermap.maps.living import LivingMap
from evermap.maps.store import MapStore, Provenance, RevisionKind, StaleRevisionError, open_store
from evermap.maps.store.measured import pack_recording, unpack_recording
from evermap.maps.why import why
from evermap.runs.replay import UnbridgedError
from evermap.runs.sessions import at_time
from evermap.types import MapChange, Recording
from evermap_studies.sim import BuildingConfig, simulate_building

SESSIONS = simulate_building(BuildingConfig(days=4, patrol_s=35.0), 3).sessions


def fed(store: MapStore, recording: Recording) -> em.Entered:
    entered = em.enter_session(store, recording)
    stamps = recording.frames.stamp_s
    provenance = Provenance(
        recording=recording.name,
        config=to_toml(Config()),
        stamp_from_s=float(stamps[0]),
        stamp_to_s=float(stamps[-1]),
        robot=recording.robot,
    )
    store.commit(
        entered.living,
        provenance,
        entered.changes,
        entered.session.evidence,
        parent=entered.parent,
        attachments=entered.attachments,
    )
    return entered


def edited(store: MapStore, landmark: int) -> None:
    living = store.load().edited(landmark, pinned=True)
    store.commit(living, Provenance(kind=RevisionKind.EDIT), parent=store.head())


def built(path: Path | str, order: Sequence[int], recordings: Sequence[Recording] = SESSIONS) -> LivingMap:
    with open_store(path, create=True) as store:
        for k in order:
            fed(store, recordings[k])
        return store.load()


@cache
def fed_in(order: tuple[int, ...]) -> bytes:
    """The file of a map into which sessions came in this order; each beginning of an order is computed once."""
    with tempfile.TemporaryDirectory() as folder:
        path = begun(Path(folder), *order[:-1]) if order[1:] else Path(folder) / "site.evermap"
        built(path, order[-1:])
        return path.read_bytes()


def begun(folder: Path, *order: int) -> Path:
    """A map of a test's own into which sessions came in this order."""
    path = folder / "site.evermap"
    path.write_bytes(fed_in(order))
    return path


def assert_same(a: LivingMap, b: LivingMap) -> None:
    """But for the numbers of cliques and sites, which count up."""
    one, other = a.landmarks(), b.landmarks()
    np.testing.assert_array_equal(one.landmark_id, other.landmark_id)
    for name in ("position_m", "covariance_m2", "p_exists", "n_hits", "n_misses", "last_seen_s"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0.0, atol=1e-12, err_msg=name)
    assert len(a.stays) == len(b.stays)
    for name in ("elsewhere_s", "first_s", "last_s", "gone_s", "p_gone"):
        np.testing.assert_allclose(np.sort(getattr(a.stays, name)), np.sort(getattr(b.stays, name)), err_msg=name)
    assert a.stamp_s == b.stamp_s


@pytest.fixture(scope="module")
def in_order(tmp_path_factory: pytest.TempPathFactory) -> LivingMap:
    with open_store(begun(tmp_path_factory.mktemp("order"), 0, 1, 2, 3)) as store:
        return store.load()


def test_an_interrupt_while_later_sessions_are_entered_again_leaves_the_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(recording: Recording, *given: Any, **named: Any) -> em.Session:
        session = run_session(recording, *given, **named)
        return replace(session, slam=replace(session.slam, interrupted=recording is not SESSIONS[1]))

    run_session = em.run_session
    with open_store(begun(tmp_path, 0, 2)) as store:
        monkeypatch.setattr("evermap.pipeline.run_session", interrupted)
        with pytest.raises(KeyboardInterrupt):
            em.enter_session(store, SESSIONS[1])
        assert store.head() == 2


@pytest.mark.slow
@pytest.mark.parametrize("order", [(0, 2, 3, 1), (3, 1, 0, 2)])
def test_the_order_of_arrival_makes_no_difference(tmp_path: Path, in_order: LivingMap, order: Sequence[int]) -> None:
    with open_store(begun(tmp_path, *order)) as store:
        assert_same(store.load(), in_order)


@pytest.mark.slow
def test_a_late_session_with_which_a_later_one_is_lost_stays_out(tmp_path: Path) -> None:
    """Neither shows enough of what the other has: the map keeps the one that it has."""
    days = simulate_building(BuildingConfig(days=8, patrol_s=30.0), 10).sessions
    with open_store(tmp_path / "site.evermap", create=True) as store:
        fed(store, days[7])
        with pytest.raises(UnbridgedError, match="revision 1 cannot be brought in again: too few"):
            em.enter_session(store, days[2])
        assert store.head() == 1


class Overtaken:
    """A store into which another session comes while one is entered."""

    def __init__(self, store: MapStore, other: Recording) -> None:
        self._store, self._other = store, other

    def __getattr__(self, name: str) -> object:
        return getattr(self._store, name)

    def log(self) -> object:
        log, other = self._store.log(), self._other
        if other is not None:
            self._other = None  # type: ignore[assignment]
            fed(self._store, other)
        return log


def test_a_late_session_that_was_overtaken_is_entered_again(tmp_path: Path) -> None:
    with open_store(begun(tmp_path, 3)) as store:
        entered = em.enter_session(Overtaken(store, SESSIONS[0]), SESSIONS[1])  # type: ignore[arg-type]
        with pytest.raises(StaleRevisionError):
            entered.commit(store)


def test_nor_in_a_database(site_address: str, tmp_path: Path) -> None:
    with open_store(begun(tmp_path, 0, 1, 2)) as store:
        assert_same(built(site_address, (0, 2, 1)), store.load())


def test_nor_whose_sessions_they_are(tmp_path: Path) -> None:
    """Three robots, one of which reads ranges too long: a session that is replayed is that of its robot."""
    whose = [replace(session, robot=f"robot {k}") for k, session in enumerate(SESSIONS[:3])]
    told = whose[1].detections
    whose[1] = replace(whose[1], detections=replace(told, range_m=1.05 * told.range_m))
    late, wanted = (built(tmp_path / f"{order}.evermap", order, whose) for order in ((0, 2, 1), (0, 1, 2)))
    assert_same(late, wanted)
    np.testing.assert_array_equal(late.metres.log_metre, wanted.metres.log_metre)
    assert late.metres.log_metre.tolist()[1] > 0.03


def test_a_late_session_says_what_it_changed_and_what_was_brought_in_again(tmp_path: Path) -> None:
    with open_store(begun(tmp_path, 0, 1, 3)) as store:
        entered = fed(store, SESSIONS[2])
        assert entered.replayed == (SESSIONS[3].name,)
        assert store.head() == 4
        told = [(change.kind, change.landmark_ids) for change in store.changes(4)]
        assert told == [(change.kind, change.landmark_ids) for change in entered.changes]


ANYHOW = tuple(permutations(range(3)))


@cache
def tell_in(order: tuple[int, ...]) -> dict[tuple[str, float], list[str]]:
    """What each session of a map tells, and what changed since each of its revisions, by the instant of these; sessions
    of two robots, which came in this order and one of them twice.
    """
    sessions = [replace(session, robot=f"robot {k % 2}") for k, session in enumerate(SESSIONS[:3])]
    with tempfile.TemporaryDirectory() as folder, open_store(Path(folder) / "site.evermap", create=True) as store:
        for k in order:
            fed(store, sessions[k])
        with pytest.raises(InputError, match="is in the map already"):
            em.enter_session(store, sessions[order[0]])
        by_session = {("told by", one.start_s): sorted(map(spoken, one.changes)) for one in story_of(store)}
        by_session |= {("seen by", one.start_s): look_at_all(store, one.revision) for one in story_of(store)}
        by_session["called", 0.0] = sorted(map(store.load().label, store.load().members.landmark_id.tolist()))
        return by_session | {
            ("since", store.load(number).session_start_s): sorted(map(spoken, diff(store, number).changes))
            for number in range(store.head() + 1)
        }


def look_at_all(store: MapStore, revision: int) -> list[str]:
    """What a session saw of each landmark, as `why` tells it: frames, hits, misses, their weight, and the belief."""
    found = []
    for landmark in store.load().members.landmark_id.tolist():
        answer = why(store, landmark)
        assert [visit.from_s for visit in answer.visits] == sorted(visit.from_s for visit in answer.visits)
        assert len(answer.evidence) == sum(visit.n_looks for visit in answer.visits)
        for visit in (visit for visit in answer.visits if visit.revision == revision):
            numbers = (round(visit.expected, 4), round(visit.log_odds, 3), round(visit.p_exists, 5))
            found.append(str((landmark, visit.n_looks, visit.n_hits, visit.n_misses, *numbers)))
    return found


def spoken(change: MapChange) -> str:
    """A change to 1e-6."""
    numbers = (change.stamp_from_s, change.stamp_to_s, *change.displacement_m, change.rotation_rad, change.probability)
    rounded = [float(np.round(number, 6)) + 0.0 for number in numbers]
    return str((change.kind.value, change.landmark_ids, rounded, change.n_hits, change.n_misses))


@pytest.mark.slow
@pytest.mark.parametrize("order", ANYHOW[1:], ids=str)
def test_the_story_does_not_depend_on_who_tells_it_first(order: tuple[int, ...]) -> None:
    """Of all sessions, and between any two instants, changes and probabilities are the same to 1e-6."""
    wanted, found = tell_in(ANYHOW[0]), tell_in(order)
    assert found == {span: wanted[span] for span in found}
    assert len([span for span in found if span[0] == "told by"]) == 3
    assert sum(len(lines) for span, lines in found.items() if span[0] in ("since", "told by")) > 5
    assert sum(len(lines) for span, lines in found.items() if span[0] == "seen by") > 60


def test_an_operators_word_is_kept(tmp_path: Path) -> None:
    with open_store(begun(tmp_path, 0, 1)) as store:
        landmark = int(store.load().members.landmark_id[2])
        edited(store, landmark)
        fed(store, SESSIONS[3])
        fed(store, SESSIONS[2])
        members = store.load().members
        assert members.landmark_id[members.pinned].tolist() == [landmark]


def test_a_session_is_evidence_once(tmp_path: Path) -> None:
    with open_store(begun(tmp_path, 0, 1)) as store:
        with pytest.raises(InputError, match="is in the map already, as revision 1"):
            em.enter_session(store, SESSIONS[0])
        assert store.head() == 2


def test_two_robots_at_once(tmp_path: Path) -> None:
    """The second begins while the first is at work; both are entered, whichever ends first."""
    first = SESSIONS[0]
    late_s = float(first.frames.stamp_s[0] + 10.0 - SESSIONS[1].frames.stamp_s[0])
    second = SESSIONS[1]
    second = replace(
        second,
        name="second robot",
        robot="second",
        odometry=replace(second.odometry, stamp_s=second.odometry.stamp_s + late_s),
        frames=replace(second.frames, stamp_s=second.frames.stamp_s + late_s),
    )
    both = (first, second)
    assert first.frames.stamp_s[0] < second.frames.stamp_s[0] < first.frames.stamp_s[-1]
    assert_same(built(tmp_path / "a.evermap", (0, 1), both), built(tmp_path / "b.evermap", (1, 0), both))


def test_without_history_a_late_session_is_refused() -> None:
    living = em.run_session(SESSIONS[1]).living
    with pytest.raises(DataError, match="before the newest session of the map"):
        em.run_session(SESSIONS[0], living)


def test_a_revision_without_its_recording_is_named(tmp_path: Path) -> None:
    with open_store(tmp_path / "site.evermap", create=True) as store:
        living = em.run_session(SESSIONS[1]).living
        store.commit(living, Provenance(stamp_from_s=float(SESSIONS[1].frames.stamp_s[0])), parent=0)
        with pytest.raises(InputError, match="revision 1 has no stored recording"):
            em.enter_session(store, SESSIONS[0])


def test_a_pruned_map_goes_on_as_if_it_were_whole(tmp_path: Path, in_order: LivingMap) -> None:
    with open_store(begun(tmp_path, 0, 1, 2)) as store:
        assert store.prune(1).revisions == (1, 2)
        with pytest.raises(InputError, match="is in the map already, as revision 1"):
            em.enter_session(store, SESSIONS[0])
        fed(store, SESSIONS[3])
        living = store.load()
    assert repr(living) == repr(in_order)
    assert_same(living, in_order)


def test_a_late_session_starts_from_a_revision_that_is_kept(tmp_path: Path, in_order: LivingMap) -> None:
    with open_store(begun(tmp_path, 0, 1, 3)) as store:
        assert store.prune(2).kept == (2, 3)
        fed(store, SESSIONS[2])
        assert_same(store.load(), in_order)


def test_a_late_session_before_what_is_kept_is_refused(tmp_path: Path) -> None:
    with open_store(begun(tmp_path, 0, 1, 3)) as store:
        store.prune(1)
        line = (
            f"site.evermap: {SESSIONS[2].name}: begins before the session of revision 3, but the content of revision 2 "
            "is pruned since "
        )
        with pytest.raises(InputError, match=r"kept: 3 \(try: an older copy of the file") as caught:
            em.enter_session(store, SESSIONS[2])
        assert line in caught.value.one_line()
        assert store.head() == 3


def test_the_map_as_it_was(tmp_path: Path) -> None:
    with open_store(begun(tmp_path, 0, 1, 2)) as store:
        for k in (0, 1, 2):
            assert at_time(store, float(SESSIONS[k].frames.stamp_s[-1])).stamp_s == store.load(k + 1).stamp_s
        assert at_time(store, 0.0).stamp_s == store.load(1).stamp_s


def test_a_recording_survives_being_kept() -> None:
    recording = SESSIONS[0]
    data = pack_recording(recording)
    assert data == pack_recording(recording)
    found = unpack_recording(data)
    for table in ("odometry", "frames", "detections"):
        for name in getattr(recording, table).__slots__:
            np.testing.assert_array_equal(
                getattr(getattr(found, table), name), getattr(getattr(recording, table), name)
            )
    assert (found.sensor, found.name, found.class_names, found.clock) == (
        recording.sensor,
        recording.name,
        recording.class_names,
        recording.clock,
    )
    assert found.truth is None


def test_a_configuration_is_read_back_from_a_revision() -> None:
    config = Config.model_validate({"living": {"returns": False}, "slam": {"seed": 7}})
    assert parse_config(to_toml(config)) == config
    assert parse_config("") == Config()
    # of a map that was written before these keys were retired
    assert parse_config("[living.lifetimes]\nprior_quantiles = 64\nnewest = 200\n").living.lifetimes.newest == 200
    for name in RETIRED:
        section, _, key = name.rpartition(".")
        assert parse_config(f"[{section}]\n{key} = 0.1\n") == Config()
