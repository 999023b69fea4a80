"""Parts on recordings of the shared folder. Truth is used for scores only; identities and maps are given where said."""

from __future__ import annotations

import functools
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import evermap as em
from benchmarks.goldens.scores import (
    MissingDataError,
    Named,
    changes,
    counted,
    levels,
    longest_frame_ms,
    mean_of,
    measured,
    moved,
    scores,
)
from evermap.errors import EvermapError
from evermap.types import AnyRecording, Landmarks, SpatialRecording

Part = Callable[[Path], Iterator[Named]]
RATE_HZ = 20.0
"""Of the references in space."""
LEARNED = (
    "range_curvature_per_rad2", "odometry_delay_s", "odometry_forward_scale", "odometry_turn_scale", "sigma_range_m",
    "sigma_bearing_rad",
)  # fmt: skip
MRCLAM = "MRCLAM_Dataset{}.zip"
SHIFT = "11,12,13:+1.0,-0.5"
"""Three landmarks of a survey that are moved together."""
SIGMA_SURVEY_M = 0.02
YCBV = ("0001", "0029", "0054")
STARLOC = ("loop-2d_s1", "loop-2d-fast_s2", "eight_s2")
MIDMOVE = (12, (0.8, 0.6, 0.0))
"""The tag that moves during a case, and by how much."""
KITTI = ("0000", "0004", "0005")
KITTI_SLAM = "0005"


def present(path: Path) -> Path:
    """Return a path that is there.

    Raises:
        MissingDataError: it is not.
    """
    if not path.exists():
        raise MissingDataError(f"{path} is not here")
    return path


def as_map(survey: Landmarks | None, sigma_m: float = SIGMA_SURVEY_M) -> Landmarks:
    """Return surveyed landmarks as a map to localise in."""
    assert survey is not None
    if survey.position_m.shape[1] == 3:
        return survey.as_prior(sigma_m)
    return Landmarks.at(survey.landmark_id, survey.position_m, sigma_m=sigma_m, frame="prior_map")


def mrclam(data: Path, dataset: int, robot: int) -> Any:
    """Read a robot."""
    return em.read_recording(present(data / "mrclam" / MRCLAM.format(dataset)), robot=robot)


def mrclam6(data: Path) -> Iterator[Named]:
    """Five robots from an unknown map: means, each robot's errors, what the first one learned."""
    rows = []
    for robot in range(1, 6):
        recording = mrclam(data, 6, robot)
        result = em.run_slam(recording)
        rows.append(list(scores(recording, result)))
        for name, value in rows[-1]:
            if name in ("position_m", "landmarks_m"):
                yield f"robot{robot}/{name}", value
        if robot == 1:
            yield from levels(result, LEARNED)
    yield from mean_of(rows)


def mrclam6_together(data: Path) -> Iterator[Named]:
    """The same robots as one problem."""
    recordings = {robot: mrclam(data, 6, robot) for robot in range(1, 4)}
    found = em.run_together(recordings)
    yield from mean_of([list(scores(recordings[robot], result)) for robot, result in found.items()])


def mrclam3_shifted(data: Path) -> Iterator[Named]:
    """A robot against a survey of which a group was moved: what is reported, and the landmarks' errors."""
    from evermap.io.shifts import parse_shift, shifted

    shift = parse_shift(SHIFT)
    for robot in (1, 2):
        recording = mrclam(data, 3, robot)
        prior = shifted(as_map(recording.true_landmarks), [shift])
        result = em.run_slam(recording, prior_map=prior)
        true = [shift.undone(float(recording.frames.stamp_s[0]))]
        yield from ((f"robot{robot}/{name}", value) for name, value in scores(recording, result, prior=prior))
        yield from ((f"robot{robot}/{name}", value) for name, value in changes(result.changes, true))


def mrclam6_nameless(data: Path) -> Iterator[Named]:
    """A robot whose detections have no identities."""
    yield from _nameless(mrclam(data, 6, 1))


def dlr(data: Path) -> Iterator[Named]:
    """576 landmarks in the plane, with their identities: noise that is learned, and cost beside gtsam's."""
    from benchmarks import scale
    from evermap_studies.peers import factors as plain
    from evermap_studies.peers.plain_gtsam import levenberg_marquardt

    recording = scale.dlr_recording(present(data / "dlr"))
    with measured() as spent:
        result = em.run_slam(recording)
    yield from scores(recording, result)
    yield from levels(result, ("sigma_range_m", "sigma_bearing_rad"))
    yield "cpu_s", spent.cpu_s
    yield "longest/frame_ms", longest_frame_ms(recording)
    factors = plain.factors_of(recording, scale.learned_noise(result))
    peer = levenberg_marquardt(factors, plain.dead_reckoned_start(factors), marginals=False)
    # of one iteration: how many it takes from there, 20 or 100, is decided by the last digit of the noise
    yield "lm/over_iteration", spent.cpu_s * peer.n_iterations / peer.solve.cpu_s


def dlr_nameless(data: Path) -> Iterator[Named]:
    """The same without identities; the position error is that against the run with them."""
    from benchmarks import scale

    yield from _nameless(scale.dlr_recording(present(data / "dlr")))


def _nameless(recording: AnyRecording) -> Iterator[Named]:
    from benchmarks.association import score

    found = score(recording)
    yield "precision/association", found.precision
    yield "recall/association", found.recall
    yield "position_m", found.without_m
    yield "extra/false", abs(found.found - found.true)
    yield "cpu_s", found.all_s


def tags(name: str, *, mapped: bool, data: Path) -> Iterator[Named]:
    """Tags of one day of a building, from an unknown map, or from the survey of that day."""
    from benchmarks import space

    recording = em.read_recording(present(data / "tagslam" / name))
    survey = recording.true_landmarks
    prior = as_map(survey) if mapped else None
    with measured() as spent:
        result = em.run_slam(recording, prior_map=prior)
    yield from scores(recording, result, prior=prior, rate_hz=RATE_HZ)
    if survey is not None:
        yield "survey/landmarks_m", space._to_survey(result.landmarks, survey)
    if mapped:
        yield "reported/level", len(result.changes)
    yield "cpu_s", spent.cpu_s


def objects(data: Path) -> Iterator[Named]:
    """Objects before a hand-held camera: means over sequences, and each camera's error."""
    from benchmarks import space

    rows = []
    for name in YCBV:
        recording = em.read_recording(present(data / "ycbv" / name))
        assert isinstance(recording, SpatialRecording)
        result = em.run_slam(recording)
        # landmarks in the camera: two objects alone allow no alignment
        row = [one for one in scores(recording, result, rate_hz=RATE_HZ) if one[0] != "landmarks_m"]
        row.append(("landmarks_m", space._object_errors(recording, result)[0]))
        rows.append(row)
        yield f"{name}/position_m", dict(row)["position_m"]
    yield from mean_of(rows)


def starloc(session: str, *, data: Path) -> Iterator[Named]:
    """Points before a stereo camera without odometry: from an unknown map, and with the survey."""
    folder = present(data / "starloc")
    with tempfile.TemporaryDirectory() as temporary:
        script = folder / "starloc_to_plain.py"
        command = [sys.executable, script, folder, session, temporary, "--truth"]
        subprocess.run(list(map(str, command)), check=True)
        recording = em.read_recording(temporary)
    for name, prior in (("unknown", None), ("survey", as_map(recording.true_landmarks))):
        try:
            with measured() as spent:
                result = em.run_slam(recording, prior_map=prior)
        except EvermapError as error:
            print(f"  starloc {session}, {name}: {error}", flush=True)
            yield f"{name}/position_m", None
            continue
        found = scores(recording, result, prior=prior, rate_hz=RATE_HZ)
        wanted = ("position_m", "landmarks_m") if prior is None else None  # a lost run's turns and NEES say nothing
        yield from ((f"{name}/{of}", value) for of, value in found if wanted is None or of in wanted)
        yield f"{name}/cpu_s", spent.cpu_s


def kitti_tracks(data: Path) -> Iterator[Named]:
    """Boxes of traffic followed, and the drive among it with an odometry that drifts."""
    from benchmarks import kitti, kitti_slam

    folder = present(data / "kitti_tracking")
    places = [folder / name for name in KITTI]
    drives = [kitti.drive(place) for place in places]
    kitti.warm_up()
    answers = [kitti.by_evermap(place, one) for place, one in zip(places, drives, strict=True)]
    found = kitti.score(drives, [one.get("Car", kitti.NOTHING) for one, _ in answers], "Car")
    for key in ("MOTA", "IDF1", "HOTA"):
        yield f"{key}/tracking", found["at_once"][key]
    yield "sAMOTA/tracking", found["swept"]["sAMOTA"]
    yield "switches/false", found["at_once"]["IDS"]
    yield "cpu_s", sum(spent for _, spent in answers)
    recording = em.read_recording(folder / KITTI_SLAM)
    worse = replace(recording, odometry=kitti_slam.worse(recording.odometry))
    for name, one in (("as_is", recording), ("drifting", worse)):
        path = em.run_slam(one).trajectory
        yield f"{name}/position_m", kitti_slam.off_m(recording, path.stamp_s, path.pose_world_robot)


def room(data: Path) -> Iterator[Named]:
    """Eight features that come and go, by the default model, as the authors of the recording score it."""
    from evermap.existence.protocol import Instants
    from evermap_studies.presence import models
    from evermap_studies.presence.scores import kept, mean_scores, room_scores
    from evermap_studies.presence.tasks import read_room

    rows, leaving = [], []
    with measured() as spent:
        for one in read_room(present(data / "presence")):
            learned = models.ROOM_DEFAULT.learn(one.train)
            believe = models.ROOM_DEFAULT.believe(learned, None)
            belief = kept(believe(one.test, Instants.same_for_all(1, one.stamp_s)))
            rows.append(room_scores(belief, one.present, one.stamp_s))
            leaving += [rows[-1]] if not one.present.all() else []
    for name, some in (("all", rows), ("leaving", leaving)):
        mean = mean_scores(some)
        for key in ("mae", "brier", "log_loss"):
            yield f"{name}/{key}/score", mean[key]
    yield "cpu_s", spent.cpu_s


def door(data: Path) -> Iterator[Named]:
    """A door over weeks, foretold without a look and with one every half an hour, by the default model."""
    from evermap_studies.presence import models
    from evermap_studies.presence.scores import beliefs, door_scores
    from evermap_studies.presence.tasks import TASKS, read_door

    found = read_door(present(data / "presence"))
    with measured() as spent:
        learned = models.DOOR_DEFAULT.learn(found.train.certain_looks())
        believe = models.DOOR_DEFAULT.believe(learned, None)
        for task in TASKS[:2]:
            trials = found.trials(task, 0)
            score = door_scores([beliefs(believe, week) for week in trials], trials)
            yield f"{task.name}/brier/score", score["brier"]
            yield f"{task.name}/log_loss/score", score["log_loss"]
    yield "cpu_s", spent.cpu_s


@functools.cache
def _unpacked(path: Path) -> tempfile.TemporaryDirectory[str]:
    """An archive, unpacked until the process ends."""
    folder = tempfile.TemporaryDirectory()
    with tarfile.open(path) as archive:
        archive.extractall(folder.name, filter="data")
    return folder


def case(name: str, *, data: Path) -> AnyRecording:
    """Read one of the made worlds that go wrong."""
    folder = Path(_unpacked(present(data / "cases" / f"{name}.tar.gz")).name)
    return em.read_recording(next(path.parent for path in folder.rglob("sensor.toml")))


def field_case(name: str, move: tuple[int, tuple[float, float, float]] | None = None, *, data: Path) -> Iterator[Named]:
    """Tags of a competition field, with its layout as exact map."""
    recording = case(name, data=data)
    layout = as_map(recording.true_landmarks, 0.0)
    result = em.run_slam(recording, prior_map=layout)
    yield from scores(recording, result, prior=layout)
    yield from changes(result.changes, [] if move is None else [moved(*move)])


def orchard(data: Path) -> Iterator[Named]:
    """Sixty trees in rows without identities."""
    recording = case("f_or1", data=data)
    result = em.run_slam(recording, em.Config(slam={"unknown_ids": True}))
    yield from ((name, value) for name, value in scores(recording, result) if not name.startswith("landmarks"))
    survey = recording.true_landmarks
    assert survey is not None
    yield "extra/false", abs(len(result.landmarks) - len(survey))


def anchors_left_behind(data: Path) -> Iterator[Named]:
    """A drive that leaves its anchors behind, in their map: nothing moved."""
    recording = case("f_uwb_moved_far", data=data)
    anchors = as_map(recording.true_landmarks)
    result = em.run_slam(recording, prior_map=anchors)
    yield from scores(recording, result, prior=anchors)
    yield from changes(result.changes, [])


def bags(data: Path) -> Iterator[Named]:
    """Bags that people have, and bags of one drive in several types of messages: how many are solved, innovations."""
    folder = Path(_unpacked(present(data / "cases" / "bags.tar.gz")).name)
    every = sorted(path.parent for path in folder.rglob("metadata.yaml"))
    for name, some in (
        ("one_drive", every),
        ("fiducials", sorted(present(data / "field" / "fiducials").glob("*.bag"))),
    ):
        solved, ratios = 0, []
        for path in some:
            try:
                recording = em.read_recording(path)
                ratios.append(dict(scores(recording, em.run_slam(recording))).get("nis"))
                solved += 1
            except EvermapError as error:
                print(f"  {path.name}: {error.one_line()}", flush=True)
        yield from ((f"{name}/{of}", value) for of, value in counted(solved, len(some), solved) if of != "false")
        known = [ratio for ratio in ratios if ratio is not None]
        yield f"{name}/nis", float(np.exp(np.mean(np.log(known)))) if known else None


def of(part: Callable[..., Iterator[Named]], *given: Any, **named: Any) -> Part:
    """Return a part with its arguments, but the folder of the data."""

    def run(data: Path) -> Iterator[Named]:
        return part(*given, **named, data=data)

    return run


def parts() -> dict[str, Part]:
    """Return all parts by name."""
    found: dict[str, Part] = {
        "mrclam6": mrclam6,
        "mrclam6_together": mrclam6_together,
        "mrclam3_shifted": mrclam3_shifted,
        "mrclam6_nameless": mrclam6_nameless,
        "dlr": dlr,
        "dlr_nameless": dlr_nameless,
        "tags_9": of(tags, "test_9", mapped=True),
        "tags_10": of(tags, "test_10", mapped=True),
        "tags_11": of(tags, "test_11", mapped=False),
        "tags_11_mapped": of(tags, "test_11", mapped=True),
        "tags_13": of(tags, "test_13", mapped=False),
        "objects": objects,
    }
    found |= {f"starloc_{name}": of(starloc, name) for name in STARLOC}
    return found | {
        "kitti": kitti_tracks,
        "room": room,
        "door": door,
        "c_po": of(field_case, "c_po"),
        "c_latency": of(field_case, "c_latency"),
        "c_midmove": of(field_case, "c_midmove", MIDMOVE),
        "orchard": orchard,
        "anchors_left_behind": anchors_left_behind,
        "bags": bags,
    }


__all__: Sequence[str] = ("parts",)
