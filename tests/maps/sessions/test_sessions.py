"""Whole sessions in a small simulated building, against what really happened there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cache

import numpy as np
import pytest

from evermap.errors import DataError
from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.maps.lives import Lives
from evermap.maps.living import LivingMap
from evermap.maps.sessions.believe import aged
from evermap.maps.sessions.session import Session, with_start_of
from evermap.pipeline import run_session
from evermap.slam.cleaning import some_frames
from evermap.types import UNKNOWN, ChangeKind, Clock, FloatArray, Recording, rows_of
from evermap_studies.sim import BuildingSimulation, looked_at
from evermap_studies.sim.world import positions_at

from .buildings import body_of, building, lived_through, p_exists, place_of, settings, truth_of, unseen

SEEDS = (2, 3)


@cache
def live_through(seed: int) -> tuple[BuildingSimulation, list[Session]]:
    """A building in which things move, come and go, and its sessions."""
    world = building(seed)
    return world, lived_through(world.sessions)


@pytest.fixture(scope="module")
def changing() -> dict[int, tuple[BuildingSimulation, list[Session]]]:
    """Some of such buildings."""
    return {seed: live_through(seed) for seed in SEEDS}


@pytest.fixture(scope="module")
def still() -> tuple[BuildingSimulation, list[Session]]:
    """A building in which nothing happens."""
    world = building(1, change_rate=0.0)
    return world, lived_through(world.sessions)


def in_map(world: BuildingSimulation, first: LivingMap) -> tuple[FloatArray, np.ndarray]:
    """(S, L, 2) true positions in the frame of a map, by its landmarks of the first session; (S, L) which were seen."""
    truth = truth_of(world)
    names, at = first.places.landmark_id, first.places.position_m
    motion = rigid(truth.position_m[0, names], at)
    return se2.transform(motion, truth.position_m), truth.seen


def looked_at_places(world: BuildingSimulation) -> Callable[[int, int, int], bool]:
    """Whether a session really looked at the place where a landmark stands in another session."""
    looks = looked_at(world)
    position_m = [positions_at(world.objects, world.stays, told.start_s) for told in world.truths]

    def looked(session: int, name: int, when: int) -> bool:
        rows = np.flatnonzero(looks.landmark_id == name)
        gap = np.hypot(*(looks.position_m[rows] - position_m[when][name]).T)
        return bool(np.any(looks.looked_at[session, rows[gap < 1e-6]]))

    return looked


@pytest.mark.parametrize("seeds", [SEEDS, pytest.param(range(4), marks=pytest.mark.slow)])
def test_changes_are_those_that_happened(seeds: Sequence[int]) -> None:
    """By landmark: all that was looked at before and after, hardly anything else.

    What was never met has come only if its place had been looked at before; a step of a hand's breadth is no change.
    Landmarks that the map takes for one body though they are several things are not counted as missed: it tells of the
    part that it saw, which is the whole for it.

    Measured in four: 88 right, 2 wrong (one of them at .67), 6 missed (4 that came where nothing had been seen behind
    their place until then, 2 that left and came back within a day) and 13 of several things that were taken for one.
    """
    right = wrong = missed = 0
    for world, sessions in map(live_through, seeds):
        thing = {name: k for k, one in enumerate(world.objects) for name in one.landmark_ids}
        position, seen = in_map(world, sessions[0].living)
        looked = looked_at_places(world)
        # where each landmark was last told to be, nan for nowhere, and in which session it stood there
        told, then = np.where(seen[0][:, None], position[0], np.nan), np.zeros(world.n_landmarks, dtype=np.int64)
        met = seen[0].copy()
        for k, session in enumerate(sessions[1:], start=1):
            now = position[k]
            same = (np.hypot(*(now - told).T) < 0.1) | (np.isnan(now) & np.isnan(told)).all(axis=1)
            said = np.zeros(len(same), dtype=np.bool_)
            for change in session.changes:
                names = list(change.landmark_ids)
                said[names] = True
                if change.kind is ChangeKind.VANISHED:
                    assert np.isnan(now[names]).all() or change.probability < 0.7, (world.seed, k, change)
                if change.kind is ChangeKind.APPEARED:
                    assert not met[names].any(), (world.seed, k, change)
                if change.kind is ChangeKind.MOVED:
                    step = (now[names] - told[names]).mean(axis=0)
                    assert np.linalg.norm(step - change.displacement_m) < 0.3, (world.seed, k, change)
                assert change.probability > 0.5
                assert not change.stamp_from_s > change.stamp_to_s
            right += int((said & ~same).sum())
            wrong += int((said & same).sum())
            for name in np.flatnonzero(~said & ~same & (seen[k] | met)).tolist():
                members = session.living.members.landmark_id
                if len({thing[other] for other in (body_of(session.living, name) if name in members else [name])}) > 1:
                    continue
                if met[name]:
                    missed += bool(seen[k][name] or looked(k, name, then[name]))
                else:
                    missed += any(looked(j, name, k) for j in range(k))
            told[said | seen[k]], then[said | seen[k]] = now[said | seen[k]], k
            met |= seen[k]
    assert right > 20 * len(seeds)
    assert right / (right + wrong) >= 0.97, (right, wrong, missed)
    assert right / (right + missed) >= 0.9, (right, wrong, missed)


def test_the_map_is_where_things_are(changing: dict[int, tuple[BuildingSimulation, list[Session]]]) -> None:
    """After the last session, in the frame of the first; what is thought to be there is there, to centimetres."""
    squared, ghosts, count = [], 0, 0
    for world, sessions in changing.values():
        position, _ = in_map(world, sessions[0].living)
        landmarks = sessions[-1].living.landmarks(p_least=0.5)
        gap = np.linalg.norm(landmarks.position_m - position[-1, landmarks.landmark_id], axis=1)
        ghosts += int(np.isnan(gap).sum())
        count += len(gap)
        squared.append(gap[np.isfinite(gap)] ** 2)
    assert np.sqrt(np.concatenate(squared).mean()) < 0.1
    assert ghosts <= 0.03 * count


def test_in_a_still_building_nothing_changes_and_the_map_gets_better(
    still: tuple[BuildingSimulation, list[Session]],
) -> None:
    world, sessions = still
    assert [session.changes for session in sessions] == [()] * len(sessions)
    first, last = sessions[0].living, sessions[-1].living
    np.testing.assert_array_equal(last.members.landmark_id, np.unique(last.members.landmark_id))
    position, _ = in_map(world, first)
    gaps, spreads = [], []
    for session in sessions:
        landmarks = session.living.landmarks()
        kept = np.isin(landmarks.landmark_id, first.members.landmark_id)
        true = position[0, landmarks.landmark_id[kept]]
        onto = rigid(landmarks.position_m[kept], true)
        gaps.append(np.sqrt(np.mean((se2.transform(onto, landmarks.position_m[kept]) - true) ** 2)))
        rows = np.flatnonzero(np.isin(session.living.places.landmark_id, first.members.landmark_id))
        corner = (2 * rows[:, None] + np.arange(2)).ravel()
        spreads.append(np.trace(session.living.covariance_m2[np.ix_(corner, corner)]))
    assert gaps[-1] < gaps[0]
    assert (np.diff(spreads) < 0.0).all()
    assert (last.p_exists() > 0.95).all()
    assert (last.stays.gone_s == np.inf).all()


def test_a_map_of_a_still_building_does_not_grow(still: tuple[BuildingSimulation, list[Session]]) -> None:
    """Poses are marginalised: one place a landmark, whatever the number of sessions."""
    _, sessions = still
    for session in sessions:
        living = session.living
        count = len(np.unique(session.living.places.landmark_id))
        assert len(living.places) == len(living.members) == count
        assert living.covariance_m2.shape == (2 * count, 2 * count)
        assert len(living.sites) == len(living.stays) == len(np.unique(living.members.clique_id))
    assert len(sessions[-1].living.places) <= len(sessions[1].living.places) + 2


def assert_same_bytes(left: object, right: object, name: str = "map") -> None:
    if is_dataclass(left):
        for item in fields(left):
            assert_same_bytes(getattr(left, item.name), getattr(right, item.name), f"{name}.{item.name}")
    elif isinstance(left, tuple):
        assert isinstance(right, tuple)
        assert len(left) == len(right), name
        for k, (one, other) in enumerate(zip(left, right, strict=True)):
            assert_same_bytes(one, other, f"{name}[{k}]")
    elif isinstance(left, np.ndarray):
        assert isinstance(right, np.ndarray)
        assert left.tobytes() == right.tobytes(), name
    elif isinstance(left, float):
        assert np.float64(left).tobytes() == np.float64(right).tobytes(), name
    else:
        assert left == right, name


def test_the_same_recordings_make_the_same_map_bit_by_bit(
    changing: dict[int, tuple[BuildingSimulation, list[Session]]],
) -> None:
    world, sessions = changing[2]
    for one, again in zip(sessions[:2], lived_through(world.sessions[:2]), strict=True):
        assert_same_bytes(one.living, again.living)
        assert_same_bytes(one.changes, again.changes)
        assert_same_bytes(one.evidence, again.evidence)
        assert_same_bytes(one.slam.trajectory, again.slam.trajectory)


@pytest.fixture(scope="module")
def left(still: tuple[BuildingSimulation, list[Session]]) -> tuple[list[int], list[Session]]:
    """A body that was away in the second and third of four sessions: its landmarks, and the sessions."""
    world, sessions = still
    living = sessions[0].living
    hits = np.array(
        [np.bincount(one.detections.landmark_id.clip(0), minlength=world.n_landmarks) for one in world.sessions]
    )
    seen_often = [n for n in living.members.landmark_id.tolist() if len(body_of(living, n)) > 1]
    name = max(seen_often, key=lambda n: hits[:, n].min())
    names = body_of(sessions[0].living, name)
    recordings = [one if k in (0, 3) else unseen(one, names) for k, one in enumerate(world.sessions)]
    return names, lived_through(recordings)


def test_who_left_and_came_back_is_where_it_was(
    still: tuple[BuildingSimulation, list[Session]], left: tuple[list[int], list[Session]]
) -> None:
    """Removal can be taken back, and does not touch the rest of the map.

    Where all else stays, one look does not outweigh that: it is told by the second at the latest.
    """
    names, sessions = left
    told = [[(change.kind, list(change.landmark_ids)) for change in session.changes] for session in sessions]
    assert told[0] == []
    assert told[1] + told[2] == [(ChangeKind.VANISHED, names)]
    assert told[3] == [(ChangeKind.RETURNED, names)]
    stayed = still[1]
    for session, other in zip(sessions, stayed, strict=True):
        for name in np.intersect1d(session.living.members.landmark_id, other.living.members.landmark_id):
            site, at, spread = place_of(session.living, int(name))
            same_site, where, _ = place_of(other.living, int(name))
            assert site == same_site
            limit = 2.5 if name in names else 0.7  # who was away is known by two sessions less
            assert np.sqrt((at - where) @ np.linalg.solve(spread, at - where)) < limit
    site_stays = sessions[-1].living.stays
    mine = site_stays.clique_id == sessions[-1].living.members.clique_id[
        sessions[-1].living.members.landmark_id == names[0]
    ]  # fmt: skip
    assert mine.sum() == 2
    assert (site_stays.gone_s[mine] == np.inf).tolist() == [False, True]


def test_what_is_away_is_less_and_less_believed_in(left: tuple[list[int], list[Session]]) -> None:
    names, sessions = left
    p = [p_exists(session.living, names[0]) for session in sessions]
    assert p[0] > 0.95
    assert p[1] < 0.31
    assert p[2] < 0.1
    assert p[3] > 0.95


def test_what_an_operator_pinned_is_believed_in_though_it_is_never_seen(
    still: tuple[BuildingSimulation, list[Session]], left: tuple[list[int], list[Session]]
) -> None:
    world, sessions = still
    names, _ = left
    pinned = sessions[0].living.edited(names[0], pinned=True)
    after = lived_through([unseen(one, names) for one in world.sessions[1:3]], living=pinned)
    assert all(p_exists(session.living, names[0]) > 0.9 for session in after)
    assert not any(session.changes for session in after)


def test_what_an_operator_deleted_is_not_looked_at_until_that_is_taken_back(
    still: tuple[BuildingSimulation, list[Session]], left: tuple[list[int], list[Session]]
) -> None:
    world, sessions = still
    name = left[0][0]
    site, _, _ = place_of(sessions[0].living, name)
    deleted = sessions[0].living.edited(name, deleted=True)
    session = run_session(world.sessions[1], deleted, settings())
    assert (world.sessions[1].detections.landmark_id == name).any()
    assert not (session.recording.detections.landmark_id == name).any()
    assert name not in session.slam.landmarks.landmark_id
    places = session.living.places
    before = deleted.places.n_hits[deleted.places.landmark_id == name]
    assert places.n_hits[places.landmark_id == name].tolist() == before.tolist()
    back = run_session(world.sessions[2], session.living.edited(name, deleted=False), settings())
    assert place_of(back.living, name)[0] == site
    assert back.living.places.n_hits[back.living.places.landmark_id == name].sum() > before.sum()
    assert name in back.slam.landmarks.landmark_id
    assert p_exists(back.living, name) > 0.9


def test_a_session_elsewhere_leaves_the_map_as_it_was(still: tuple[BuildingSimulation, list[Session]]) -> None:
    world, sessions = still
    other = world.sessions[1]
    names = np.where(other.detections.landmark_id >= 0, other.detections.landmark_id + 1000, -1)
    elsewhere = replace(other, detections=replace(other.detections, landmark_id=names))
    session = run_session(elsewhere, sessions[0].living, settings())
    assert not session.found
    assert_same_bytes(session.living, sessions[0].living)
    assert session.changes == ()
    assert len(session.evidence) == 0
    assert any("set aside" in warning for warning in session.slam.warnings)
    assert session.slam.landmarks.frame == "first_pose"


@pytest.mark.parametrize("late_s", [15.0, *(pytest.param(late_s, marks=pytest.mark.slow) for late_s in (7.0, 30.0))])
def test_a_session_whose_odometry_is_of_another_drive_is_not_believed(
    late_s: float, still: tuple[BuildingSimulation, list[Session]]
) -> None:
    """By it, no landmark that is seen twice within seconds stands still."""
    world, sessions = still
    other = world.sessions[1]
    driven = other.odometry
    rows = np.searchsorted(
        driven.stamp_s, (driven.stamp_s + late_s * np.floor(driven.stamp_s / 11.0)) % driven.stamp_s[-1]
    )
    mixed = replace(driven, **{name: getattr(driven, name)[rows] for name in ("forward_mps", "angular_radps")})
    session = run_session(replace(other, odometry=mixed), sessions[0].living, settings())
    assert not session.found
    assert "contradict the map or each other" in session.set_aside[0]
    assert_same_bytes(session.living, sessions[0].living)


def test_a_session_with_a_wrong_sign_begins_no_map_and_enters_none(
    still: tuple[BuildingSimulation, list[Session]],
) -> None:
    """Mirrored, its landmarks agree with each other."""
    world, sessions = still
    other = world.sessions[1]
    mirrored = replace(other, detections=replace(other.detections, bearing_rad=-other.detections.bearing_rad))
    for living in (None, sessions[0].living):
        session = run_session(mirrored, living, settings())
        assert not session.found
        assert "wrong sign" in session.set_aside[0]
        assert len(session.living.places) == (0 if living is None else len(living.places))


def test_a_drive_in_pieces_that_nothing_ties_begins_a_map_with_the_largest(
    still: tuple[BuildingSimulation, list[Session]],
) -> None:
    """Though that is less than half of it: the others do not contradict it."""
    world, _ = still
    whole = world.sessions[0]
    first_s, last_s = whole.frames.stamp_s[[0, -1]]
    piece = np.minimum((whole.frames.stamp_s - first_s) * 3.0 / (last_s - first_s), 2.999).astype(int)
    of = piece[whole.detections.frame]
    times = np.array([np.bincount(of[whole.detections.landmark_id == name], minlength=3) for name in range(200)])
    own = (whole.detections.landmark_id >= 0) & (times.argmax(axis=1)[whole.detections.landmark_id] == of)
    edges_s = first_s + (last_s - first_s) * np.array([1.0, 2.0]) / 3.0
    silent = (np.abs(whole.odometry.stamp_s[:, None] - edges_s) < 3.0).any(axis=1)
    blind = (np.abs(whole.frames.stamp_s[:, None] - edges_s) < 3.0).any(axis=1)
    some = some_frames(whole, ~blind)
    own = own[~blind[whole.detections.frame]]
    detections = replace(some.detections, landmark_id=np.where(own, some.detections.landmark_id, UNKNOWN))
    session = run_session(
        replace(some, odometry=rows_of(whole.odometry, ~silent), detections=detections), None, settings()
    )
    assert session.found, session.set_aside
    assert any("nothing connects them" in warning for warning in session.recording.warnings)
    pieces = times.argmax(axis=1)[session.living.members.landmark_id]
    assert len(np.unique(pieces)) == 1


def test_a_session_is_as_old_as_its_recording_whatever_is_left_out(
    still: tuple[BuildingSimulation, list[Session]],
) -> None:
    """So a recording that begins between that and the first frame that is used comes after it."""
    world, sessions = still
    began_s = sessions[0].living.session_start_s
    assert began_s == world.sessions[0].frames.stamp_s[0]
    for earlier_s, expected_s in ((10.0, began_s - 10.0), (-10.0, began_s)):
        frames = replace(world.sessions[0].frames, stamp_s=world.sessions[0].frames.stamp_s - earlier_s)
        after = with_start_of(sessions[0], replace(world.sessions[0], frames=frames))
        assert after.living.session_start_s == expected_s


@pytest.mark.parametrize("seed", [5, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (6, 7, 8))])
def test_another_building_with_the_same_identities_is_not_this_one(
    seed: int, still: tuple[BuildingSimulation, list[Session]]
) -> None:
    """By chance some of its landmarks stand to each other as here; that all others moved is less probable."""
    _, sessions = still
    other = building(seed, days=2, change_rate=0.0).sessions[1]
    common = np.isin(np.unique(other.detections.landmark_id), sessions[0].living.members.landmark_id)
    assert common.sum() > 20
    session = run_session(other, sessions[0].living, settings())
    assert not session.found
    assert_same_bytes(session.living, sessions[0].living)


def _on_its_own_clock(recording: Recording) -> Recording:
    odometry = replace(recording.odometry, clock=Clock.RECORDING)
    frames = replace(recording.frames, clock=Clock.RECORDING)
    return replace(recording, odometry=odometry, frames=frames, clock=Clock.RECORDING)


def test_sessions_come_in_their_order_and_on_one_clock(still: tuple[BuildingSimulation, list[Session]]) -> None:
    world, sessions = still
    with pytest.raises(DataError, match="before the newest session") as earlier:
        run_session(world.sessions[0], sessions[1].living, settings())
    with pytest.raises(DataError, match="clock") as clocks:
        run_session(_on_its_own_clock(world.sessions[1]), sessions[0].living, settings())
    for error in (earlier, clocks):
        assert "\n" not in str(error.value)


def test_classes_are_known_by_their_names(still: tuple[BuildingSimulation, list[Session]]) -> None:
    """The second recording numbers them in another way, and knows one more."""
    world, sessions = still
    second = world.sessions[1]
    turned = (*reversed(second.class_names), "plant")
    number = np.array([turned.index(name) for name in second.class_names] + [-1])
    detections = replace(second.detections, class_id=number[second.detections.class_id])
    session = run_session(replace(second, detections=detections, class_names=turned), sessions[0].living, settings())
    same = sessions[1].living
    assert session.living.class_names == (*same.class_names, "plant")
    assert_same_bytes(replace(session.living, class_names=same.class_names), same)


def test_without_existence_nothing_ever_goes(
    still: tuple[BuildingSimulation, list[Session]], left: tuple[list[int], list[Session]]
) -> None:
    world, sessions = still
    (session,) = lived_through([unseen(world.sessions[1], left[0])], settings(existence=False), sessions[0].living)
    assert session.changes == ()
    assert len(session.evidence) == 0
    assert p_exists(session.living, left[0][0]) == p_exists(sessions[0].living, left[0][0])


def test_without_misses_nothing_is_learned_from_what_is_not_seen(
    still: tuple[BuildingSimulation, list[Session]], left: tuple[list[int], list[Session]]
) -> None:
    world, sessions = still
    config = settings(misses=False)
    (session,) = lived_through([unseen(world.sessions[1], left[0])], config, sessions[0].living)
    name = left[0][0]
    # time alone, by lifetimes that know what the session found standing
    alone = replace(sessions[0].living, lives=session.living.lives)
    only_time = aged(alone, config.living, session.living.stamp_s).p_here
    clique = sessions[0].living.members.clique_id[sessions[0].living.members.landmark_id == name]
    expected = only_time[np.isin(sessions[0].living.sites.clique_id, clique)].sum()
    assert p_exists(session.living, name) == pytest.approx(expected, abs=0.02)
    assert p_exists(session.living, name) > p_exists(left[1][1].living, name) + 0.3


def test_without_returns_what_is_gone_is_never_expected_back(left: tuple[list[int], list[Session]]) -> None:
    names, sessions = left
    living = sessions[2].living
    clique = living.members.clique_id[living.members.landmark_id == names[0]]
    mine = np.isin(living.sites.clique_id, clique)
    later_s = living.stamp_s + 30 * 86_400.0
    now = living.sites.p_here[mine].sum()
    assert aged(living, settings().living, later_s).p_here[mine].sum() > now + 0.02
    assert aged(living, settings(returns=False).living, later_s).p_here[mine].sum() <= now


def test_without_cliques_each_landmark_is_a_body(still: tuple[BuildingSimulation, list[Session]]) -> None:
    world, sessions = still
    session = run_session(world.sessions[0], None, settings(cliques=False))
    members = session.living.members
    assert len(np.unique(members.clique_id)) == len(members)
    assert len(np.unique(sessions[0].living.members.clique_id)) < len(members)


def test_searching_for_nothing_lets_nothing_move(
    changing: dict[int, tuple[BuildingSimulation, list[Session]]],
) -> None:
    world, sessions = changing[3]
    moved = [change for change in sessions[1].changes if change.kind is ChangeKind.MOVED]
    assert moved
    for search, tells in (("gate", True), ("none", False)):
        session = run_session(world.sessions[1], sessions[0].living, settings(search=search))
        kinds = {change.kind for change in session.changes}
        assert (ChangeKind.MOVED in kinds) == tells


def test_what_is_not_to_be_learned_is_not(changing: dict[int, tuple[BuildingSimulation, list[Session]]]) -> None:
    world, sessions = changing[2]
    config = settings(learn_lifetimes=False, learn_sight=False, most_sites=1)
    living = lived_through(world.sessions, config)[-1].living
    assert_same_bytes(living.lives, Lives())
    assert_same_bytes(living.sightlines, LivingMap().sightlines)
    assert (np.unique(living.sites.clique_id, return_counts=True)[1] == 1).all()
    learned = sessions[-1].living
    assert len(learned.lives.life) > 0
    assert np.unique(learned.sites.clique_id, return_counts=True)[1].max() > 1


def test_hits_and_misses_are_the_same_in_the_result_the_map_and_its_evidence(
    changing: dict[int, tuple[BuildingSimulation, list[Session]]],
) -> None:
    """By landmark, at the place where it stands: of all sessions in the records, of the last one in misses."""
    compared = bodies = 0
    for _, sessions in changing.values():
        for before, session in zip([None, *sessions], sessions, strict=False):
            living, misses = session.living, session.slam.misses
            counted = {
                (int(name), int(site)): (int(hits), int(missed))
                for name, site, hits, missed in zip(
                    living.places.landmark_id, living.places.site_id, living.places.n_hits, living.places.n_misses,
                    strict=True,
                )
            }  # fmt: skip
            at = dict(zip(living.members.landmark_id.tolist(), living.site_of().tolist(), strict=True))
            records = session.slam.landmarks
            for k, name in enumerate(records.landmark_id.tolist()):
                assert (records.n_hits[k], records.n_misses[k]) == counted[name, at[name]]
            known: dict[tuple[int, int], int] = {}
            if before is not None:
                places = before.living.places
                keys = zip(places.landmark_id.tolist(), places.site_id.tolist(), strict=True)
                known = dict(zip(keys, places.n_misses.tolist(), strict=True))
            of_session = {key: missed - known.get(key, 0) for key, (_, missed) in counted.items()}
            for name in records.landmark_id.tolist():
                if (name, at[name]) in known:
                    assert int((misses.landmark_id == name).sum()) == of_session[name, at[name]]
                    compared += 1
            # what `why` shows: of bodies that have one site, landmark by landmark
            evidence = session.evidence
            for clique in np.unique(evidence.clique_id).tolist():
                mine = np.flatnonzero(living.members.clique_id == clique)
                site = living.sites.site_id[living.sites.clique_id == clique]
                names = living.members.landmark_id[mine].tolist()
                if len(site) == 1 and all((name, int(site[0])) in known for name in names):
                    told = int(evidence.n_misses[evidence.clique_id == clique].sum())
                    assert told == sum(of_session[name, int(site[0])] for name in names)
                    bodies += 1
    assert compared > 100
    assert bodies > 50


def test_misses_are_in_view_and_not_detected_there(
    changing: dict[int, tuple[BuildingSimulation, list[Session]]],
) -> None:
    for _, sessions in changing.values():
        session = sessions[-1]
        recording, misses = session.recording, session.slam.misses
        stamps = recording.frames.stamp_s[misses.frame]
        pose = session.slam.trajectory.pose_world_robot[np.searchsorted(session.slam.trajectory.stamp_s, stamps)]
        assert len(misses)
        assert ((misses.p_detect > 0.0) & (misses.p_detect < 1.0)).all()
        assert (np.diff(misses.frame) >= 0).all()
        pairs = np.column_stack([misses.frame, misses.landmark_id])
        assert len(np.unique(pairs, axis=0)) == len(pairs)
        sensor = recording.sensor
        for name in np.unique(misses.landmark_id).tolist():
            _, place, _ = place_of(session.living, name)
            mine = misses.landmark_id == name
            away = se2.transform(se2.inverse(se2.compose(pose[mine], sensor.mount_robot_sensor)), place)
            assert np.hypot(*away.T).max() < sensor.range_max_m + 0.2
            hits = recording.detections.landmark_id == name
            # a detection that is more probably an outlier was not made there
            hits[session.slam.innovations.detection[session.slam.innovations.p_inlier < 0.5]] = False
            assert not np.isin(misses.frame[mine], recording.detections.frame[hits]).any()
