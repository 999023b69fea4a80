"""What is told of recordings into which one mistake was put, and that honest ones raise no alarm."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evermap import check_recording, run_session, run_slam
from evermap.errors import DataError, InputError
from evermap.io import list_robots, read_mrclam, read_recording, write_template
from evermap.slam import mistake_search
from evermap.slam.calibration import SPECS, far_off
from evermap.slam.pairs import USUAL
from evermap.types import UNKNOWN, Detections, Frames, Odometry, ParameterEstimate, Recording, VerdictKind, rows_of
from evermap_studies.sim import BuildingConfig, simulate_building


@cache
def patrol(seed: int = 1, patrol_s: float = 60.0) -> Recording:
    return simulate_building(BuildingConfig(days=1, patrol_s=patrol_s), seed=seed).sessions[0]


def readings(**change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recording], Recording]:
    def apply(recording: Recording) -> Recording:
        new = {name: mistake(getattr(recording.detections, name)) for name, mistake in change.items()}
        return replace(recording, detections=replace(recording.detections, **new))

    return apply


def odometry(**change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recording], Recording]:
    def apply(recording: Recording) -> Recording:
        new = {name: mistake(getattr(recording.odometry, name)) for name, mistake in change.items()}
        return replace(recording, odometry=replace(recording.odometry, **new))

    return apply


# what was done to the recording, and the code and the words of what is told
MISTAKES = {
    "ranges in mm": (readings(range_m=lambda r: 1e3 * r), "length-unit", "millimetres"),
    "ranges in cm": (readings(range_m=lambda r: 1e2 * r), "length-unit", "centimetres"),
    "ranges in feet": (readings(range_m=lambda r: r / 0.3048), "length-unit", "feet"),
    "bearings flipped": (readings(bearing_rad=lambda b: -b), "bearing-sign turn-sign", "wrong sign"),
    "bearings in degrees": (readings(bearing_rad=np.rad2deg), "bearing-unit", "degrees"),
    "bearings from the left": (readings(bearing_rad=lambda b: b - np.pi / 2), "bearing-axis", "another axis"),
    "speeds in km/h": (odometry(forward_mps=lambda v: 3.6 * v), "length-unit", "km/h"),
    "speeds in mm/s": (odometry(forward_mps=lambda v: 1e3 * v), "length-unit", "millimetres per second"),
    "speeds flipped": (odometry(forward_mps=lambda v: -v), "forward-sign", "in the opposite direction"),
    "turn rates in deg/s": (odometry(angular_radps=np.rad2deg), "turn-unit", "degrees"),
    "turn rates flipped": (odometry(angular_radps=lambda w: -w), "turn-sign bearing-sign", "wrong sign"),
    "zero odometry": (odometry(forward_mps=np.zeros_like, angular_radps=np.zeros_like), "no-odometry", "is zero"),
    "odometry 3 s late": (odometry(stamp_s=lambda t: t + 3.0), "clock", r"(2\.[6-9]|3\.[0-4]) s later"),
    "odometry 3 s early": (odometry(stamp_s=lambda t: t - 3.0), "clock", r"(2\.[6-9]|3\.[0-4]) s earlier"),
}
mistakes = pytest.mark.parametrize(("mistake", "codes", "words"), MISTAKES.values(), ids=MISTAKES)


def raw_check(recording: Recording) -> tuple[list[str], str]:
    """Codes and messages, without the refusal of degrees that the validation brings beforehand."""
    from evermap.slam.check import findings

    found = [each for each in findings(recording) if each.code != "left-out"]
    return [each.code for each in found if not each.code.startswith("beyond")], " | ".join(
        each.message for each in found
    )


@mistakes
@pytest.mark.parametrize(("seed", "patrol_s"), [(1, 60.0), (2, 60.0), (3, 20.0)])
def test_one_mistake_is_told_by_its_name(
    mistake: Callable[[Recording], Recording], codes: str, words: str, seed: int, patrol_s: float
) -> None:
    found, messages = raw_check(mistake(patrol(seed, patrol_s)))
    assert len(found) == 1
    assert found[0] in codes.split()
    assert re.search(words, messages), messages


@pytest.mark.parametrize("name", [None, *MISTAKES])
def test_what_a_share_of_the_pairs_rules_out_would_not_have_been_told(
    name: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = patrol() if name is None else MISTAKES[name][0](patrol())
    ruled_out = []

    def everything(pairs: Any, candidates: list[Any], *given: Any) -> list[Any]:
        ruled_out.append(len(candidates) - len(possible(pairs, candidates, *given)))
        return candidates

    fast, possible = raw_check(recording), mistake_search._possible
    monkeypatch.setattr(mistake_search, "_possible", everything)
    assert raw_check(recording) == fast
    assert name is not None or max(ruled_out) > 50


def test_two_mistakes_are_told_both() -> None:
    spoilt = MISTAKES["ranges in mm"][0](MISTAKES["odometry 3 s late"][0](patrol()))
    found, messages = raw_check(spoilt)
    assert sorted(found) == ["clock", "length-unit"]
    assert "millimetres" in messages


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
@pytest.mark.parametrize("patrol_s", [20.0, 60.0])
def test_honest_patrols_raise_no_alarm(seed: int, patrol_s: float) -> None:
    assert raw_check(patrol(seed, patrol_s))[0] == []


def test_the_template_is_honest(tmp_path: Path) -> None:
    check = check_recording(read_recording(write_template(tmp_path / "template")))
    assert check.usable
    assert check.findings == ()


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("dataset", [6, 1, 2, 3])
def test_honest_mrclam_raises_no_alarm_and_mistakes_are_told(shared_data: Path, dataset: int) -> None:
    path = shared_data / "mrclam" / f"MRCLAM_Dataset{dataset}.zip"
    robots = list_robots(path)
    recordings = [read_mrclam(path, robot) for robot in robots]
    for recording in recordings:
        assert check_recording(recording).findings == ()
    honest = recordings[0]
    for name, (mistake, codes, words) in MISTAKES.items():
        found, messages = raw_check(mistake(honest))
        assert len(found) == 1, (name, messages)
        assert found[0] in codes.split(), (name, messages)
        if name != "ranges in feet":  # its odometry over-reports by up to 8 %
            assert re.search(words, messages), (name, messages)


def test_a_robot_that_stands_still_is_no_zero_odometry() -> None:
    recording = patrol()
    frame = recording.detections.frame
    same = np.array(
        [np.flatnonzero(recording.detections.landmark_id == i)[0] for i in recording.detections.landmark_id]
    )
    standing = readings(range_m=lambda r: r[same] + 0.01 * np.sin(np.arange(len(r))), bearing_rad=lambda b: b[same])(
        MISTAKES["zero odometry"][0](recording)
    )
    assert len(frame) > 100
    assert raw_check(standing)[0] == []


@pytest.mark.parametrize("creeps_mps", [0.0, 0.01])
def test_a_parked_robot_accuses_nobody(creeps_mps: float) -> None:
    """What shrinks readings shrinks their noise: where the robot stands that is no evidence of degrees."""
    rng = np.random.default_rng(3)
    stamp_s = np.arange(0.0, 120.0, 0.1)
    count, frames = 8, 240
    bearing = rng.uniform(-2.5, 2.5, count)
    frame, which = np.divmod(np.arange(frames * count), count)
    unknown = np.full(len(frame), np.nan)
    parked = Recording(
        "parked",
        Odometry(
            stamp_s, creeps_mps * rng.normal(size=len(stamp_s)), 0.0 * stamp_s, 0.01 * rng.normal(size=len(stamp_s))
        ),
        Frames(np.arange(frames) * 0.5),
        Detections(
            frame, which, rng.uniform(2.0, 8.0, count)[which] + 0.05 * rng.normal(size=len(frame)),
            bearing[which] + 0.15 * rng.normal(size=len(frame)), np.full(len(frame), -1), unknown, unknown,
            np.zeros(len(frame), dtype=np.int64),
        ),
    )  # fmt: skip
    assert [finding.code for finding in check_recording(parked).findings if not finding.usable] == []


def test_an_identity_for_every_detection_is_refused_before_it_costs() -> None:
    own = readings(landmark_id=lambda ids: np.arange(len(ids)))(patrol())
    assert [finding.code for finding in check_recording(own).findings] == ["own-identities"]
    assert not check_recording(own).usable
    for run in (run_slam, run_session):
        with pytest.raises(DataError, match="must identify the landmark"):
            run(own)


def test_mixed_identities_are_told() -> None:
    shuffled = readings(landmark_id=lambda ids: np.random.default_rng(0).permutation(ids))(patrol())
    assert raw_check(shuffled)[0] == ["landmarks-move"]


def test_what_slam_refuses_or_leaves_out_is_told_before() -> None:
    """`check` and `slam` say the same of a recording of which nothing, or less than all, can be used."""
    recording = patrol()
    seen = recording.detections
    one = replace(recording, detections=rows_of(seen, seen.frame == seen.frame[0]))
    with pytest.raises(DataError, match="seen in 1 frames") as refused:
        run_slam(one)
    [finding] = [one for one in check_recording(one).findings if not one.usable]
    assert finding.code == "too-little"
    assert refused.value.one_line().endswith(finding.message)
    some = replace(seen, landmark_id=np.where(np.arange(len(seen)) % 3 == 0, UNKNOWN, seen.landmark_id))
    partly = check_recording(replace(recording, detections=some))
    assert partly.usable
    assert [one.code for one in partly.findings] == ["left-out"]
    nobody = replace(recording, detections=replace(seen, landmark_id=np.full(len(seen), UNKNOWN)))
    assert [one.code for one in check_recording(nobody).findings] == ["no-identities"]


def test_readings_beyond_the_limits_are_counted() -> None:
    recording = patrol()
    narrow = replace(recording, sensor=replace(recording.sensor, range_max_m=3.0, bearing_max_rad=0.5))
    check = check_recording(narrow)
    far = int(np.sum(recording.detections.range_m > 3.0))
    assert check.contents["detections"]["beyond_range_max"] == far
    assert {finding.code for finding in check.findings} == {"beyond-range", "beyond-view"}
    assert check.usable
    assert any("beyond range_max_m = 3" in remark for remark in run_slam(narrow).warnings)


def test_runs_tell_what_the_check_finds() -> None:
    spoilt = MISTAKES["ranges in feet"][0](patrol())
    assert any("feet" in remark for remark in run_slam(spoilt).warnings)
    session = run_session(MISTAKES["odometry 3 s late"][0](patrol()))
    assert any("s later than those" in remark for remark in session.slam.warnings)


def test_ranges_in_millimetres_are_no_outliers_to_a_session() -> None:
    with pytest.raises(DataError, match="ranges and range_max_m in metres"):
        run_session(MISTAKES["ranges in mm"][0](patrol()))


def test_a_calibration_state_far_outside_of_its_prior_is_told() -> None:
    def state(value: float, fixed: bool = False) -> ParameterEstimate:
        return ParameterEstimate("odometry_forward_scale", value, 0.01, 1.0, 0.05, "1", fixed=fixed)

    assert far_off([state(1.0 + 0.99 * USUAL.far_off * 0.05)], USUAL) == ()
    assert far_off([state(2.0, fixed=True)], USUAL) == ()
    (told,) = far_off([state(1.3)], USUAL)
    assert "odometry_forward_scale = 1.3 is 6 standard deviations" in told
    assert "wheel radius" in told
    slow = odometry(forward_mps=lambda v: 0.6 * v)(patrol())
    result = run_slam(slow)
    lengths = next(pair for pair in result.undecided if pair.one.name == "odometry_forward_scale")
    assert lengths.one.alone == pytest.approx(1 / 0.6, rel=0.035)  # what is usual of wheels holds it by 3 %
    assert lengths.other.alone == pytest.approx(0.6, rel=0.035)  # or ranges are: nothing says which
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SENSOR_SUSPECT
    assert "speeds or ranges in another unit, or a wrong wheel radius" in result.verdict.message


VALID = {
    "unsorted odometry": (odometry(stamp_s=lambda t: t[::-1]), "odometry.stamp_s.*row 1: time runs backwards"),
    "equal odometry stamps": (odometry(stamp_s=lambda t: np.repeat(t[::2], 2)[: len(t)]), "repeats the previous one"),
    "nan stamp": (odometry(stamp_s=lambda t: np.where(t == t[5], np.nan, t)), "odometry.stamp_s.*row 5: nan"),
    "milliseconds": (odometry(stamp_s=lambda t: 1e12 + t), "milli"),
    "nan speed": (odometry(forward_mps=lambda v: np.full_like(v, np.nan)), "odometry.forward_mps.*row 0: nan"),
    "fast turn": (odometry(angular_radps=lambda w: w + 1e4), "odometry.angular_radps"),
    "negative range": (readings(range_m=lambda r: -r), "detections.range_m.*row 0.*greater than zero"),
    "nan range": (readings(range_m=lambda r: np.full_like(r, np.nan)), "detections.range_m.*row 0: nan"),
    "infinite range": (readings(range_m=lambda r: np.full_like(r, np.inf)), "detections.range_m.*row 0: inf"),
    "degrees": (readings(bearing_rad=lambda b: b + 90), "detections.bearing_rad.*radians, not degrees"),
    "frames that do not exist": (readings(frame=lambda f: f + 10**6), "detections.frame.*is not a row of"),
    "negative frame": (readings(frame=lambda f: f - 5), "detections.frame.*is not a row of"),
    "unsorted detections": (readings(frame=lambda f: f[::-1]), "detections.frame.*comes after a later"),
    "identity": (readings(landmark_id=lambda i: i - 10**6), "detections.landmark_id.*is not an identity"),
    "class": (readings(class_id=lambda i: i - 10**6), "detections.class_id.*is not an identity"),
    "sigma": (readings(sigma_range_m=np.zeros_like), "detections.sigma_range_m.*greater than zero"),
    "frames backwards": (
        lambda rec: replace(rec, frames=replace(rec.frames, stamp_s=rec.frames.stamp_s[::-1])),
        "frames.stamp_s.*row 1: time runs backwards",
    ),
    "limits": (lambda rec: replace(rec, sensor=replace(rec.sensor, range_max_m=0.0)), "sensor.range_min_m"),
    "nan limit": (lambda rec: replace(rec, sensor=replace(rec.sensor, range_max_m=np.nan)), "sensor.range_min_m"),
    "probability": (lambda rec: replace(rec, sensor=replace(rec.sensor, p_detect=1.5)), "sensor.p_detect"),
    "mount": (
        lambda rec: replace(rec, sensor=replace(rec.sensor, mount_robot_sensor=(0.0, np.nan, 0.0))),
        "is not a pose",
    ),
    "truth": (
        lambda rec: replace(rec, truth=replace(rec.truth, pose_world_robot=np.nan * rec.truth.pose_world_robot)),
        "truth.pose_world_robot",
    ),
    "survey": (
        lambda rec: replace(
            rec, true_landmarks=replace(rec.true_landmarks, landmark_id=0 * rec.true_landmarks.landmark_id)
        ),
        "true_landmarks.landmark_id.*is listed twice",
    ),
}


@pytest.mark.parametrize(("spoil", "words"), VALID.values(), ids=VALID)
def test_python_is_refused_what_files_are(spoil: Callable[[Recording], Recording], words: str) -> None:
    with pytest.raises(InputError, match=words):
        run_slam(spoil(patrol()))
    with pytest.raises(InputError, match=words):
        check_recording(spoil(patrol()))


@pytest.mark.parametrize("run", [run_slam, run_session, check_recording])
def test_a_path_is_no_recording(run: Callable[[object], object]) -> None:
    with pytest.raises(InputError, match=r"a Recording is needed, not str \(try: evermap.read_recording\('folder'\)\)"):
        run("folder")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (odometry(forward_mps=lambda v: v[:-1]), "Odometry of shape"),
        (readings(range_m=lambda r: r[:5]), "Detections of shape"),
        (readings(range_m=lambda r: np.stack([r, r])), "Detections of shape"),
        (readings(landmark_id=lambda i: i + 0.5), "fractions where whole numbers"),
        (readings(range_m=lambda r: np.full(len(r), "far")), "holds no numbers"),
        (readings(range_m=lambda _: None), "is not an array of numbers"),
    ],
)
def test_columns_that_do_not_fit_are_refused_where_they_are_made(
    spoil: Callable[[Recording], Recording], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        spoil(patrol())


def test_lists_become_arrays() -> None:
    recording = patrol()
    same = readings(range_m=lambda r: r.tolist(), landmark_id=lambda i: i.astype(float).tolist())(recording)
    np.testing.assert_array_equal(same.detections.range_m, recording.detections.range_m)
    assert same.detections.landmark_id.dtype == np.int64


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.name)
def test_every_state_that_is_far_off_has_a_cause(spec) -> None:
    found = ParameterEstimate(spec.name, spec.mean + 1.0, 0.001, spec.mean, 0.01, spec.unit)
    (told,) = far_off([found], USUAL)
    assert told.startswith(f"{spec.name} = ")
    assert told.partition("prior of sensors: ")[2]
