"""What is told of several sessions together: net effects of made-up changes, and of real sessions."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_maps import random_map
from typer.testing import CliRunner

import evermap as em
from evermap.cli.main import app
from evermap.maps.diff import Difference, diff, edits, grown, net, read_log, story_of
from evermap.maps.living import LivingMap, Members, Places, Sites, Stays
from evermap.maps.store import MapStore, Provenance, RevisionKind, open_store
from evermap.maps.store.content import DamagedError
from evermap.maps.store.history import read_story
from evermap.maps.why import why
from evermap.types import ChangeKind, MapChange, rows_of

APPEARED, VANISHED, RETURNED = ChangeKind.APPEARED, ChangeKind.VANISHED, ChangeKind.RETURNED
MOVED, SWAPPED = ChangeKind.MOVED, ChangeKind.SWAPPED
EMPTY = LivingMap()


def a_map(places: dict[int, tuple[float, float]], away: tuple[int, ...] = (), stamp_s: float = 100.0) -> LivingMap:
    """Landmarks that each are a clique of their own at one site; those that are away are known, too."""
    names = np.array(sorted([*places, *away]), dtype=np.int64)
    stands = ~np.isin(names, away)
    count = len(names)
    zeros = np.zeros(count)
    p_here = np.where(stands, 0.9, 0.05)
    position = np.array([places.get(int(name), (50.0, 50.0)) for name in names]).reshape(-1, 2)
    return LivingMap(
        stamp_s=stamp_s,
        members=Members(names, np.full(count, -1), names, *np.zeros((2, count), dtype=np.bool_)),
        sites=Sites(names, names, p_here, p_here, zeros, zeros + stamp_s),
        places=Places(names, names, position, *np.zeros((2, count), dtype=np.int64)),
        stays=Stays(
            names, names, np.full(count, -1), position, zeros - np.inf, zeros, zeros + 1.0,
            np.where(stands, np.inf, 2.0), np.where(stands, 0.0, 1.0),
        ),
        covariance_m2=1e-4 * np.eye(2 * count),
        n_cliques_ever=1000,
        n_sites_ever=1000,
    )  # fmt: skip


def test_a_replacement_is_one_change_until_more_is_told_of_either() -> None:
    before, after = a_map({1: HERE}), a_map({2: HERE}, away=(1,))
    other = told(ChangeKind.REPLACED, 1, 2, by=(0.1, 0.0))
    assert net([((other,), False), ((), False)], before, after) == (other,)
    left = told(VANISHED, 2, at=20.0)
    found = net([((other,), False), ((left,), False)], before, a_map({}, away=(1, 2)))
    assert [(one.kind, one.landmark_ids) for one in found] == [(VANISHED, (1,))]
    assert (found[0].n_hits, found[0].n_misses) == (0, 2)  # its hits were those of what came
    back = told(RETURNED, 1, at=20.0, by=(0.0, 0.0))
    found = net([((other,), False), ((back,), False)], before, a_map({1: HERE, 2: THERE}))
    assert [(one.kind, one.landmark_ids) for one in found] == [(APPEARED, (2,))]
    assert (found[0].n_hits, found[0].n_misses) == (3, 0)
    for one in found:
        assert (one.stamp_from_s, one.stamp_to_s, one.probability) == (10.0, 15.0, 0.9)
        assert np.isnan(one.displacement_m).all()


def told(kind: ChangeKind, *names: int, at: float = 10.0, by: tuple[float, float] | None = None, p: float = 0.9):
    nowhere = (np.nan, np.nan)
    return MapChange(names, kind, at, at + 5.0, nowhere if by is None else by, 0.0, p, 3, 2)


HERE, THERE, FAR = (1.0, 2.0), (4.0, 2.0), (9.0, 9.0)


@pytest.mark.parametrize(
    ("sessions", "before", "after", "expected"),
    [
        pytest.param([[told(VANISHED, 5)], []], a_map({5: HERE}), a_map({}, (5,)), VANISHED, id="one change as it was"),
        pytest.param([[told(VANISHED, 5)], [told(RETURNED, 5, by=(0.0, 0.0))]], a_map({5: HERE}), a_map({5: HERE}),
                     None, id="left and came back"),
        pytest.param([[told(VANISHED, 5)], []], a_map({5: HERE}), a_map({5: HERE}), None, id="had never left"),
        pytest.param([[told(VANISHED, 5)], [told(RETURNED, 5, by=(3.0, 0.0))]], a_map({5: HERE}), a_map({5: THERE}),
                     MOVED, id="left and came back elsewhere"),
        pytest.param([[told(MOVED, 5, by=(1.0, 0.0))], [told(MOVED, 5, by=(2.0, 0.0))]], a_map({5: HERE}),
                     a_map({5: THERE}), MOVED, id="moved twice"),
        pytest.param([[told(MOVED, 5, by=(3.0, 0.0))], [told(MOVED, 5, by=(-3.0, 0.0))]], a_map({5: HERE}),
                     a_map({5: HERE}), None, id="moved and moved back"),
        pytest.param([[told(MOVED, 5, by=(3.0, 0.0))], [told(VANISHED, 5)]], a_map({5: HERE}), a_map({}, (5,)),
                     VANISHED, id="moved, then gone"),
        pytest.param([[told(APPEARED, 5)], [told(VANISHED, 5)]], EMPTY, a_map({}, (5,)), None, id="came and went"),
        pytest.param([[told(APPEARED, 5)], [told(MOVED, 5, by=(3.0, 0.0))]], EMPTY, a_map({5: THERE}), APPEARED,
                     id="appeared and was moved"),
        pytest.param([[told(RETURNED, 5, by=(0.0, 0.0))], [told(VANISHED, 5)]], a_map({}, (5,)), a_map({}, (5,)), None,
                     id="was here for a session"),
        pytest.param([[], [told(VANISHED, 5)]], EMPTY, a_map({}, (5,)), None, id="the map grew, then it was gone"),
        pytest.param([[], [told(MOVED, 5, by=(3.0, 0.0))]], EMPTY, a_map({5: THERE}), None, id="grew, then it moved"),
    ],
)  # fmt: skip
def test_net_effect(sessions, before: LivingMap, after: LivingMap, expected: ChangeKind | None) -> None:
    found = net([(changes, False) for changes in sessions], before, after)
    assert [change.kind for change in found] == ([] if expected is None else [expected])
    if expected is MOVED:
        np.testing.assert_allclose(found[0].displacement_m, np.subtract(THERE, HERE))


def test_a_composed_change_rests_on_all_that_led_to_it() -> None:
    sessions = [
        ([told(APPEARED, 5, at=10.0, p=0.8)], False),
        ([told(VANISHED, 5, at=20.0, p=0.7)], False),
        ([told(RETURNED, 5, at=30.0, by=(0.0, 0.0), p=0.6)], False),
        ([told(MOVED, 5, at=40.0, by=(3.0, 0.0), p=0.5)], False),
    ]
    (change,) = net(sessions, EMPTY, a_map({5: THERE}))
    assert change.kind is APPEARED
    assert change.probability == pytest.approx(0.6 * 0.5)  # since it came for the last time
    assert (change.stamp_from_s, change.stamp_to_s) == (30.0, 45.0)
    assert (change.n_hits, change.n_misses) == (6, 4)
    assert np.isnan(change.displacement_m).all()


def test_landmarks_of_a_body_part_where_their_histories_do() -> None:
    sessions = [([told(MOVED, 5, 6, by=(3.0, 0.0))], False), ([told(VANISHED, 6, at=30.0)], False)]
    found = net(sessions, a_map({5: HERE, 6: (1.0, 3.0)}), a_map({5: THERE}, (6,)))
    assert {change.landmark_ids: change.kind for change in found} == {(5,): MOVED, (6,): VANISHED}
    np.testing.assert_allclose(next(c for c in found if c.kind is MOVED).displacement_m, (3.0, 0.0))


def test_two_that_stand_in_each_others_place_in_the_end_were_swapped() -> None:
    sessions = [
        ([told(MOVED, 1, by=(0.0, 9.0))], False),
        ([told(MOVED, 2, by=(-3.0, 0.0))], False),
        ([told(MOVED, 1, by=(3.0, -9.0))], False),
    ]
    (change,) = net(sessions, a_map({1: HERE, 2: THERE}), a_map({1: THERE, 2: HERE}))
    assert (change.kind, change.landmark_ids) == (SWAPPED, (1, 2))
    back = [*sessions, ([told(SWAPPED, 1, 2, by=(-3.0, 0.0))], False)]
    assert net(back, a_map({1: HERE, 2: THERE}), a_map({1: HERE, 2: THERE})) == ()


def test_one_session_is_told_word_for_word() -> None:
    changes = (told(MOVED, 99, by=(0.01, 0.0)), told(VANISHED, 7))
    assert net([(changes, False)], EMPTY, EMPTY) == changes


@pytest.mark.parametrize(
    ("change", "before", "after", "expected"),
    [
        (told(VANISHED, 5), a_map({}, (5,)), a_map({5: HERE}), RETURNED),
        (told(APPEARED, 5), a_map({5: HERE}), EMPTY, VANISHED),
        (told(RETURNED, 5, by=(0.0, 0.0)), a_map({5: HERE}), a_map({}, (5,)), VANISHED),
        (told(MOVED, 5, by=(3.0, 0.0)), a_map({5: THERE}), a_map({5: HERE}), MOVED),
        (told(APPEARED, 5), a_map({5: HERE}), a_map({5: HERE}), None),  # told of another way to the same map
    ],
)
def test_the_way_back_undoes_what_was_told(
    change: MapChange, before: LivingMap, after: LivingMap, expected: ChangeKind | None
) -> None:
    found = net([((change,), True)], before, after)
    assert [one.kind for one in found] == ([] if expected is None else [expected])
    if expected is MOVED:
        np.testing.assert_allclose(found[0].displacement_m, (-3.0, 0.0))


def test_what_stands_and_was_not_known_is_grown_unless_told_of() -> None:
    after = a_map({5: HERE, 6: THERE, 7: FAR}, (8,))
    assert grown(np.array([5]), after, []).tolist() == [6, 7]
    assert grown(np.array([5]), after, [told(APPEARED, 6)]).tolist() == [7]


@pytest.mark.parametrize("seed", range(5))
def test_a_map_differs_by_nothing_from_itself(seed: int) -> None:
    living = random_map(seed)
    assert net([], living, living) == ()
    assert edits(living.members, living.members) == ()
    assert not len(grown(living.members.landmark_id, living, ()))


def test_edits_are_what_operators_said() -> None:
    living = a_map({5: HERE})
    assert edits(living.members, living.edited(5, pinned=True, deleted=True).members) == ((5, "deleted"), (5, "pinned"))
    assert edits(living.edited(5, deleted=True).members, living.members) == ((5, "undeleted"),)


# --- sessions of a building, of which each sees a part ---

KEYS = [
    "landmarks", "kind", "stamp_from_s", "stamp_to_s", "displacement_m", "displacement_covariance_m2", "rotation_rad",
    "probability", "hits", "misses", "names", "stamp_s", "decided_s",
]  # fmt: skip
QUICK = [
    "--set",
    "output.figures=false",
    "--set",
    "output.rerun=false",
    "--set",
    "slam.calibration.fix.range_slope=0.0",
]


REPORTS = (0, 2)


def run(*arguments: str | Path | int):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result


def said(*arguments: str | Path | int):
    return json.loads(run(*arguments, "--json").stdout)


def part_of(recording: em.Recording, begin: float, end: float) -> em.Recording:
    """The frames between two shares of a patrol: the rest of the building is not looked at."""
    frames = recording.frames
    stamps = frames.stamp_s
    first_s, last_s = (stamps[0] + share * np.ptp(stamps) for share in (begin, end))
    kept = np.flatnonzero((stamps >= first_s) & (stamps <= last_s))
    seen = rows_of(recording.detections, np.isin(recording.detections.frame, kept))
    seen = replace(seen, frame=np.searchsorted(kept, seen.frame))
    return replace(recording, frames=replace(frames, stamp_s=stamps[kept]), detections=seen)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of five days of which three see only a part, each with its run folder beside it."""
    from evermap.io import write_native
    from evermap_studies.sim import BuildingConfig, SimulatedSensor, simulate_building

    folder = tmp_path_factory.mktemp("site")
    config = BuildingConfig(days=5, patrol_s=60.0, length_m=14.0, depth_m=13.0, rooms_per_side=1, change_rate=2.0,
                            sensor=SimulatedSensor(range_slope=0.0, rate_hz=2.0))  # fmt: skip
    views = [(0.0, 0.6), (0.0, 1.0), (0.3, 1.0), (0.0, 1.0), (0.0, 0.7)]
    for day, (recording, view) in enumerate(zip(simulate_building(config, seed=11).sessions, views, strict=True)):
        write_native(part_of(recording, *view), folder / f"day{day}")
        run("map", "enter", folder / "site.evermap", folder / f"day{day}", "--out", folder / f"out{day}", *QUICK,
            "--set", f"output.report={str(day in REPORTS).lower()}")  # fmt: skip
    return folder / "site.evermap"


def test_log_diff_folder_and_report_say_the_same(site: Path) -> None:
    revisions = said("map", "log", site)["revisions"]
    kinds = Counter()
    for number, revision in enumerate(revisions, start=1):
        out = site.parent / f"out{number - 1}"
        between = said("map", "diff", site, number - 1, number)
        summary = json.loads((out / "summary.json").read_text())
        lines = [json.loads(line) for line in (out / "changes.jsonl").read_text().splitlines()]
        assert between["changes"] == summary["changes"] == lines
        assert all(list(change) == KEYS for change in (*between["changes"], *lines))
        assert revision["changes"] == dict(Counter(change["kind"] for change in lines))
        assert revision["grown"] == len(between["grown"]) == summary["counts"]["landmarks_grown"]
        kinds += Counter(change["kind"] for change in lines)
        with open_store(site) as store:
            assert list(store.changes(number)) == list(diff(store, number - 1, number).changes)
        if number - 1 not in REPORTS:
            continue
        report = (out / "report.html").read_text()
        spoken = run("map", "diff", site, number - 1, number).stdout.splitlines()
        for change, line in zip(lines, spoken, strict=False):
            words, probability = line.split(" between ")[0].split(" before ")[0], line.split(", probability ")[1]
            probability = probability.split(" (")[0].replace(">", "&gt;").replace("<", "&lt;")
            assert f"{words} " in report
            assert f"probability {probability}" in report
            assert change["kind"] in ("moved", "rotated", "swapped") or change["kind"] in words
        assert (f"the map grew by {revision['grown']} " in report) == bool(revision["grown"])
    assert revisions[0]["changes"] == {}
    assert revisions[0]["grown"] > 10
    assert revisions[1]["grown"] > 0  # the part that the first day did not see
    assert {"moved", "vanished"} <= set(kinds)
    assert kinds["appeared"] + kinds["returned"] > 0


def test_over_several_revisions_only_what_was_told_is_composed(site: Path) -> None:
    with open_store(site) as store:
        for a in range(store.head() + 1):
            for b in range(a + 1, store.head() + 1):
                found = diff(store, a, b)
                before, after = store.load(a), store.load(b)
                named = [name for change in found.changes for name in change.landmark_ids]
                assert len(named) == len(set(named))
                spoken = {n for k in range(a + 1, b + 1) for c in store.changes(k) for n in c.landmark_ids}
                assert set(named) <= spoken
                assert not set(named) & set(found.grown.tolist())
                assert not set(found.grown.tolist()) & set(before.members.landmark_id.tolist())
                if b > a + 1:  # what stood and what stands, by the maps themselves
                    assert_ends_fit(found, before, after)


def assert_ends_fit(found: Difference, before: LivingMap, after: LivingMap) -> None:
    stood, stands = (
        set(living.members.landmark_id[living.find_current_site() >= 0].tolist()) for living in (before, after)
    )
    for change in found.changes:
        came = change.kind in (APPEARED, RETURNED)
        assert all((name in stood) != came for name in change.landmark_ids), change
        assert all((name in stands) == (change.kind is not VANISHED) for name in change.landmark_ids), change
        assert 0.0 <= change.probability <= 1.0
        assert not change.stamp_from_s > change.stamp_to_s


def test_backwards_and_over_a_revert_everything_is_undone(site: Path, tmp_path: Path) -> None:
    path = tmp_path / "site.evermap"
    path.write_bytes(site.read_bytes())
    with open_store(path) as store:
        there, back = diff(store, 2, 5), diff(store, 5, 2)
        came = {n for c in there.changes if c.kind in (APPEARED, RETURNED) for n in c.landmark_ids}
        left = {n for c in there.changes if c.kind is VANISHED for n in c.landmark_ids}
        assert {n for c in back.changes if c.kind is VANISHED for n in c.landmark_ids} == came
        assert {n for c in back.changes if c.kind is RETURNED for n in c.landmark_ids} == left
        head = store.revert(2)
        assert diff(store, 2, head).changes == ()
        undone = diff(store, 5, head)
        assert [(c.kind, c.landmark_ids) for c in undone.changes] == [(c.kind, c.landmark_ids) for c in back.changes]


def test_an_edit_is_told_beside_the_changes(site: Path, tmp_path: Path) -> None:
    path = tmp_path / "site.evermap"
    path.write_bytes(site.read_bytes())
    with open_store(path) as store:
        head, living = store.head(), store.load()
        name = int(living.members.landmark_id[0])
        store.commit(living.edited(name, pinned=True), Provenance(kind=RevisionKind.EDIT), parent=head)
        assert diff(store, head).edits == ((name, "pinned"),)
        assert diff(store, head).changes == ()
        assert diff(store, head - 1).changes == tuple(c for c in diff(store, head - 1, head).changes)


@pytest.mark.slow
def test_a_late_session_is_told_as_if_it_had_come_in_time(site: Path, tmp_path: Path) -> None:
    """It, those after it, and whatever lies between two instants; the instant of the newest map stays as it was."""
    with open_store(tmp_path / "late.evermap", create=True) as store, open_store(site) as in_time:
        fed = [fed_into(store, site.parent / f"day{day}") for day in (0, 1, 3, 2)]
        assert fed[-1].replayed
        assert_told_alike(store.changes(4), in_time.changes(3))
        assert_told_alike(fed[-1].changes, in_time.changes(3))
        story = story_of(store)
        assert [one.revision for one in story] == [1, 2, 4, 3]
        for one, wanted in zip(story, story_of(in_time, 4), strict=True):
            assert_told_alike(one.changes, wanted.changes)
            assert one.n_grown == wanted.n_grown
        assert diff(store, 3, 4).changes == ()
        assert diff(store, 4, 3).changes == ()
        for a in range(3):
            assert_told_alike(diff(store, a, 4).changes, diff(in_time, a, 4).changes)
            assert_told_alike(diff(store, 4, a).changes, diff(in_time, 4, a).changes)
        log, wanted_log = read_log(store), in_time.log()
        assert [log[k].n_changes for k in (0, 1, 3, 2)] == [item.n_changes for item in wanted_log[:4]]
        assert log[2].n_changes != store.log()[2].n_changes  # as the third session told it without the late one
        name = next(c for c in story[-1].changes if c.kind is MOVED).landmark_ids[0]
        answer = why(store, name)
        assert [number for number, _ in answer.changes] == [
            one.revision for one in story for change in one.changes if name in change.landmark_ids
        ]
        line = next(item for item in store.attachments() if item.name == "story")
        assert read_story(store.attached(line), 4) == (2, story[2:])
        with pytest.raises(DamagedError, match="the story of revision 4 is not valid"):
            read_story(b"{}", 4)


def assert_told_alike(some: Sequence[MapChange], wanted: Sequence[MapChange]) -> None:
    """To 1e-6, in any order."""
    some, wanted = (sorted(told, key=lambda c: (c.kind.value, c.landmark_ids)) for told in (some, wanted))
    assert [(c.kind, c.landmark_ids, c.n_hits, c.n_misses) for c in some] == [
        (c.kind, c.landmark_ids, c.n_hits, c.n_misses) for c in wanted
    ]
    for one, other in zip(some, wanted, strict=True):
        numbers = [
            (c.stamp_from_s, c.stamp_to_s, *c.displacement_m, c.rotation_rad, c.probability) for c in (one, other)
        ]
        np.testing.assert_allclose(*numbers, atol=1e-6, rtol=0.0)


def test_it_moved_by_the_sum_of_its_moves_whatever_became_of_the_frame() -> None:
    """Two maps may have their origins where their first sessions began; what is told lies between places of one map."""
    sessions = [([told(MOVED, 5, by=(1.0, 0.0))], False), ([told(MOVED, 5, by=(2.0, 0.0))], False)]
    (change,) = net(sessions, a_map({5: (40.0, 7.0)}), a_map({5: THERE}))
    np.testing.assert_allclose(change.displacement_m, (3.0, 0.0))
    there_and_back = [([told(MOVED, 5, by=(1.0, 0.0))], False), ([told(MOVED, 5, by=(-1.0, 0.0))], False)]
    assert net(there_and_back, a_map({5: (40.0, 7.0)}), a_map({5: HERE})) == ()
    swapped = [
        ([told(MOVED, 1, by=(3.0, 0.0))], False),
        ([told(MOVED, 2, by=(-3.0, 0.0))], False),
    ]
    (change,) = net(swapped, a_map({1: FAR, 2: FAR}), a_map({1: THERE, 2: HERE}))
    assert (change.kind, change.landmark_ids) == (SWAPPED, (1, 2))


def test_of_two_sessions_that_begin_at_once_each_tells_its_own(tmp_path: Path) -> None:
    at_once = Provenance(recording="patrol", stamp_from_s=5.0, stamp_to_s=9.0)
    with open_store(tmp_path / "map.evermap", create=True) as store:
        store.commit(a_map({5: HERE}), at_once, parent=0)
        moved = told(MOVED, 5, by=(3.0, 0.0))
        store.commit(a_map({5: THERE}), at_once, [moved], parent=1)
        assert diff(store, 1, 2).changes == (moved,)
        assert [change.kind for change in diff(store, 2, 1).changes] == [MOVED]


def test_what_came_into_the_map_on_the_way_grew_it_whatever_the_earlier_map_knew() -> None:
    sessions = [([], False), ([told(MOVED, 5, by=(3.0, 0.0))], False)]
    assert net(sessions, a_map({5: HERE}), a_map({5: THERE}), new=frozenset({5})) == ()
    (change,) = net(sessions, EMPTY, a_map({5: THERE}), new=frozenset())
    assert change.kind is MOVED


def fed_into(store: MapStore, recording: Path) -> em.Entered:
    config = em.load_config(None, ["slam.calibration.fix.range_slope=0.0"])
    entered = em.enter_session(store, em.read_recording(recording), config)
    entered.commit(store, config)
    return entered
