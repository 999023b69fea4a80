"""Robots that see each other, solved together: what do they gain over each alone?

The robots of MRCLAM recordings, from an unknown map: each alone; as one problem that shares landmarks; and with what
they measured of each other. Errors after the alignment of each robot's own path, landmarks after their own.

    python -m benchmarks.together shared/data/mrclam/MRCLAM_Dataset6.zip ...

And as a fleet that keeps one living map, of a recording with the true paths of its robots: is that worse than one robot
after the other? Each drive is cut in two sessions, with a night in between, in which two landmarks vanish, two appear
and two move by 0.5 m, in the detections, by the true poses. The sessions enter a map at their own times, so that those
of the robots overlap; shifted, so that each begins when the one before has ended; and each robot's two enter a map of
its own:

    python -m benchmarks.together --changes 6 shared/data/mrclam/MRCLAM_Dataset6.zip
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from evermap.geometry import se2
from evermap.io import list_robots, read_planar
from evermap.maps.diff import diff
from evermap.maps.store import open_store
from evermap.metrics.trajectory import align_points, evaluate_trajectory
from evermap.pipeline import run_slam, run_together
from evermap.runs.sessions import enter_session
from evermap.types import ChangeKind, FloatArray, Recording, SlamResult, Trajectory, rows_of

HEAD = """| recording | robots | position [m] | heading [degrees] | NEES | landmarks [m] |
|---|---|---:|---:|---:|---:|"""


def scores(recording: Recording, result: SlamResult) -> list[float]:
    """Return RMSE of position [m] and heading [degrees], mean NEES, RMSE of landmarks [m]; nan without truth."""
    told, truth = [np.nan] * 3, recording.true_landmarks
    if recording.truth is not None:
        errors = evaluate_trajectory(result.trajectory, recording.truth, rate_hz=2.0)
        heading = np.degrees(np.sqrt(np.mean(errors.heading_error_rad**2)))
        told = [float(np.sqrt(np.mean(errors.position_error_m**2))), float(heading), float(np.nanmean(errors.nees))]
    if truth is None:
        return [*told, np.nan]
    _, mine, theirs = np.intersect1d(result.landmarks.landmark_id, truth.landmark_id, return_indices=True)
    at, true = result.landmarks.position_m[mine], truth.position_m[theirs]
    away = se2.transform(align_points(at, true), at) - true
    return [*told, float(np.sqrt(np.mean(np.sum(away**2, axis=1))))]


def ways(recordings: Mapping[int, Recording]) -> dict[str, FloatArray]:
    """Return (R, 4) scores of the robots in each way."""
    blind = {number: replace(recording, robot_sightings=None) for number, recording in recordings.items()}
    results = {
        "each alone": {number: run_slam(recording) for number, recording in recordings.items()},
        "one map": run_together(blind),
        "one map, and each other": run_together(recordings),
    }
    return {
        name: np.array([scores(recordings[number], result) for number, result in found.items()])
        for name, found in results.items()
    }


MOVE_M = 0.5
NIGHT_S, GAP_S = 43_200.0, 1.0
"""Between the first and the second sessions, and between those of robots that drive one after the other."""
CHANGES_HEAD = (
    "| data set | sessions | entered | position [m] | log loss | precision of changes | recall | move [m] |\n"
    "|---|---|---:|---:|---:|---:|---:|---:|"
)


@dataclass(frozen=True)
class World:
    """What changes between the first and the second sessions: landmarks by kind, and where they move."""

    kind: Mapping[int, ChangeKind]
    step_m: Mapping[int, FloatArray]

    @classmethod
    def drawn(cls, landmark_id: Sequence[int], rng: np.random.Generator) -> World:
        """Return two landmarks of each kind."""
        kinds = [ChangeKind.VANISHED, ChangeKind.APPEARED, ChangeKind.MOVED] * 2
        kind = dict(zip(rng.permutation(landmark_id).tolist(), kinds, strict=False))
        angle = rng.uniform(-np.pi, np.pi, len(kind))
        steps = MOVE_M * np.column_stack([np.cos(angle), np.sin(angle)])
        return cls(kind, dict(zip(kind, steps, strict=True)))

    def seen(self, recording: Recording, *, after: bool) -> Recording:
        """Return a session as it would have been before or after the changes."""
        found, truth, survey = recording.detections, recording.truth, recording.true_landmarks
        assert truth is not None
        assert survey is not None
        of = {kind: [name for name, one in self.kind.items() if one is kind] for kind in ChangeKind}
        found = rows_of(found, ~np.isin(found.landmark_id, of[ChangeKind.VANISHED if after else ChangeKind.APPEARED]))
        range_m, bearing_rad = found.range_m.copy(), found.bearing_rad.copy()
        stamp_s = recording.frames.stamp_s[found.frame]
        pose = np.column_stack([np.interp(stamp_s, truth.stamp_s, row) for row in _unwrapped(truth.pose_world_robot).T])
        for name in of[ChangeKind.MOVED] if after else []:
            rows = np.flatnonzero(found.landmark_id == name)
            at = survey.position_m[survey.landmark_id == name][0]
            old, new = (point - pose[rows, :2] for point in (at, at + self.step_m[name]))
            range_m[rows] += np.linalg.norm(new, axis=1) - np.linalg.norm(old, axis=1)
            turned = np.arctan2(new[:, 1], new[:, 0]) - np.arctan2(old[:, 1], old[:, 0])
            bearing_rad[rows] = np.angle(np.exp(1j * (bearing_rad[rows] + turned)))
        return replace(recording, detections=replace(found, range_m=range_m, bearing_rad=bearing_rad))


def _whole_truth(recording: Recording) -> bool:
    """Return whether the true path is known during nearly all of a recording."""
    truth, frame_s = recording.truth, recording.frames.stamp_s
    return truth is not None and np.ptp(truth.stamp_s) > 0.9 * np.ptp(frame_s)


def _unwrapped(pose: FloatArray) -> FloatArray:
    return np.column_stack([pose[:, :2], np.unwrap(pose[:, 2])])


def _cut(recording: Recording, from_s: float, to_s: float, late_s: float, name: str) -> Recording:
    """Return a part of a recording, moved in time."""

    def part(table, stamp_s):  # type: ignore[no-untyped-def]
        return rows_of(table, (stamp_s >= from_s) & (stamp_s < to_s))

    frames = recording.frames
    kept = (frames.stamp_s >= from_s) & (frames.stamp_s < to_s)
    number = np.cumsum(kept) - 1
    found = rows_of(recording.detections, kept[recording.detections.frame])
    odometry, truth = part(recording.odometry, recording.odometry.stamp_s), recording.truth
    assert truth is not None
    truth = part(truth, truth.stamp_s)
    return replace(
        recording,
        name=name,
        robot=name.partition(",")[0],
        robot_sightings=None,
        odometry=replace(odometry, stamp_s=odometry.stamp_s + late_s),
        frames=replace(rows_of(frames, kept), stamp_s=frames.stamp_s[kept] + late_s),
        detections=replace(found, frame=number[found.frame]),
        truth=replace(truth, stamp_s=truth.stamp_s + late_s),
    )


def sessions(recordings: Mapping[int, Recording], world: World, *, overlap: bool) -> list[Recording]:
    """Return the first halves of all drives, then the second ones, each at its own time or after the one before."""
    first_s = max(one.frames.stamp_s[0] for one in recordings.values())
    last_s = min(one.frames.stamp_s[-1] for one in recordings.values())
    middle_s, found = 0.5 * (first_s + last_s), []
    long_s = middle_s - first_s + GAP_S
    for after, (from_s, to_s) in enumerate([(first_s, middle_s), (middle_s, last_s)]):
        for rank, (number, recording) in enumerate(recordings.items()):
            late_s = after * NIGHT_S if overlap else (after * (len(recordings) - 1) + rank) * long_s + after * NIGHT_S
            part = _cut(recording, from_s, to_s, late_s, f"robot {number}, part {after + 1}")
            found.append(world.seen(part, after=bool(after)))
    return sorted(found, key=lambda one: float(one.frames.stamp_s[0]))


def kept_map(parts: Sequence[Recording], world: World) -> FloatArray:
    """Return what came of sessions in a map: entered, position error [m], log loss, changes found, told and true, and
    the errors of moves [m], summed, with their number.
    """
    survey = parts[0].true_landmarks
    assert survey is not None
    squares, entered, before = [], 0, 0
    with tempfile.TemporaryDirectory() as folder, open_store(Path(folder) / "map.evermap", create=True) as store:
        for part in parts:
            result = enter_session(store, part)
            if not result.session.found:
                continue
            entered += 1
            number = result.commit(store)
            before = number if part.name.endswith("part 1") else before
            assert part.truth is not None
            path: Trajectory = result.session.slam.trajectory
            squares.append(evaluate_trajectory(path, part.truth, rate_hz=2.0).position_error_m ** 2)
        told, living = diff(store, before), store.load()
    p = dict(zip(living.members.landmark_id.tolist(), living.p_exists().tolist(), strict=True))
    there = {int(name): world.kind.get(int(name)) is not ChangeKind.VANISHED for name in survey.landmark_id}
    loss = [
        -np.log(np.clip(p.get(name, 0.0) if is_there else 1.0 - p.get(name, 0.0), 1e-6, 1.0))
        for name, is_there in there.items()
    ]
    said = {name: change for change in told.changes for name in change.landmark_ids}
    right = [name for name, change in said.items() if world.kind.get(name) is change.kind]
    moves = [said[name].displacement_m for name in right if said[name].kind is ChangeKind.MOVED]
    steps = [np.linalg.norm(world.step_m[name]) for name in right if said[name].kind is ChangeKind.MOVED]
    off = [abs(float(np.hypot(*move[:2])) - step) for move, step in zip(moves, steps, strict=True)]
    position_m = float(np.sqrt(np.mean(np.concatenate(squares))))
    return np.array([entered, position_m, np.mean(loss), len(right), len(said), len(world.kind), sum(off), len(off)])


def changing(recordings: Mapping[int, Recording], worlds: int) -> dict[str, FloatArray]:
    """Return the means of `kept_map` over worlds that change, in each way."""
    ways: dict[str, list[FloatArray]] = {}
    survey = next(iter(recordings.values())).true_landmarks
    assert survey is not None
    for seed in range(worlds):
        world = World.drawn(survey.landmark_id.tolist(), np.random.default_rng(seed))
        for name, overlap in (("as a fleet, at once", True), ("one after the other", False)):
            ways.setdefault(name, []).append(kept_map(sessions(recordings, world, overlap=overlap), world))
        alone = [kept_map(sessions({number: one}, world, overlap=True), world) for number, one in recordings.items()]
        ways.setdefault("a map for each robot", []).append(np.mean(alone, axis=0) * [len(alone), *[1.0] * 7])
    return {name: np.mean(found, axis=0) for name, found in ways.items()}


def changes_as_markdown(path: str, found: Mapping[str, FloatArray]) -> str:
    """Return the rows of the table."""
    return "\n".join(
        f"| {Path(path).name} | {name} | {entered:.1f} | {position_m:.3f} | {loss:.3f} | {right / max(told, 1e-9):.2f} "
        f"| {right / true:.2f} | {off_m / max(moves, 1e-9):.3f} |"
        for name, (entered, position_m, loss, right, told, true, off_m, moves) in found.items()
    )


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", help="each with several robots")
    parser.add_argument("--changes", type=int, default=0, metavar="N", help="a fleet in N worlds that change, instead")
    given = parser.parse_args()
    if given.changes:
        print(CHANGES_HEAD)
        for path in given.recordings:
            recordings = {number: read_planar(path, robot=number) for number in list_robots(path)}
            if not all(_whole_truth(one) for one in recordings.values()):
                parser.error(f"--changes needs the true paths of all robots, as in data set 6; not in {path}")
            print(changes_as_markdown(path, changing(recordings, given.changes)), flush=True)
        return
    print(HEAD)
    for path in given.recordings:
        recordings = {number: read_planar(path, robot=number) for number in list_robots(path)}
        for name, found in ways(recordings).items():
            known = ~np.isnan(found).all(axis=0)
            mean = np.where(known, np.nanmean(np.where(known, found, 0.0), axis=0), np.nan)
            row = " | ".join(
                "–" if np.isnan(one) else f"{one:.{n}f}" for one, n in zip(mean, (3, 2, 1, 3), strict=True)
            )
            print(f"| {path.rsplit('/', 1)[-1]} | {name} | {row} |", flush=True)


if __name__ == "__main__":
    main()
