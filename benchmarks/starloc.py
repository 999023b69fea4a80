"""A stereo rig carried by hand through a motion-capture room, without odometry and without a start, beside gtsam.

All sessions of STAR-loc that are at hand, from an unknown map and with the published survey, of which two labels are
swapped (35 and 36, by the sightings of every session): with these put right, and as published. gtsam gets the same
pixels as stereo factors of 1 px with the loss of Geman and McClure, the same survey (the loss on it, too) and the same
bounds on how far a hand goes between frames (1 m/s, 0.7 rad/s); and, what we do not get, poses and places at the
truth to start from. Errors are those of poses that we call located, the same for both, after rigid alignment;
landmarks after that alignment.

    python -m benchmarks.starloc [shared/data/starloc]

With `--sweep` the survey is edited in ways of which the truth is known: entries moved (`moved`: shares and distances of
EDITS), a part of them at each other's places (`rearranged`), about half (`half`), or all (`another`: nothing may be
told of single entries). Every row is a run by `run_slam`, or with `--audit` by `evermap audit`, with what it says of
entries that were seen three times or more, and gtsam's error with the same survey. Design and held-out sessions and
seeds are apart.

    python -m benchmarks.starloc --sweep [--held-out] [--audit] [--only SESSION..] [--kinds KIND..]

With `--maps` both sessions of a route enter one map, and some tags are moved between them: their sightings in the
second are displaced by what the truth of the rig says that they would have been. A moved tag that both saw three times
or more is to be told; of the others, which stand, nothing is, and least of all that they vanished.

    python -m benchmarks.starloc --maps [--draws 3] [--only ROUTE..]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import evermap as em
from evermap.geometry import se3
from evermap.io import read_recording
from evermap.io.rig_toml import CAMERA_FILE
from evermap.metrics.trajectory import align_poses
from evermap.runs.audit.run import audit_map
from evermap.types import FloatArray, IntArray, Landmarks, SpatialRecording

FOLDER = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "starloc"
SWAPPED = (35, 36)
"""Labels of the published survey that are each other's."""
SIGMA_SURVEY = 0.02
SIGMA_PX, SHAPE = 1.0, 5.0
"""Noise of gtsam's stereo factors [px] and the shape of their loss, the best of 2 and 5."""
SHAPE_OF_SURVEY = 1.0
HAND_MPS, HAND_RADPS = 1.0, 0.7
TABLE = "| session | map | poses | ours, RMSE [m] | gtsam | ratio | landmarks, RMSE [m] | gtsam | CPU [s] |"


@dataclass(frozen=True, slots=True)
class Row:
    """One session beside gtsam.

    Attributes:
        session, known: which, and what map was given.
        located: poses that we report; `frames` could be.
        pose_m, landmark_m: RMSE, ours and gtsam's.
        cpu_s: of ours.
    """

    session: str
    known: str
    located: int
    frames: int
    pose_m: tuple[float, float]
    landmark_m: tuple[float, float]
    cpu_s: float

    @property
    def ratio(self) -> float:
        """Return our error of poses over gtsam's."""
        return self.pose_m[0] / self.pose_m[1]


def recordings(folder: Path) -> Iterator[tuple[str, SpatialRecording, float, float]]:
    """Yield the sessions by name, with their baselines [m] and focal lengths [px]."""
    for place in sorted(folder.glob("*/apriltag_cal_individual.csv.gz")):
        name = place.parent.name
        with tempfile.TemporaryDirectory() as out:
            plain = Path(out) / name
            subprocess.run([sys.executable, folder / "starloc_to_plain.py", folder, name, plain, "--truth"], check=True)
            recording = read_recording(plain)
            rig = tomllib.loads((plain / CAMERA_FILE).read_text(encoding="utf-8"))["camera"]["left"]
        assert isinstance(recording, SpatialRecording)
        yield name, recording, rig["baseline_m"], rig["intrinsics"][0]


def corrected(survey: Landmarks) -> Landmarks:
    """Return the survey with the two labels that are each other's put right."""
    label = survey.landmark_id.copy()
    for k in (0, 1):
        label[survey.landmark_id == SWAPPED[k]] = SWAPPED[1 - k]
    order = np.argsort(label)
    return replace(survey, landmark_id=label[order], position_m=survey.position_m[order])


def compare(
    name: str, recording: SpatialRecording, known: str, given: Landmarks | None, rig: tuple[float, float]
) -> Row:
    """Solve a session and score it beside gtsam."""
    truth, survey = recording.truth, recording.true_landmarks
    assert truth is not None
    assert survey is not None
    true_places = dict(zip(corrected(survey).landmark_id.tolist(), corrected(survey).position_m, strict=True))
    began = time.process_time()
    result = em.run_slam(recording, prior_map=None if given is None else given.as_prior(SIGMA_SURVEY))
    cpu_s = time.process_time() - began
    stamps = recording.frames.stamp_s
    frames = np.unique(recording.detections.frame)
    rows = np.searchsorted(stamps, result.trajectory.stamp_s - 1e-4)
    theirs, places = by_gtsam(recording, given, *rig)
    mapped = dict(zip(result.landmarks.landmark_id.tolist(), result.landmarks.position_m, strict=True))
    shared = np.array(sorted(mapped.keys() & places.keys() & true_places.keys()))
    found = []
    for pose, at in ((result.trajectory.pose_world_robot, mapped), (theirs[rows], places)):
        found.append(_errors(pose, truth.pose_world_robot[rows], at, true_places, shared))
    (ours, our_places), (gtsams, their_places) = found
    return Row(name, known, len(rows), len(frames), (ours, gtsams), (our_places, their_places), cpu_s)


def _errors(
    pose: FloatArray, true: FloatArray, at: dict[int, FloatArray], true_places: dict[int, FloatArray], shared: IntArray
) -> tuple[float, float]:
    """RMSE of poses, and of landmarks, after the alignment of the poses."""
    motion = align_poses(pose, true)[0]
    gap = [se3.transform(motion, at[name]) - true_places[name] for name in shared.tolist()]
    return _rms(se3.transform(motion, pose[:, :3]) - true[:, :3]), _rms(np.array(gap))


def _rms(gap: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def by_gtsam(
    recording: SpatialRecording, survey: Landmarks | None, baseline_m: float, focal_px: float
) -> tuple[FloatArray, dict[int, FloatArray]]:
    """Return gtsam's poses (F, 7) and places, started at the truth."""
    import gtsam

    seen, stamps, truth = recording.detections, recording.frames.stamp_s, recording.truth
    assert truth is not None
    pose = truth.pose_world_robot
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for row, one in enumerate(pose):
        start.insert(row, _pose3(one))
    for row, lasted_s in enumerate(np.diff(stamps)):
        sigma = np.repeat([HAND_RADPS * lasted_s, HAND_MPS * lasted_s], 3)
        graph.add(gtsam.BetweenFactorPose3(row, row + 1, gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(sigma)))
    if survey is None:
        graph.add(gtsam.PriorFactorPose3(0, _pose3(pose[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    calibration = gtsam.Cal3_S2Stereo(focal_px, focal_px, 0.0, 0.0, 0.0, baseline_m)
    pixel, place = (
        gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.GemanMcClure.Create(shape), gtsam.noiseModel.Isotropic.Sigma(3, sigma)
        )
        for shape, sigma in ((SHAPE, SIGMA_PX), (SHAPE_OF_SURVEY, SIGMA_SURVEY))
    )
    at = seen.position_sensor_m
    u, v, disparity = focal_px * np.column_stack([at[:, 0], at[:, 1], np.full(len(at), baseline_m)]).T / at[:, 2]
    known = {} if survey is None else dict(zip(survey.landmark_id.tolist(), survey.position_m, strict=True))
    names = np.unique(seen.landmark_id)
    in_world = se3.transform(pose[seen.frame], at)
    for name in names.tolist():
        key = 10**6 + name
        start.insert(key, known.get(name, np.median(in_world[seen.landmark_id == name], axis=0)))
        if name in known:
            graph.add(gtsam.PriorFactorPoint3(key, known[name], place))
    for m in range(len(seen)):
        point = gtsam.StereoPoint2(u[m], u[m] - disparity[m], v[m])
        key = 10**6 + int(seen.landmark_id[m])
        graph.add(gtsam.GenericStereoFactor3D(point, pixel, int(seen.frame[m]), key, calibration))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(200)
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, settings).optimize()
    poses = [found.atPose3(row) for row in range(len(pose))]
    turn = Rotation.from_matrix([one.rotation().matrix() for one in poses]).as_quat()
    return np.hstack([[one.translation() for one in poses], turn]), {
        name: found.atPoint3(10**6 + name) for name in names.tolist()
    }


def _pose3(pose: FloatArray) -> Any:
    import gtsam

    x, y, z, w = pose[3:]
    return gtsam.Pose3(gtsam.Rot3(w, x, y, z), pose[:3])


def run(folder: Path = FOLDER) -> Iterator[Row]:
    """Yield every session from an unknown map, with the survey, and with the survey as published."""
    for name, recording, baseline_m, focal_px in recordings(folder):
        published = recording.true_landmarks
        assert published is not None
        for known, given in (("unknown", None), ("survey", corrected(published)), ("as published", published)):
            yield compare(name, recording, known, given, (baseline_m, focal_px))


@dataclass(frozen=True, slots=True)
class Edit:
    """A way in which a survey is wrong.

    Attributes:
        kind: `published` as it is, `moved`, `rearranged`, `half` or `another`.
        seed: of it; those of held-out edits differ.
        share: of the entries.
        from_m, to_m: distances, as likely in each octave.
    """

    kind: str
    seed: int = 0
    share: float = 0.0
    from_m: float = 0.1
    to_m: float = 2.0

    def of(self, survey: Landmarks) -> Landmarks:
        """Return the survey with this error, beside its own."""
        random, position, count = np.random.default_rng(self.seed), survey.position_m.copy(), len(survey)
        some = random.choice(count, round(self.share * count), replace=False)
        if self.kind == "moved":
            by = random.normal(size=(len(some), 3))
            by /= np.linalg.norm(by, axis=1, keepdims=True)
            position[some] += by * np.exp(random.uniform(np.log(self.from_m), np.log(self.to_m), (len(some), 1)))
        elif self.kind != "published":  # each at the next one's place
            position[some] = position[np.roll(some, 1)]
        return replace(survey, position_m=position)


DESIGNED = ("eight_s2", "loop-2d_s1", "loop-2d-fast_s2", "loop-3d_s2")
"""Sessions on which the decision was designed; the others are held out."""
LARGE_M = 0.3
"""From which a move is large beside what such a camera sees."""
FEWEST = 3
HALF = (0.5, 0.6)
"""Shares of the entries that are at each other's places in a map of which about half is wrong."""


def edits(*, held_out: bool) -> list[Edit]:
    """Return the edits of a sweep."""
    first = 100 if held_out else 0
    return [
        Edit("published"),
        Edit("moved", first + 1, 0.2),
        Edit("moved", first + 2, 0.4 if held_out else 0.35),
        Edit("moved", first + 4, 0.05),
        Edit("moved", first + 6, 0.3, LARGE_M),
        Edit("rearranged", first + 3, 0.3),
        Edit("another", first + 5, 1.0),
        *(Edit("half", first + 20 + k, share) for k, share in enumerate(HALF)),
    ]


@dataclass(frozen=True, slots=True)
class SweepRow:
    """What a run says of an edited survey.

    Attributes:
        session, edit: which.
        right, false, missed: entries told as wrong, of those seen often enough.
        missed_large: of the missed ones, those farther than `LARGE_M`.
        sure: false ones told with more than .99, of all that were seen.
        pose_m: RMSE of poses that we call located, after alignment: ours, and gtsam's with the same survey.
        nees: of positions, in the map, over its expectation, medians; nan of an audit.
        cpu_s: of ours.
        verdict: of the run.
    """

    session: str
    edit: Edit
    right: int
    false: int
    missed: int
    missed_large: int
    sure: int
    pose_m: tuple[float, float]
    nees: float
    cpu_s: float
    verdict: str


def sweep_one(name: str, recording: SpatialRecording, edit: Edit, rig: tuple[float, float], *, audit: bool) -> SweepRow:
    """Solve a session in an edited survey, and score what is said of it."""
    published, truth = recording.true_landmarks, recording.truth
    assert published is not None
    assert truth is not None
    survey = edit.of(published)
    given = survey.as_prior(SIGMA_SURVEY)
    off_m = np.linalg.norm(survey.position_m - corrected(published).position_m, axis=1)
    began, pose_m, nees, verdict = time.process_time(), (np.nan, np.nan), np.nan, ""
    if audit:
        found = audit_map(given, [recording])
        told = {entry.landmark_id: entry.probability for entry in found.faults}
        verdict = "" if found.is_heard else "not heard"
        cpu_s = time.process_time() - began
    else:
        result = em.run_slam(recording, prior_map=given)
        cpu_s = time.process_time() - began
        told = {one: change.probability for change in result.changes for one in change.landmark_ids}
        verdict = "" if result.verdict is None else result.verdict.kind.value
        rows = np.searchsorted(recording.frames.stamp_s, result.trajectory.stamp_s - 1e-4)
        pose, true = result.trajectory.pose_world_robot, truth.pose_world_robot[rows]
        theirs = by_gtsam(recording, survey, *rig)[0][rows]
        pose_m = tuple(
            _rms(se3.transform(align_poses(one, true)[0], one[:, :3]) - true[:, :3]) for one in (pose, theirs)
        )
        own = np.einsum("nji,nj->ni", se3.rotation_of(pose), pose[:, :3] - true[:, :3])
        spread = result.trajectory.covariance[:, :3, :3]
        nees = float(np.median(np.einsum("ni,nij,nj->n", own, np.linalg.inv(spread), own))) / float(chi2.median(3))
    hits = dict(
        zip(*(one.tolist() for one in np.unique(recording.detections.landmark_id, return_counts=True)), strict=True)
    )
    seen = np.array([hits.get(one, 0) for one in survey.landmark_id.tolist()])
    p_wrong = np.array([told.get(one, 0.0) for one in survey.landmark_id.tolist()])
    wrong, often = off_m > 0.0, seen >= FEWEST
    says = p_wrong > 0.5
    return SweepRow(
        name, edit, int(np.sum(often & wrong & says)), int(np.sum(often & ~wrong & says)),
        int(np.sum(often & wrong & ~says)), int(np.sum(often & (off_m > LARGE_M) & ~says)),
        int(np.sum((seen > 0) & ~wrong & (p_wrong > 0.99))), pose_m, nees, cpu_s, verdict,
    )  # fmt: skip


def print_sweep(folder: Path, *, held_out: bool, audit: bool, only: list[str], kinds: list[str]) -> None:
    """Print every run of a sweep, and the sums by the kind of edit."""
    print(
        "| session | edit | right | false | missed | large ones | false > .99 | ours [m] | gtsam | NEES | CPU [s] | |"
    )
    print("|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---|")
    found = list[SweepRow]()
    for name, recording, baseline_m, focal_px in recordings(folder):
        if (name in only) if only else ((name in DESIGNED) != held_out):
            for edit in edits(held_out=held_out):
                if kinds and edit.kind not in kinds:
                    continue
                row = sweep_one(name, recording, edit, (baseline_m, focal_px), audit=audit)
                found.append(row)
                said = f"{edit.kind} {100 * edit.share:.0f} % {edit.seed}"
                print(
                    f"| {name} | {said} | {row.right} | {row.false} | {row.missed} | {row.missed_large} | {row.sure} "
                    f"| {row.pose_m[0]:.3f} | {row.pose_m[1]:.3f} | {row.nees:.1f} | {row.cpu_s:.1f} | {row.verdict} |",
                    flush=True,
                )
    for kind in dict.fromkeys(row.edit.kind for row in found):
        of = [row for row in found if row.edit.kind == kind]
        right, false, missed, sure = (
            sum(getattr(row, one) for row in of) for one in ("right", "false", "missed", "sure")
        )
        print(
            f"{kind}: precision {right / max(right + false, 1):.3f}, recall {right / max(right + missed, 1):.3f}, "
            f"{sure} false with more than .99, {right + missed} wrong entries"
        )


@dataclass(frozen=True, slots=True)
class Kept:
    """What a map of two sessions tells of tags, those that both saw three times or more.

    Attributes:
        route, seed: which.
        found: whether the second session was localised; of one set aside nothing can be told, true or false.
        moved, told: tags that were moved, and those of them that are told as changed with more than .5.
        missed_m: distances of the moved ones that are not told.
        standing, false: tags that stand, and those of them that are told with more than .5.
        vanished: of these, those told as vanished: tag and probability.
    """

    route: str
    seed: int
    found: bool
    moved: int
    told: int
    missed_m: list[float]
    standing: int
    false: list[tuple[int, str, float]]
    vanished: list[tuple[int, float]]


MOVED_SHARE, MOVED_M = 0.2, (0.1, 2.0)
"""Tags moved between two sessions of a map, and how far: as likely in each octave."""


def move_tags(recording: SpatialRecording, tags: IntArray, by_m: FloatArray) -> SpatialRecording:
    """Return the recording as if tags (T,) had stood elsewhere by (T, 3) in the frame of its truth."""
    seen, truth = recording.detections, recording.truth
    assert truth is not None
    mount = np.array([one.mount_robot_sensor for one in recording.sensors])
    camera = se3.compose(truth.pose_world_robot[seen.frame], mount[seen.sensor])
    by = np.zeros((len(seen), 3))
    for tag, one in zip(tags, by_m, strict=True):
        by[seen.landmark_id == tag] = one
    own = np.einsum("nji,nj->ni", se3.rotation_of(camera), by)
    return replace(recording, detections=replace(seen, position_sensor_m=seen.position_sensor_m + own))


def keep(route: str, first: SpatialRecording, second: SpatialRecording, living: Any, seed: int) -> Kept:
    """Enter the second session of a route into the map of the first, with tags moved between them; score it."""
    random = np.random.default_rng([seed, 7])
    counts = [np.unique(one.detections.landmark_id, return_counts=True) for one in (first, second)]
    tags = np.intersect1d(*(name[count >= FEWEST] for name, count in counts))
    some = random.choice(tags, round(MOVED_SHARE * len(tags)), replace=False)
    by = random.normal(size=(len(some), 3))
    by /= np.linalg.norm(by, axis=1, keepdims=True)
    by *= np.exp(random.uniform(*np.log(MOVED_M), (len(some), 1)))
    away = float(first.frames.stamp_s[-1] - second.frames.stamp_s[0]) + 86_400.0
    edited = replace(_later(move_tags(second, some, by), away), truth=None, true_landmarks=None)
    session = em.run_session(edited, living, em.Config(living={"accept": "any"}))
    told: dict[int, tuple[str, float]] = {}
    for change in session.changes:
        for one in change.landmark_ids:
            told[one] = max(told.get(one, ("", 0.0)), (change.kind.value, change.probability), key=lambda it: it[1])
    says = {one for one, (_, p) in told.items() if p > 0.5}
    standing = np.setdiff1d(tags, some)
    false = [(one, told[one][0], round(told[one][1], 3)) for one in standing.tolist() if one in says]
    missed = [round(float(np.linalg.norm(d)), 2) for one, d in zip(some.tolist(), by, strict=True) if one not in says]
    gone = [(one, p) for one, kind, p in false if kind == "vanished"]
    return Kept(route, seed, session.found, len(some), len(some) - len(missed), missed, len(standing), false, gone)


def _later(recording: SpatialRecording, by_s: float) -> SpatialRecording:
    return replace(recording, frames=replace(recording.frames, stamp_s=recording.frames.stamp_s + by_s))


def print_maps(folder: Path, draws: int, only: list[str]) -> None:
    """Print a line a map and draw of moves, and the sums."""
    every = {name: recording for name, recording, *_ in recordings(folder) if not only or name[:-3] in only}
    found = list[Kept]()
    for name, first in every.items():
        route, second = name[:-3], every.get(f"{name[:-3]}_s2")
        if not name.endswith("_s1") or second is None:
            continue
        living = em.run_session(replace(first, truth=None, true_landmarks=None)).living
        for seed in range(draws):
            found.append(keep(route, first, second, living, seed))
            print(found[-1], flush=True)
    aside = sum(not row.found for row in found)
    found = [row for row in found if row.found]
    moved, told, standing = (sum(getattr(row, one) for row in found) for one in ("moved", "told", "standing"))
    false, gone = sum(len(row.false) for row in found), sum(len(row.vanished) for row in found)
    print(
        f"told {told} of {moved} moved; {false} false of {standing} tag-sessions, "
        f"{gone} of them 'vanished'; {aside} set aside"
    )


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    parser.add_argument("--sweep", action="store_true", help="edited surveys")
    parser.add_argument("--held-out", action="store_true", help="sessions and seeds that nothing was designed on")
    parser.add_argument("--audit", action="store_true", help="by `evermap audit`")
    parser.add_argument("--only", nargs="*", default=[], help="sessions, or routes of maps")
    parser.add_argument("--maps", action="store_true", help="two sessions in one map, tags moved between them")
    parser.add_argument("--draws", type=int, default=3, help="of moved tags, a map")
    parser.add_argument("--kinds", nargs="*", default=[], help="of edits")
    chosen = parser.parse_args()
    if not any(chosen.folder.glob("*/apriltag_cal_individual.csv.gz")):
        raise SystemExit(f"no sessions of STAR-loc in {chosen.folder}: nothing is measured")
    if chosen.maps:
        print_maps(chosen.folder, chosen.draws, chosen.only)
        return
    if chosen.sweep:
        print_sweep(chosen.folder, held_out=chosen.held_out, audit=chosen.audit, only=chosen.only, kinds=chosen.kinds)
        return
    print(TABLE)
    print("|---|---|---:|---:|---:|---:|---:|---:|---:|")
    for row in run(chosen.folder):
        (ours, gtsams), (own, their) = row.pose_m, row.landmark_m
        print(
            f"| {row.session} | {row.known} | {row.located} of {row.frames} | {ours:.3f} | {gtsams:.3f} "
            f"| {row.ratio:.2f} | {own:.3f} | {their:.3f} | {row.cpu_s:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
