"""Landmarks without identities beside the same recordings with them: who is who, how many, and how far off the poses.

Precision and recall are those of pairs: of two detections that are given to one landmark, and of two that are of one.
Truth of association is the recording's own identities.

    python -m benchmarks.association space

does the same in space,

    python -m benchmarks.association harsh

in worlds that are harsher than those that constants were set on (`benchmarks/harsh.py`),

    python -m benchmarks.association columns

where detections say what landmarks are like (`COLUMNS` of `benchmarks/harsh.py`),

    python -m benchmarks.association exchanged

the same over the sessions of a map, in which two landmarks of a class change places half-way,

    python -m benchmarks.association mixed

where some have identities: a share of the landmarks, or of the detections of each,

    python -m benchmarks.association wrong

where some identities are wrong, and

    python -m benchmarks.association sessions

enters sessions of one world after the other into a map: with identities, with those of half of the landmarks, and
without. Since nothing says which of two equal landmarks moved, what is told is scored by places: one that a landmark
left, or came to, within `NEAR_M` of the truth, one to one; a move is both. It is right if that happened since any
earlier session, since a drive may see little of the site; and found at once if since the last.

    python -m benchmarks.association sessions "half range"

does so in two buildings, six sessions each, of a robot that sees half as far.
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

import evermap as em
from benchmarks.harsh import COLUMNS, harsh_worlds, simulate_copied_aisles, with_columns
from benchmarks.scale_maps import MAP_POSE, SESSION, living_map
from evermap.config import Config, load_config
from evermap.errors import EvermapError
from evermap.geometry import se2
from evermap.geometry.group import group_of
from evermap.geometry.rigid import rigid
from evermap.io import read_recording
from evermap.maps.living import LivingMap
from evermap.maps.sessions.session import Session
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.slam.association import with_identities
from evermap.types import (
    UNKNOWN,
    AnyRecordingT,
    ChangeKind,
    FloatArray,
    IntArray,
    Recording,
    SlamResult,
    SpatialRecording,
    Trajectory,
    rows_of,
)
from evermap_studies.building.study import BY_HAND, story_of
from evermap_studies.demo.truth import truth_of
from evermap_studies.lifelong.runs import SIMULATED
from evermap_studies.lifelong.world import recorded_world, simulated_world
from evermap_studies.partial_views.study import Settings, building_of
from evermap_studies.sim import BuildingConfig, SimulatedSensor, simulate_building, simulate_warehouse
from evermap_studies.sim.park import simulate_park

FOLDER = Path(__file__).resolve().parents[1].parent / "shared" / "data"
PARKS = 3
DATASETS = (1, 2, 3, 6)
"""The first two have no true poses: position errors are those against the run with identities."""
ROBOTS = (1, 2, 3, 4, 5)
BUILDINGS, DRIVES = 3, 3
"""In space."""
METRICS: dict[str, tuple[str, float, str]] = {
    "association_dlr_precision": ("higher", 0.01, "pairs of detections given to one landmark that are of one, DLR"),
    "association_dlr_recall": ("higher", 0.02, "pairs of detections of one landmark that are given to one, DLR"),
    "association_park_recall": ("higher", 0.1, "the same in the simulated parks, on average"),
}
RATE_HZ = 2.0
NEAR_M = 0.3
"""A place that is told is right within this."""
COMES = (ChangeKind.APPEARED, ChangeKind.RETURNED)


@dataclass(frozen=True, slots=True)
class Score:
    """One recording: pairs, landmarks found and true, position errors [m] without and with identities, CPU [s]."""

    name: str
    precision: float
    recall: float
    found: int
    true: int
    without_m: float
    with_m: float
    association_s: float
    all_s: float

    @property
    def ratio(self) -> float:
        """Position error without identities over that with them; nan where the latter is the reference."""
        return self.without_m / self.with_m if self.with_m > 0.0 else math.nan


def run(folder: Path = FOLDER, *, parks: int = PARKS) -> tuple[dict[str, float], dict[str, Any]]:
    """Measure all recordings."""
    rows = [score(recording) for recording in recordings(folder, parks=parks)]
    of = {kind: [row for row in rows if row.name.lower().startswith(kind)] for kind in ("dlr", "park")}
    metrics = {}
    if of["dlr"]:
        metrics["association_dlr_precision"] = of["dlr"][0].precision
        metrics["association_dlr_recall"] = of["dlr"][0].recall
    if of["park"]:
        metrics["association_park_recall"] = float(np.mean([row.recall for row in of["park"]]))
    return metrics, {"rows": [asdict(row) for row in rows]}


def recordings(folder: Path = FOLDER, *, parks: int = PARKS) -> Iterator[Recording]:
    """Read or simulate what is scored."""
    for seed in range(parks):
        yield simulate_park(seed=seed)
    if (folder / "dlr").is_dir():
        yield _planar(folder / "dlr")
    for dataset, robot in itertools.product(DATASETS, ROBOTS):
        path = folder / "mrclam" / f"MRCLAM_Dataset{dataset}.zip"
        if path.is_file():
            try:
                yield _planar(path, robot=robot)
            except EvermapError:  # one robot's odometry is missing
                continue


def recordings_in_space(folder: Path = FOLDER) -> Iterator[SpatialRecording]:
    """Read TagSLAM, where there is odometry, and simulate drives through buildings."""
    if (folder / "tagslam").is_dir():
        read = read_recording(folder / "tagslam" / "test_11")
        assert isinstance(read, SpatialRecording)
        yield read
    for seed in range(BUILDINGS):
        for day, patrol in enumerate(story_of(seed, DRIVES).patrols):
            yield replace(_with_clock(patrol.recording), name=f"building {seed}, day {day}")


def _with_clock(recording: SpatialRecording) -> SpatialRecording:
    """Return a recording whose truth has its clock."""
    assert recording.truth is not None
    return replace(recording, truth=replace(recording.truth, clock=recording.clock))


def score(recording: Recording | SpatialRecording, config: Config | None = None) -> Score:
    """Run a recording with and without its identities."""
    config = config or Config()
    named = em.run_slam(recording, config)
    began = time.process_time()
    found = with_identities(recording, config.slam.model_copy(update={"unknown_ids": True}))
    associated = time.process_time()
    nameless = em.run_slam(found, config)
    ended = time.process_time()
    precision, recall = pairwise(found.detections.landmark_id, recording.detections.landmark_id)
    given = found.detections.landmark_id
    true = recording.detections.landmark_id
    truth = _truth(recording, named)
    return Score(
        recording.name,
        precision,
        recall,
        len(np.unique(given[given != UNKNOWN])),
        len(np.unique(true[true != UNKNOWN])),
        evaluate_trajectory(nameless.trajectory, truth, rate_hz=RATE_HZ).rmse_m,
        evaluate_trajectory(named.trajectory, truth, rate_hz=RATE_HZ).rmse_m,
        associated - began,
        ended - began,
    )


def pairwise(found: IntArray, true: IntArray) -> tuple[float, float]:
    """Return precision and recall over pairs of detections (M,); `UNKNOWN` is in no pair."""

    def pairs(of: IntArray) -> float:
        count = np.unique(of, return_counts=True)[1].astype(float)
        return float((count * (count - 1.0) / 2.0).sum())

    given, real = found != UNKNOWN, true != UNKNOWN
    both = given & real
    agreed = pairs(np.unique(found[both], return_inverse=True)[1] * (int(true.max()) + 1) + true[both])
    return agreed / max(pairs(found[given]), 1.0), agreed / max(pairs(true[real]), 1.0)


@dataclass(frozen=True, slots=True)
class Lived:
    """Sessions of a world in one map: (S, L, D) where landmarks are, nan while away; its frame in that of the truth."""

    name: str
    recordings: Sequence[Recording | SpatialRecording]
    position_m: FloatArray
    overrides: tuple[str, ...] = ()
    begun: LivingMap | None = None
    pose_truth_map: FloatArray | None = None


MIXED = (
    ("MRCLAM_Dataset6", 0.5, "detections"), ("MRCLAM_Dataset6", 0.5, "landmarks"), ("dlr", 0.1, "landmarks"),
    ("park", 0.1, "landmarks"), ("TagSLAM", 0.5, "landmarks"), ("TagSLAM", 0.5, "detections"),
)  # fmt: skip
"""Beginnings of names, shares that keep their identities, and of what."""


EXCHANGED = ("none", "radius", "colour", "descriptor of 32", "colour by the light", "useless")
"""Columns over sessions."""
WRONG_RATES = (0.0, 0.05, 0.1, 0.2)


def partly_named(recording: AnyRecordingT, share: float, of: str, seed: int = 0) -> AnyRecordingT:
    """Return a recording with the identities of some of its landmarks, or of some detections of each."""
    true, random = recording.detections.landmark_id, np.random.default_rng(seed)
    if of == "landmarks":
        ids = np.unique(true[true != UNKNOWN])
        kept = np.isin(true, ids[random.random(len(ids)) < share])
    else:
        kept = random.random(len(true)) < share
    return replace(recording, detections=replace(recording.detections, landmark_id=np.where(kept, true, UNKNOWN)))


def mixed_line(recording: Recording | SpatialRecording, share: float, of: str) -> str:
    """Return a row of the table of a recording of which some landmarks, or detections, keep their identities."""
    true, config, some = recording.detections.landmark_id, Config(), partly_named(recording, share, of)
    found = with_identities(some, config.slam.model_copy(update={"unknown_ids": "empty"}))
    given = found.detections.landmark_id
    every = [em.run_slam(one, config) for one in (found, some, recording)]
    truth = _truth(recording, every[-1])
    off = [f"{evaluate_trajectory(one.trajectory, truth, rate_hz=RATE_HZ).rmse_m:.3f}" for one in every]
    counts = [len(np.unique(one[one != UNKNOWN])) for one in (given, true)]
    precision, recall = pairwise(given, true)
    name = f"{recording.name}, {share:.0%} of the {of}"
    return f"| {name} | {precision:.3f} | {recall:.3f} | {counts[0]} ({counts[1]}) | {' / '.join(off)} |"


def with_wrong_ids(recording: AnyRecordingT, rate: float, *, twins: bool = False, seed: int = 0) -> AnyRecordingT:
    """Return a recording with a share of the identities those of any landmark; `twins`: the two seen most have one."""
    true, random = recording.detections.landmark_id, np.random.default_rng(seed)
    ids, count = np.unique(true[true != UNKNOWN], return_counts=True)
    wrong = (random.random(len(true)) < rate) & (true != UNKNOWN)
    given = np.where(wrong, ids[random.integers(0, len(ids), len(true))], true)
    if twins:
        one, other = ids[np.argsort(count, kind="stable")[-2:]]
        given = np.where(true == other, one, given)
    return replace(recording, detections=replace(recording.detections, landmark_id=given))


def wrong_line(recording: Recording | SpatialRecording) -> str:
    """Return position errors [m] at each rate of wrong identities, and with one on two landmarks; as read, and voted on
    (`slam.vote_ids`).
    """
    truth, off = _truth(recording, em.run_slam(recording)), list[str]()
    for rate, twins in (*((rate, False) for rate in WRONG_RATES), (0.0, True)):
        wrong, each = with_wrong_ids(recording, rate, twins=twins), list[str]()
        for vote in (False, True):
            estimated = em.run_slam(wrong, Config(slam={"vote_ids": vote})).trajectory
            each.append(f"{evaluate_trajectory(estimated, truth, rate_hz=RATE_HZ).rmse_m:.3f}")
        off.append(" / ".join(each))
    return f"| {recording.name} | {' | '.join(off)} |"


def worlds(folder: Path = FOLDER) -> Iterator[Lived]:
    """Simulate, or edit, what lives on."""
    for seed in range(2):
        world = simulated_world(3, seed)
        yield Lived(f"rooms, seed {seed}", world.recordings, world.position_m, SIMULATED)
    for seed in range(1000, 1002):
        building = building_of(Settings(sessions=6), seed, 165)
        yield Lived(f"building, seed {seed}", building.sessions, truth_of(building).position_m)
    for seed in range(1002, 1004):
        sensor = SimulatedSensor(range_max_m=0.5 * SimulatedSensor().range_max_m)
        building = simulate_building(BuildingConfig(days=6, sensor=sensor), seed)
        yield Lived(f"half range, building {seed}", building.sessions, truth_of(building).position_m)
    for seed in range(BUILDINGS):
        story = story_of(seed, 7)
        driven = [day for day in range(7) if day % 7 != BY_HAND]
        recordings = [_with_clock(story.patrols[day].recording) for day in driven]
        yield Lived(f"space, building {seed}", recordings, story.position_m[driven])
    for n_places in (1_000, 10_000):
        yield warehouse(n_places)
    for seed in range(2 if (folder / "mrclam").is_dir() else 0):
        recorded = recorded_world(folder / "mrclam", len(ROBOTS), seed)
        yield Lived(f"MRCLAM 6, changes {seed}", recorded.recordings, recorded.position_m)


def warehouse(n_places: int, *, p_gone: float = 0.05) -> Lived:
    """A drive past 200 landmarks of a warehouse that is mapped, some of which have left."""
    config = replace(SESSION, n_landmarks=n_places, rate_hz=2.0)
    recording = simulate_warehouse(config)
    assert recording.true_landmarks is not None
    at = np.stack([recording.true_landmarks.position_m] * 2)
    at[1, np.random.default_rng(0).random(n_places) < p_gone] = np.nan
    left = np.isfinite(at[1, recording.detections.landmark_id, 0])
    recording = replace(recording, detections=rows_of(recording.detections, left))
    pose = se2.inverse(MAP_POSE)
    return Lived(f"warehouse, {n_places:,} landmarks", [recording], at, (), living_map(config), pose)


def lived_through(world: Lived, *, unknown_ids: bool | str) -> dict[str, float]:
    """Enter all sessions; returns how many were found, position error (each aligned) [m], changes by place,
    landmarks in the end and in truth, and CPU seconds."""
    config = load_config(None, ["living.accept=any", *world.overrides, f"slam.unknown_ids={str(unknown_ids).lower()}"])
    living, pose, squared, began = world.begun, world.pose_truth_map, list[float](), time.process_time()
    n_entered, n_told, n_true, n_right, n_found = 0, 0, 0, 0, 0
    first, dim = len(world.position_m) - len(world.recordings), world.position_m.shape[2]
    for number, recording in enumerate(world.recordings, first):
        before, unaided = living, replace(recording, truth=None, true_landmarks=None)  # type: ignore[type-var]
        session = em.run_session(unaided, living, config)
        living, n_entered = session.living, n_entered + session.found
        assert recording.truth is not None
        if pose is None:
            row = np.searchsorted(recording.truth.stamp_s, session.slam.trajectory.stamp_s - 1e-6)
            there = recording.truth.pose_world_robot[np.minimum(row, len(recording.truth.stamp_s) - 1)]
            pose = rigid(session.slam.trajectory.pose_world_robot[:, :dim], there[:, :dim])
        if session.found:
            off = evaluate_trajectory(session.slam.trajectory, recording.truth, rate_hz=RATE_HZ)
            squared += [] if off is None else [off.rmse_m**2]
        if number and before is not None:
            told = _places_told(session, before)
            now, earlier = world.position_m[number], world.position_m[:number]
            every = [_places_changed(then, now) for then in earlier]
            for side, mine in enumerate(told):
                at = group_of(pose).transform(pose, mine)
                n_right += _matched(at, np.unique(np.vstack([changed[side] for changed in every]), axis=0))
                n_found += _matched(at, every[-1][side])
                n_told, n_true = n_told + len(mine), n_true + len(every[-1][side])
    assert living is not None
    return {
        "found": n_entered / len(world.recordings),
        "position_m": math.sqrt(float(np.mean(squared))) if squared else math.nan,
        "precision": n_right / max(n_told, 1),
        "recall": n_found / max(n_true, 1),
        "landmarks": float((living.p_exists() >= 0.5).sum()),
        "true": float(np.isfinite(world.position_m[-1, :, 0]).sum()),
        "cpu_s": time.process_time() - began,
    }


def exchanged_line(world: Lived, column: str) -> str:
    """Return a row of the table of sessions with a column, after half of which two landmarks of a class change places.

    A landmark of the map is what it was in its first session; how many times landmarks were called right and wrong, and
    what was reported of the two in the session after.
    """
    config = load_config(None, ["living.accept=any", *world.overrides, "slam.unknown_ids=true"])
    names = np.unique(np.concatenate([recording.detections.landmark_id for recording in world.recordings]))
    one, other = _two_alike(world.recordings)
    living, first, called, told = world.begun, dict[int, int](), [0, 0], list[str]()
    for number, given in enumerate(world.recordings):
        assert given.dim == 2
        true = given.detections.landmark_id.copy()
        if number >= len(world.recordings) // 2:
            true[given.detections.landmark_id == one], true[given.detections.landmark_id == other] = other, one
        recording = replace(given, detections=replace(given.detections, landmark_id=true), truth=None)
        session = em.run_session(with_columns(recording, column, names=names, session=number + 1), living, config)
        living, name = session.living, session.recording.detections.landmark_id
        if len(name) != len(true):  # the cleaning has dropped a frame
            continue
        for each in np.unique(name[(name != UNKNOWN) & (true != UNKNOWN)]).tolist():
            real = int(np.bincount(true[(name == each) & (true != UNKNOWN)]).argmax())
            called[first.setdefault(each, real) != real] += 1
        if number == len(world.recordings) // 2:
            of_both = {each for each, real in first.items() if real in (one, other)}
            told = [change.kind.value for change in session.changes if of_both & set(change.landmark_ids)]
    assert living is not None
    found = int((living.p_exists() >= 0.5).sum())
    return f"| {world.name} | {column} | {called[0]} / {called[1]} | {', '.join(told) or 'nothing'} | {found} |"


def _two_alike(recordings: Sequence[Recording | SpatialRecording]) -> tuple[int, int]:
    """Two landmarks of one class that are seen more than ten times in every recording."""
    every = [recording.detections for recording in recordings]
    often = [np.unique(seen.landmark_id, return_counts=True) for seen in every]
    common = functools.reduce(np.intersect1d, [name[(count > 10) & (name != UNKNOWN)] for name, count in often])
    kind = [int(every[0].class_id[every[0].landmark_id == one][0]) for one in common]
    pairs = [(a, b) for a in range(len(common)) for b in range(a + 1, len(common)) if kind[a] == kind[b]]
    a, b = next((a, b) for a, b in pairs if b == max(other for first, other in pairs if first == a))
    return int(common[a]), int(common[b])


def _places_told(session: Session, before: LivingMap) -> tuple[FloatArray, FloatArray]:
    """Places in the map that landmarks left, and that they came to, as a session tells."""
    found: tuple[list[FloatArray], list[FloatArray]] = ([], [])
    for rows, living, none in zip(found, (before, session.living), (COMES, (ChangeKind.VANISHED,)), strict=True):
        known = living.landmarks()
        ids = [i for change in session.changes if change.kind not in none for i in change.landmark_ids]
        rows += [known.position_m[known.landmark_id == one] for one in ids]
    left, came = (np.vstack([np.zeros((0, before.dim)), *rows]) for rows in found)
    return left, came


def _places_changed(was: FloatArray, now: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (L, D) that landmarks really left, and that they came to."""
    changed = ~np.all((was == now) | (np.isnan(was) & np.isnan(now)), axis=1)
    return was[changed & np.isfinite(was[:, 0])], now[changed & np.isfinite(now[:, 0])]


def _matched(mine: FloatArray, theirs: FloatArray) -> int:
    """How many points of two sets lie together, one to one."""
    away = np.linalg.norm(mine[:, None] - theirs[None], axis=2)
    return int(np.count_nonzero(away[linear_sum_assignment(np.minimum(away, NEAR_M))] < NEAR_M))


def as_markdown(shown: dict[str, Any]) -> str:
    """Return the table."""
    lines = [
        "| recording | precision | recall | landmarks (true) | position error without / with [m] | ratio | CPU [s] |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [_line(Score(**row)) for row in shown["rows"]]
    return "\n".join(lines)


def _line(row: Score) -> str:
    return (
        f"| {row.name} | {row.precision:.3f} | {row.recall:.3f} | {row.found} ({row.true}) "
        f"| {row.without_m:.3f} / {row.with_m:.3f} | {row.ratio:.2f} | {row.association_s:.1f} of {row.all_s:.1f} |"
    )


def _planar(path: Path, **options: Any) -> Recording:
    recording = read_recording(path, **options)
    assert recording.dim == 2
    return recording


def _truth(recording: Recording | SpatialRecording, named: SlamResult) -> Trajectory:
    """The truth of the poses, or what the identities lead to."""
    if recording.truth is not None:
        return recording.truth
    return replace(named.trajectory, frame="truth")


def main(names: Sequence[str] = (), folder: Path = FOLDER) -> None:
    """Print one line as soon as it is known; names are beginnings of those wanted, after one of the words above.

    Recordings are read from `folder`.
    """
    if names and names[0] == "sessions":
        for world in (each for each in worlds() if each.name.startswith(tuple(names[1:]) or "")):
            half = replace(world, recordings=[partly_named(one, 0.5, "landmarks") for one in world.recordings])
            ways = (("with", world, False), ("half", half, "empty"), ("without", world, True))
            for name, lived, unknown_ids in ways:
                row = lived_through(lived, unknown_ids=unknown_ids)
                cells = [f"{value:.3f}" if value < 10.0 else f"{value:.0f}" for value in row.values()]
                print(f"| {world.name} | {name} | {' | '.join(cells)} |", flush=True)
        return
    if names and names[0] == "exchanged":
        for world in (each for each in worlds() if each.name.startswith(tuple(names[1:]) or ("rooms", "building"))):
            for name in EXCHANGED:
                print(exchanged_line(world, name), flush=True)
        return
    if names and names[0] == "columns":
        rooms = (replace(one, name="rooms") for one in simulated_world(1, 0).recordings[:1])
        planar = itertools.chain(rooms, (simulate_copied_aisles(0),), recordings(folder, parks=1))
        for recording in itertools.chain(planar, recordings_in_space(folder)):
            for name in COLUMNS if not names[1:] or recording.name.startswith(tuple(names[1:])) else ():
                row = score(with_columns(recording, name))
                print(_line(replace(row, name=f"{row.name}, {name}")), flush=True)
        return
    if names and names[0] == "mixed":
        for recording in itertools.chain(recordings(folder), recordings_in_space(folder)):
            for name, share, of in MIXED if not names[1:] or recording.name.startswith(tuple(names[1:])) else ():
                if recording.name.startswith(name):
                    print(mixed_line(recording, share, of), flush=True)
        return
    if names and names[0] == "wrong":
        for recording in itertools.chain(recordings(folder, parks=1), recordings_in_space(folder)):
            if not names[1:] or recording.name.startswith(tuple(names[1:])):
                print(wrong_line(recording), flush=True)
        return
    every: Iterator[Recording | SpatialRecording] = recordings(folder)
    if names and names[0] in ("space", "harsh"):
        every, names = recordings_in_space(folder) if names[0] == "space" else harsh_worlds(), names[1:]
    for recording in every:
        if not names or recording.name.startswith(tuple(names)):
            print(_line(score(recording)), flush=True)


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
