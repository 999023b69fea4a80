"""Sessions of landmarks without identity into one map, against their true identities."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from evermap.config import Config, OverlayConfig
from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap.geometry.group import PLANE, SPACE, Group
from evermap.geometry.rigid import rigid
from evermap.maps.living import LivingMap, MemberTraits
from evermap.maps.sessions.believe import Witnessed
from evermap.maps.sessions.decide import doubt_moves
from evermap.maps.sessions.extend import Extended
from evermap.maps.sessions.nameless import hold_at, without_ids
from evermap.maps.sessions.session import Session, with_traits
from evermap.maps.store import open_store
from evermap.pipeline import run_localization
from evermap.runs.edits import rename_landmark
from evermap.runs.sessions import enter_session
from evermap.slam.association.assignment import density_of_unmet
from evermap.slam.association.constellation import LocalMap
from evermap.types import MASK_ID, UNKNOWN, ChangeKind, IntArray, Landmarks, MapChange, Recording, is_in_space, rows_of
from evermap_studies.sim import BuildingSimulation, WarehouseConfig, simulate_warehouse

from .buildings import FIXED, building, lived_through

NAMELESS = Config(slam=FIXED.model_copy(update={"unknown_ids": True}))


@pytest.mark.parametrize("group", [PLANE, SPACE], ids=["plane", "space"])
def test_what_is_held_is_predicted_by_the_others(group: Group) -> None:
    """Against conditioning one at a time on the differences of all others, written down densely."""
    rng, dim = np.random.default_rng(0), group.point_dim
    count, held = 7, np.array([0, 2, 3, 5, 6])
    place = rng.normal(0.0, 5.0, (count, dim))
    root = rng.normal(0.0, 0.05, (dim * count, dim * count))
    local = LocalMap(place, root @ root.T + 1e-3 * np.eye(dim * count))
    known = np.diag(rng.uniform(1e-4, 1e-2, dim * len(held)))
    motion = group.exp(rng.normal(0.0, 1.0, group.dim))
    at = group.transform(motion, place)[held] + rng.normal(0.0, 0.05, (len(held), dim))
    drift_m = 0.03
    found = hold_at(local, held, at, known, OverlayConfig(drifts_m=(drift_m,), drifts_in_space_m=()))
    assert found.drift_m == drift_m

    about = rigid(place[held], at)
    own = group.transform(about, place)
    turn = np.kron(np.eye(count), group.rotation_of(about))
    free = group.rigid_directions(own - own[held].mean(axis=0)) * np.repeat([20.0, 3.0], [dim, group.dim - dim])
    prior = turn @ local.covariance @ turn.T + free @ free.T
    noise = known + drift_m**2 * np.eye(len(known))
    for k in range(count):
        others = np.flatnonzero(held != k)
        rows, of = se2.xy_rows(held[others], dim), se2.xy_rows(others, dim)
        gain = prior[:, rows] @ np.linalg.inv(prior[np.ix_(rows, rows)] + noise[np.ix_(of, of)])
        mean = own.ravel() - gain @ (own[held[others]] - at[others]).ravel()
        spread = prior - gain @ prior[rows]
        mine = slice(dim * k, dim * k + dim)
        np.testing.assert_allclose(found.position_m[k], mean[mine], atol=1e-6)
        np.testing.assert_allclose(found.covariance_m2[k], spread[mine, mine], atol=1e-6)


@cache
def live_through(days: int) -> tuple[BuildingSimulation, list[Session]]:
    """The first days of a building, in a map without names."""
    one = building(0)
    return one, lived_through(one.sessions[:days], NAMELESS)


@pytest.fixture(scope="module")
def lived() -> tuple[BuildingSimulation, list[Session]]:
    return live_through(2)


def names(one: BuildingSimulation, sessions: list[Session], k: int) -> dict[int, int]:
    """What the map calls the landmarks that a session detected, by their true ids."""
    given, true = sessions[k].recording.detections, one.truths[k].detection_landmark_id
    assert len(given) == len(true)
    return {
        int(name): int(np.bincount(true[(given.landmark_id == name) & (true >= 0)]).argmax())
        for name in np.unique(given.landmark_id[(given.landmark_id >= 0) & (true >= 0)])
    }


def met_again(one: BuildingSimulation, sessions: list[Session]) -> tuple[int, int]:
    """How many landmarks were met in two sessions one after the other, and how many of them under two names."""
    again = wrong = 0
    for k in range(1, len(sessions)):
        before, now = names(one, sessions, k - 1), names(one, sessions, k)
        both = before.keys() & now.keys()
        again += len(both)
        wrong += sum(before[name] != now[name] for name in both)
    return again, wrong


@pytest.mark.parametrize("days", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_landmarks_keep_their_names_over_sessions(days: int) -> None:
    one, sessions = live_through(days)
    assert all(session.found for session in sessions)
    again, wrong = met_again(one, sessions)
    assert again > 40 * (days - 1) / 3
    assert wrong <= 0.05 * again


def test_the_map_is_as_large_as_that_of_named_landmarks(lived: tuple[BuildingSimulation, list[Session]]) -> None:
    one, sessions = lived
    named = lived_through(one.sessions[: len(sessions)], Config(slam=FIXED))
    for mine, theirs in zip(sessions, named, strict=True):
        count = [int((session.living.p_exists() >= 0.5).sum()) for session in (mine, theirs)]
        assert abs(count[0] - count[1]) <= 0.2 * count[1]


@pytest.mark.slow
def test_ids_of_the_recording_are_not_looked_at(lived: tuple[BuildingSimulation, list[Session]]) -> None:
    one, sessions = lived
    again = lived_through([without_ids(recording, NAMELESS) for recording in one.sessions[:2]], NAMELESS)
    assert again[1].living.landmark_texts == sessions[1].living.landmark_texts
    np.testing.assert_array_equal(again[1].living.places.position_m, sessions[1].living.places.position_m)


def test_what_left_is_believed_in_less_and_what_an_operator_deleted_does_not_come_back(
    lived: tuple[BuildingSimulation, list[Session]],
) -> None:
    one, sessions = lived
    before, now, true = names(one, sessions, 0), names(one, sessions, 1), one.truths[1].detection_landmark_id
    seen = np.bincount(true[true >= 0])
    gone = max((name for name in before if now.get(name) == before[name]), key=lambda name: int(seen[before[name]]))
    kept = true != before[gone]
    without = replace(one.sessions[1], detections=rows_of(one.sessions[1].detections, kept))
    session = lived_through([without], NAMELESS, sessions[0].living)[0]
    assert session.living.p_exists()[session.living.members.landmark_id == gone] < 0.8
    edited = sessions[0].living.edited(gone, deleted=True)
    session = lived_through([one.sessions[1]], NAMELESS, edited)[0]
    assert gone not in session.recording.detections.landmark_id
    grown = np.setdiff1d(session.living.members.landmark_id, edited.members.landmark_id)
    assert len(grown) == len(np.setdiff1d(sessions[1].living.members.landmark_id, edited.members.landmark_id))


@pytest.mark.slow
def test_landmarks_without_a_name_keep_company_with_those_that_have_one() -> None:
    """Every other landmark has its name in all sessions; the others get theirs from the map."""
    one, mixed = building(0), Config(slam=FIXED.model_copy(update={"unknown_ids": "empty"}))
    some = [
        replace(each, detections=replace(each.detections, landmark_id=np.where(known, own, UNKNOWN)))
        for each in one.sessions
        for own in [each.detections.landmark_id]
        for known in [own % 2 == 0]
    ]
    sessions = lived_through(some, mixed)
    assert all(session.found for session in sessions)
    for session, recording in zip(sessions[1:], some[1:], strict=True):
        given, own = session.recording.detections.landmark_id, recording.detections.landmark_id
        np.testing.assert_array_equal(given[own != UNKNOWN], own[own != UNKNOWN])
    again, wrong = met_again(one, sessions)
    assert again > 40
    assert wrong <= 0.03 * again


@pytest.mark.slow
def test_a_large_map_that_shows_no_constellation_of_the_session_refuses_it() -> None:
    """The index has no motion to offer then; in a map of the same size that has its landmarks, the session is found."""
    recording = simulate_warehouse(WarehouseConfig(n_landmarks=40, rate_hz=1.0))
    assert recording.true_landmarks is not None
    row = np.column_stack([7.0 * np.arange(150), np.zeros(150)])
    there = np.vstack([recording.true_landmarks.position_m, row[40:] + 300.0])
    refused, found = (
        lived_through([recording], NAMELESS, LivingMap.begun(Landmarks.at(np.arange(150), place)))[0].found
        for place in (row, there)
    )
    assert not refused
    assert found


@pytest.mark.slow
def test_a_session_of_another_building_is_refused(lived: tuple[BuildingSimulation, list[Session]]) -> None:
    _, sessions = lived
    other = lived_through([building(7).sessions[1]], NAMELESS, sessions[0].living)[0]
    assert not other.found
    assert other.living is sessions[0].living or len(other.living.places) == len(sessions[0].living.places)


@pytest.mark.slow
def test_a_late_session_makes_the_map_of_the_right_order(
    tmp_path: Path,
) -> None:
    one, sessions = live_through(4)
    with open_store(tmp_path / "map.evermap", create=True) as store:
        for k in (0, 2, 1):
            entered = enter_session(store, one.sessions[k], NAMELESS)
            entered.commit(store, NAMELESS)
            if k == 2:  # what an operator calls it holds in all sessions, which are entered again or not
                first = int(store.load().members.landmark_id[0])
                rename_landmark(store, str(first), "the first")
        late = store.load()
    assert late.landmark_texts == sessions[2].living.landmark_texts
    assert late.landmark_names == {**sessions[2].living.landmark_names, first: "the first"}
    np.testing.assert_array_equal(late.members.landmark_id, sessions[2].living.members.landmark_id)
    np.testing.assert_array_equal(late.places.position_m, sessions[2].living.places.position_m)


def test_another_class_where_one_stood_is_one_change(lived: tuple[BuildingSimulation, list[Session]]) -> None:
    """Never that one vanished and another one appeared, as two facts; what stays is of the other class."""
    one, sessions = lived
    before, now = names(one, sessions, 0), names(one, sessions, 1)
    true = one.truths[1].detection_landmark_id
    seen = np.bincount(true[true >= 0])
    given, classes, called = one.sessions[1].detections, one.sessions[1].class_names, sessions[0].living.landmark_names
    alone = [name for name in before if now.get(name) == before[name] and called[name].startswith("marker")]
    name = max(alone, key=lambda name: int(seen[before[name]]))  # markers are on no body with others
    mine, other = true == before[name], classes.index("chair")
    changed = replace(given, class_id=np.where(mine, other, given.class_id))
    session = lived_through([replace(one.sessions[1], detections=changed)], NAMELESS, sessions[0].living)[0]
    told = [change for change in session.changes if name in change.landmark_ids]
    assert [change.kind for change in told] == [ChangeKind.REPLACED]
    assert told[0].probability > 0.9
    after, new = session.living.landmarks(), told[0].landmark_ids[1]
    assert not any(new in change.landmark_ids for change in session.changes if change is not told[0])
    row = after.landmark_id.tolist().index(new)
    assert after.class_names[int(after.class_id[row])] == "chair"


def test_what_stands_beside_a_place_is_the_same_or_another(lived: tuple[BuildingSimulation, list[Session]]) -> None:
    """Of landmarks without identity nothing tells a nudge from a replacement: the odds are those of the settings."""
    one, sessions = lived
    before, now, called = names(one, sessions, 0), names(one, sessions, 1), sessions[0].living.landmark_names
    true, given = one.truths[1].detection_landmark_id, one.sessions[1].detections
    seen = np.bincount(true[true >= 0])
    alone = [name for name in before if now.get(name) == before[name] and called[name].startswith("marker")]
    name = max(alone, key=lambda name: int(seen[before[name]]))
    mine = np.flatnonzero(true == before[name])
    pose = one.truths[1].pose_world_sensor[given.frame[mine]]
    angle = pose[:, 2] + given.bearing_rad[mine]
    off_m = given.range_m[mine, None] * np.column_stack([np.cos(angle), np.sin(angle)]) + [0.4, 0.3]
    range_m, bearing_rad = given.range_m.copy(), given.bearing_rad.copy()
    range_m[mine] = np.hypot(*off_m.T)
    bearing_rad[mine] = se2.wrap(np.arctan2(off_m[:, 1], off_m[:, 0]) - pose[:, 2])
    shifted = replace(given, range_m=range_m, bearing_rad=bearing_rad)
    moved = replace(one.sessions[1], detections=shifted)
    session = lived_through([moved], NAMELESS, sessions[0].living)[0]
    (told,) = (change for change in session.changes if change.landmark_ids == (name,))
    assert told.kind is ChangeKind.MOVED
    assert np.hypot(*told.displacement_m) == pytest.approx(0.5, abs=0.15)
    settings, spread_m2 = NAMELESS.living, np.array(told.displacement_covariance_m2)
    nudged, beside = (
        stats.multivariate_normal.pdf(np.array(told.displacement_m), np.zeros(2), spread_m2 + sigma_m**2 * np.eye(2))
        for sigma_m in (settings.overlay.nudge_m, settings.boxes.beside_m)
    )
    same = settings.overlay.share_nudged * nudged
    by_chance = density_of_unmet(session.living.landmarks().position_m)
    other = (1.0 - settings.overlay.share_nudged) * (settings.boxes.p_taken * beside + by_chance)
    assert told.probability == pytest.approx(same / (same + other), rel=0.03)
    assert 0.6 < told.probability < 0.85


def test_what_tells_that_it_is_the_same_leaves_its_move_certain(
    lived: tuple[BuildingSimulation, list[Session]],
) -> None:
    """Bodies of several, landmarks with an identity, boxes, described ones, and what was seen to leave."""
    living, config = lived[1][0].living, NAMELESS.living
    first, second = living.members.landmark_id[:2].tolist()
    place = np.arange(len(living.places))
    entry = Extended(living, living, living.places.landmark_id, place, np.zeros(0), np.zeros(0, dtype=np.bool_))
    move = MapChange((first,), ChangeKind.MOVED, 0.0, 1.0, (0.4, 0.3), 0.0, 0.99)

    def doubt(change: MapChange, entry: Extended = entry, seen: Witnessed | None = None) -> float:
        return doubt_moves((change,), seen or Witnessed.nothing(), entry, config)[0].probability

    assert doubt(move) < 0.9
    assert doubt(replace(move, landmark_ids=(first, second))) == 0.99
    assert doubt(replace(move, kind=ChangeKind.ROTATED)) == 0.99
    assert doubt(replace(move, landmark_ids=(12_345,))) == 0.99
    seen = Witnessed(np.array([first]), np.zeros(1), np.zeros(1), np.ones(1))
    assert doubt(move, seen=seen) == 0.99
    described = living.traits.met(np.array([first]), ("shine",), np.ones((1, 1)))
    box = replace(living.boxes, landmark_id=np.array([first]), size_m=np.ones((1, 3)))
    for known in (replace(living, traits=described), replace(living, boxes=box)):
        assert doubt(move, replace(entry, living=known)) == 0.99


def test_localising_frame_by_frame_needs_identities(lived: tuple[BuildingSimulation, list[Session]]) -> None:
    one, sessions = lived
    with pytest.raises(ConfigError, match="not causal"):
        run_localization(one.sessions[1], sessions[0].living, NAMELESS)


def with_descriptors(recording: Recording, true: IntArray, session: int, shift: float = 0.0) -> Recording:
    """Eight numbers that are each landmark's own, read with errors of a fifth; all off by a shift."""
    own = np.random.default_rng(5).normal(size=(1000, 8))[true]
    value = own + 0.2 * np.random.default_rng([6, session]).normal(size=own.shape) + shift
    names = tuple(f"descriptor_{k}" for k in range(8))
    return replace(recording, detections=replace(recording.detections, features=value, feature_names=names))


def test_masks_are_not_kept_of_landmarks(lived: tuple[BuildingSimulation, list[Session]]) -> None:
    """A radius is; the mask that it was seen in is not of the landmark itself."""
    _, sessions = lived
    living, recording = sessions[0].living, sessions[0].recording
    assert not is_in_space(recording)
    mask = np.ones((len(recording.detections), 1))
    masked = replace(recording.detections, features=mask, feature_names=(MASK_ID,))
    assert with_traits(living, replace(recording, detections=masked)) is living
    both = replace(masked, features=np.hstack([mask, 0.2 * mask]), feature_names=(MASK_ID, "radius_m"))
    traits = with_traits(living, replace(recording, detections=both)).traits
    assert len(traits) > 0
    assert np.unique(traits.value).tolist() == [0.2]


@pytest.fixture(scope="module")
def described(
    lived: tuple[BuildingSimulation, list[Session]], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Session]:
    """The file of a map of the first session with descriptors, to be copied; and that session."""
    one, _ = lived
    path = tmp_path_factory.mktemp("described") / "map.evermap"
    with open_store(path, create=True) as store:
        first = with_descriptors(one.sessions[0], one.truths[0].detection_landmark_id, 0)
        entered = enter_session(store, first, NAMELESS)
        entered.commit(store, NAMELESS)
    return path, entered.session


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_exchanged_landmarks_are_recognised_by_what_they_are_like(
    lived: tuple[BuildingSimulation, list[Session]], described: tuple[Path, Session], shift: float, tmp_path: Path
) -> None:
    """Two chairs or pallets of the second session stand where the other one stood; without columns nothing tells.

    What they are like is read from the file of the map, and kept there.
    """
    (one, plain), (file, begun) = lived, described
    first, second = (truth.detection_landmark_id.copy() for truth in one.truths[:2])
    assert len(plain[1].recording.detections) == len(second)
    both = names(one, plain, 0).keys() & names(one, plain, 1).keys()
    often = np.bincount(second[second >= 0], minlength=1000)
    kind = dict(zip(first.tolist(), one.sessions[0].detections.class_id.tolist(), strict=True))
    known = sorted((names(one, plain, 1)[name] for name in both), key=lambda real: -int(often[real]))
    a, b = next((a, b) for k, a in enumerate(known) for b in known[k + 1 :] if kind[a] == kind[b])
    changed = second.copy()
    changed[second == a], changed[second == b] = b, a
    named = {real: name for name, real in names(one, [begun], 0).items()}
    with open_store(shutil.copy(file, tmp_path / "map.evermap")) as store:
        entered = enter_session(store, with_descriptors(one.sessions[1], changed, 1, shift), NAMELESS)
        entered.commit(store, NAMELESS)
        kept = store.load().traits
    session = entered.session
    name = session.recording.detections.landmark_id
    for real in (a, b):
        assert np.bincount(changed[name == named[real]]).argmax() == real
    told = {i for change in session.changes if change.kind in (ChangeKind.MOVED, ChangeKind.SWAPPED)
            for i in change.landmark_ids}  # fmt: skip
    assert {named[a], named[b]} <= told
    assert not {change.kind for change in plain[1].changes if {named[a], named[b]} & set(change.landmark_ids)}
    assert session.living.traits.sessions.max() == 2
    for column in ("landmark_id", "column_id", "value", "sessions"):
        np.testing.assert_array_equal(getattr(kept, column), getattr(session.living.traits, column))


def test_a_map_keeps_the_mean_over_sessions_of_what_landmarks_are_like() -> None:
    """Against a dictionary of lists."""
    rng, columns = np.random.default_rng(0), ("radius_m", "colour_r", "descriptor_0")
    table, every = MemberTraits.empty(), dict[tuple[int, str], list[float]]()
    for _ in range(6):
        ids = np.sort(rng.permutation(12)[:7]).astype(np.int64)
        some = [columns[c] for c in np.sort(rng.permutation(3)[: rng.integers(1, 4)])]
        value = np.where(rng.random((len(ids), len(some))) < 0.3, np.nan, rng.normal(size=(len(ids), len(some))))
        table = table.met(ids, some, value)
        for (k, c), number in np.ndenumerate(value):
            every.setdefault((int(ids[k]), some[c]), []).extend([float(number)] * bool(np.isfinite(number)))
    found, sessions = table.of(np.arange(12), columns)
    for (k, c), count in np.ndenumerate(sessions):
        given = every.get((k, columns[c]), [])
        assert count == len(given)
        np.testing.assert_allclose(found[k, c], np.mean(given) if given else np.nan)
    assert len(table) == np.count_nonzero(sessions)
    order = np.lexsort((table.column_id, table.landmark_id))
    np.testing.assert_array_equal(order, np.arange(len(table)))
