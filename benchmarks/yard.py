"""What do tags on forklifts that drive cost? A yard with all of them driving, and the same yard standing.

    python -m benchmarks.yard --seeds 10          # a row a seed, then all
    python -m benchmarks.yard --seeds 10 --points # tags without orientations
    python -m benchmarks.yard --seeds 5 --map     # three days in a living map
    python -m benchmarks.yard --seeds 5 --bodies boxes    # found by boxes around forklifts, not stated; or by motion
    python -m benchmarks.yard --seeds 10 --first 20 --owners  # which tags are found to be on bodies, by each evidence

Four runs a seed: all forklifts drive and stop; the same yard standing; and both without what is on them. All have the
same noise, of a tag in a frame and of the odometry: with draws of their own the yards with walls only differ by a half.
In the standing yard the tags on forklifts are landmarks like those on the walls; what driving itself costs shows beside
the standing yard with walls only. Errors are of positions along the floor [m], after a rigid motion. A change is false
unless it is a move of landmarks of one forklift that moved in that time, by so much. With `--bodies` nobody states
which tags are on one forklift: boxes without identity around them show it, or how they move. A fifth run of the yard
that moves is then that with the statement. What is reported of boxes themselves is not counted.

In a living map two forklifts drive in each of three drives, and four are parked elsewhere each time; or all stands. A
statement is false if it is of a wall, of what stands, or of two forklifts; and of one forklift there is one.

With `--owners` nothing is solved: of the tags that were seen on forklifts it counts those found to be on a body,
and the bodies that are wrong, with a tag of a wall or of two forklifts.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

import evermap as em
from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.slam.ownership import find_owned
from evermap.types import UNKNOWN, AnyRecording, ChangeKind, IntArray, MapChange, SlamResult, rows_of
from evermap_studies.worlds.yard import SENSOR_HEIGHT_M, STEP_S, YardConfig, YardDrive, flatten, simulate_yard

BODIES = "stated", "boxes", "motion"
"""How it is known which tags are on one forklift."""
LEAST_M, WRONG_M = 0.1, 0.5
"""By which a forklift moved at least, and by which a stated displacement is off at most [m]."""


def error_m(result: SlamResult, drive: YardDrive) -> float:
    """Return the root mean square of errors of positions along the floor."""
    truth = drive.recording.truth
    assert truth is not None
    rows = np.searchsorted(truth.stamp_s, result.trajectory.stamp_s - 1e-6)
    there, here = truth.pose_world_robot[rows, :3], result.trajectory.pose_world_robot[:, :3]
    off = se3.transform(rigid(here, there), here) - there
    return float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()))


def keep_walls(drive: YardDrive) -> YardDrive:
    """Return a drive in which nothing on a forklift was detected."""
    given = drive.recording
    name = given.detections.landmark_id
    on_walls = (name != UNKNOWN) & (drive.body_of_tag[name] < 0)
    return drive._replace(recording=replace(given, detections=rows_of(given.detections, on_walls)))


def with_noise(drive: YardDrive, like: YardDrive, config: YardConfig, seed: int) -> YardDrive:
    """Return a drive with the odometry of another one, and with noise that depends on tag and frame only."""
    given = drive.recording
    seen, truth = given.detections, given.truth
    assert truth is not None
    named = np.flatnonzero(seen.landmark_id != UNKNOWN)
    tag, frame = seen.landmark_id[named], seen.frame[named]
    drawn = np.random.default_rng([seed, 3]).normal(size=(*drive.tag.shape[:2], 6))[tag, frame]
    eye = truth.pose_world_robot + [0.0, 0.0, SENSOR_HEIGHT_M, 0.0, 0.0, 0.0, 0.0]
    local = se3.between(eye[frame], drive.tag[tag, frame])
    local[:, :3] += drawn[:, :3] * np.sqrt(seen.covariance_sensor_m2[named, :1, 0])
    drawn[:, :3] = 0.0
    position, turned = seen.position_sensor_m.copy(), seen.rotation.copy()
    position[named] = local[:, :3]
    if config.oriented:
        turned[named] = se3.retract(local, config.sigma_rad * drawn)[:, 3:]
    noisy = replace(seen, position_sensor_m=position, rotation=turned)
    return drive._replace(recording=replace(given, detections=noisy, odometry=like.recording.odometry))


def is_true(change: MapChange, drive: YardDrive) -> bool:
    """Return whether a change is a move of landmarks of one forklift that moved so."""
    tags = np.array(change.landmark_ids)
    if (tags >= len(drive.body_of_tag)).any():  # an identity that nothing has
        return False
    if change.kind not in (ChangeKind.MOVED, ChangeKind.ROTATED) or len(np.unique(drive.body_of_tag[tags])) > 1:
        return False
    begin_s = float(drive.recording.frames.stamp_s[0])
    first, last = (
        min(max(round((at_s - begin_s) / STEP_S), 0), drive.tag.shape[1] - 1)
        for at_s in (change.stamp_from_s, change.stamp_to_s)
    )
    shifts = drive.tag[tags, last, :3] - drive.tag[tags, first, :3]
    shifts = np.vstack([shifts.mean(axis=0), shifts])  # of points one may be all that was seen
    told = np.linalg.norm(np.array(change.displacement_m) - shifts, axis=1).min() < WRONG_M
    return bool(drive.body_of_tag[tags[0]] >= 0 and np.linalg.norm(shifts, axis=1).max() > LEAST_M and told)


def enter_drives(usual: YardConfig, seeds: range) -> None:
    """Run and print days in a living map."""
    total = np.zeros(4, dtype=np.int64)
    print("seed  yard      errors                  statements  false  twice  others  verdicts")
    for seed in seeds:
        for config in (replace(usual, days=3, moving=2, parked=4), replace(usual, days=3, standing=True)):
            living, errors, verdicts, count = None, [], [], np.zeros(4, dtype=np.int64)
            for drive in simulate_yard(config, seed):
                entered = em.run_session(drive.recording, living, em.Config(living={"accept": "any"}))
                living = entered.living
                errors.append(error_m(entered.slam, drive))
                verdicts.append("" if entered.slam.verdict is None else str(entered.slam.verdict.kind.value))
                told = [_bodies_of(change, drive) for change in entered.changes]
                right = [len(one) == 1 and -1 not in one and not config.standing for one in told]
                once = len({min(one) for one, good in zip(told, right, strict=True) if good})
                others = sum(name >= len(drive.tag) for name in living.members.landmark_id.tolist())
                count += [len(told), right.count(False), right.count(True) - once, others]
                for change, good in zip(entered.changes, right, strict=True):
                    if not good:
                        print(f"      false: {change}")
            total += count
            row = " ".join(f"{one:.4f}" for one in errors)
            name = "standing" if config.standing else "moving"
            print(f"{seed:4d}  {name:8s}  {row}  " + " ".join(f"{one:6d}" for one in count.tolist()), *verdicts)
    print("all", *total.tolist())


def _bodies_of(change: MapChange, drive: YardDrive) -> set[int]:
    """Forklifts that a change is of, -1 of walls, and of identities that nothing has."""
    known = [name for name in change.landmark_ids if name < len(drive.body_of_tag)]
    found = set(drive.body_of_tag[known].tolist())
    return found if len(known) == len(change.landmark_ids) else {*found, -1}


def group_owners(drive: YardDrive, landmark_id: IntArray, object_id: IntArray) -> list[list[int]]:
    """Return the forklifts (-1 for walls) that the landmarks (K,) of each body (K,) are on."""
    forklift = drive.body_of_tag[landmark_id]
    return [forklift[object_id == one].tolist() for one in np.unique(object_id)]


def is_pure(groups: list[list[int]]) -> bool:
    """Return whether every body has landmarks of one forklift only."""
    return all(len(set(one)) == 1 and -1 not in one for one in groups)


def count_owned(drive: YardDrive, recording: AnyRecording) -> list[int]:
    """Return numbers of tags seen on forklifts, of those that are found to be on bodies, and of wrong bodies."""
    seen = np.unique(drive.recording.detections.landmark_id)
    seen = seen[seen != UNKNOWN]
    found = find_owned(recording, em.Config())
    wrong = sum(not is_pure([one]) for one in group_owners(drive, found.landmark_id, found.object_id))
    on_forklifts = (drive.body_of_tag[names] >= 0 for names in (seen, found.landmark_id))
    return [*(int(one.sum()) for one in on_forklifts), wrong]


def find_owners(usual: YardConfig, seeds: range) -> None:
    """Print which tags are found to be on bodies, in space and in the plane, where boxes cannot be."""
    usual = replace(usual, stated=False, boxed=False)
    yards = {
        "nothing": usual,
        "boxes": replace(usual, boxed=True),
        "masks": replace(usual, masked="image", walls_masked=True),
    }
    print("beside motion  in     seen  found  wrong bodies")
    for name, config in yards.items():
        drives = [simulate_yard(config, seed)[0] for seed in seeds]
        spaces = {"space": [one.recording for one in drives]}
        if name != "boxes":
            spaces["plane"] = [flatten(one.recording) for one in drives]
        for space, recordings in spaces.items():
            counts = np.sum([count_owned(*one) for one in zip(drives, recordings, strict=True)], axis=0)
            print(f"{name:13s}  {space}  {counts[0]:4d}  {counts[1]:5d}  {counts[2]:5d}")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--points", action="store_true", help="tags without orientations")
    parser.add_argument("--wall-tags", type=int, default=YardConfig().wall_tags)
    parser.add_argument("--bodies", choices=BODIES, default="stated", help="who says which tags are on one forklift")
    parser.add_argument("--map", action="store_true", help="days in a living map")
    parser.add_argument("--owners", action="store_true", help="which tags are found to be on bodies")
    asked = parser.parse_args()
    usual = YardConfig(
        moving=6, parked=0, oriented=not asked.points, wall_tags=asked.wall_tags, stated=asked.bodies == "stated",
        boxed=asked.bodies == "boxes",
    )  # fmt: skip
    seeds = range(asked.first, asked.first + asked.seeds)
    if asked.map:
        enter_drives(usual, seeds)
        return
    if asked.owners:
        find_owners(usual, seeds)
        return
    rows = []
    print("seed  standing  moving  without: moving  standing  changes  false  verdicts")
    for seed in seeds:
        moving, standing = (simulate_yard(replace(usual, standing=still), seed)[0] for still in (False, True))
        moving, standing = (with_noise(one, standing, usual, seed) for one in (moving, standing))
        drives = standing, moving, keep_walls(moving), keep_walls(standing)
        found = [em.run_slam(one.recording) for one in drives]
        errors = [error_m(result, one) for result, one in zip(found, drives, strict=True)]
        told = [
            (change, one)
            for result, one in zip(found, (standing, moving), strict=False)
            for change in result.changes
            if min(change.landmark_ids) < len(one.tag)
        ]
        false = [change for change, one in told if not is_true(change, one)]
        stated = with_noise(simulate_yard(replace(usual, stated=True, boxed=False), seed)[0], standing, usual, seed)
        best = errors[1] if usual.stated else error_m(em.run_slam(stated.recording), stated)
        rows.append([*errors, len(told), len(false), best])
        verdicts = " ".join("" if result.verdict is None else str(result.verdict.kind.value) for result in found)
        print(
            f"{seed:4d} " + " ".join(f"{one:8.4f}" for one in errors) + f" {len(told):8d} {len(false):6d}  {verdicts}"
        )
        for change in false:
            print(f"      false: {change}")
    table = np.array(rows)
    rms = np.sqrt((table[:, :4] ** 2).mean(axis=0))
    print(
        "rms  " + " ".join(f"{one:8.4f}" for one in rms) + f" {int(table[:, 4].sum()):8d} {int(table[:, 5].sum()):6d}"
    )
    for column, name in ((0, "standing"), (3, "standing, walls only")):
        ratio = np.median(table[:, 1] / table[:, column])
        print(f"moving over {name}: {rms[1] / rms[column]:.3f} of the rms, {ratio:.3f} in the median")
    if not usual.stated:
        best = float(np.sqrt((table[:, 6] ** 2).mean()))
        ratio = np.median(table[:, 1] / table[:, 6])
        print(f"moving over the same stated, {best:.4f} m: {rms[1] / best:.3f} of the rms, {ratio:.3f} in the median")


if __name__ == "__main__":
    main()
