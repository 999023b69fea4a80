"""Verdicts by signs, and of runs in made worlds: as they are, and with a mistake or a wrong map."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evermap import run_slam
from evermap.config import SlamConfig
from evermap.explain import verdict
from evermap.explain.causes.suspect import Suspect
from evermap.explain.scores import CalibrationScore, SessionScores
from evermap.explain.symptoms import Signs, measure_signs
from evermap.explain.verdict import LIMITS, SURE, Limit, judge_signs
from evermap.types import (
    AssociationEvidence,
    Cause,
    ChangeKind,
    Landmarks,
    MapChange,
    ParameterEstimate,
    Recording,
    SlamResult,
    VerdictKind,
)
from evermap.viz.verdict_words import cause_text, further_causes
from evermap_studies.worlds.lasers import LaserWorld, simulate_laser

GOOD = Signs(n_landmarks=12, n_used=500, nis=2.0, used=0.98, sigma_m=0.02, size_m=10.0)

SESSION: Any = object()


@cache
def recorded() -> tuple[Recording, Landmarks]:
    recording = simulate_laser(LaserWorld(duration_s=45.0, n_landmarks=12), seed=5)
    survey = recording.true_landmarks
    assert survey is not None
    return recording, Landmarks.at(survey.landmark_id, survey.position_m, sigma_m=0.02, frame="prior_map")


@cache
def solve_recorded(*, in_map: bool = False) -> SlamResult:
    """The run of that recording, which tests change by copies."""
    recording, survey = recorded()
    return run_slam(recording, prior_map=survey if in_map else None)


@pytest.mark.parametrize("limit", LIMITS, ids=lambda limit: limit.code)
def test_a_sign_beyond_its_limit_decides(limit: Limit) -> None:
    edge, way = (limit.most, 1.0) if limit.most < inf else (limit.least, -1.0)
    signs = replace(GOOD, common=12)
    for value, kind in ((edge, VerdictKind.SOUND), (edge + way * max(0.01 * abs(edge), 1e-6), limit.kind)):
        changed = {"sigma_m": value * GOOD.size_m} if limit.sign == "sigma_share" else {limit.sign: value}
        assert judge_signs(replace(signs, **changed)).kind is kind


def test_errors_smaller_than_stated_are_no_failure() -> None:
    assert judge_signs(replace(GOOD, nis=1e-9)).kind is VerdictKind.SOUND


def test_a_cause_is_told_with_its_remedy_where_it_is_sure() -> None:
    size = Cause("tag-size", "all tags", "tags are 10 % larger", probability=0.99, fix="tag_size_m = 0.176")
    found = judge_signs(GOOD, causes=[size])
    assert (found.kind, found.message) == (
        VerdictKind.SENSOR_SUSPECT, "tags are 10 % larger (try: tag_size_m = 0.176)"
    )  # fmt: skip
    of_map = replace(size, code="map-scale", subject="map")
    assert judge_signs(GOOD, causes=[of_map]).kind is VerdictKind.MAP_OUTDATED


def test_a_cause_that_another_may_hold_instead_of_is_weak_and_names_both() -> None:
    size = Cause("tag-size", "all tags", "tags are 10 % larger", 1.1, 0.01, 0.7, instead="the wheels are smaller")
    found = judge_signs(GOOD, causes=[size])
    assert found.kind is VerdictKind.WEAK
    assert "tags are 10 % larger (70%), or the wheels are smaller" in found.message
    assert "(70%), or nothing is off" in judge_signs(GOOD, causes=[replace(size, instead="")]).message
    other = replace(size, subject="1", probability=0.99)
    assert judge_signs(GOOD, causes=[other, size]).kind is VerdictKind.SENSOR_SUSPECT
    assert judge_signs(replace(GOOD, nis=20.0), causes=[size]).kind is VerdictKind.LOST
    assert judge_signs(replace(GOOD, common=9, moved=0.9), causes=[size]).kind is VerdictKind.MAP_OUTDATED
    assert judge_signs(GOOD, causes=[replace(size, probability=SURE)]).kind is VerdictKind.SENSOR_SUSPECT


def test_a_scale_that_another_cause_may_be_is_no_suspicion() -> None:
    """What is said of it is which of the two it may be, and what decides."""
    recording, survey = recorded()
    result = solve_recorded(in_map=True)
    slope = next(one for one in result.parameters if one.name == "range_slope")
    far = replace(slope, value=0.03, fixed=False, prior_mean=0.0, prior_sigma=0.0002)
    others = tuple(one for one in result.parameters if one.name != "range_slope")
    cause = Cause("range-scale", "sensor", "ranges are short", 1.03, 0.001, 0.6, instead="the map is long")

    def kind_of(one: Cause) -> VerdictKind:
        changed = replace(result, parameters=(*others, far), causes=(one,))
        return verdict.judge(changed, recording, SlamConfig(), survey).kind

    assert kind_of(cause) is VerdictKind.WEAK
    assert kind_of(replace(cause, probability=SURE)) is VerdictKind.SENSOR_SUSPECT
    assert kind_of(replace(cause, instead="")) is VerdictKind.SENSOR_SUSPECT
    assert kind_of(replace(cause, code="clock")) is VerdictKind.SENSOR_SUSPECT


def test_one_of_two_mistakes_makes_a_run_unusable_whichever_it_is() -> None:
    mistake = Cause("turn-sign", "angular_radps", "turns have the wrong sign", probability=0.5, instead="map mirrored")
    for cause, kind in (
        (mistake, VerdictKind.SENSOR_SUSPECT),
        (replace(mistake, code="map-mirrored", subject="map"), VerdictKind.MAP_OUTDATED),
        (replace(mistake, instead=""), VerdictKind.WEAK),  # or nothing is off
        (replace(mistake, value=1.1, sigma=0.01), VerdictKind.WEAK),
    ):
        found = judge_signs(GOOD, causes=[cause])
        assert found.kind is kind
        assert "of two explanations nothing says which holds" in found.message


def test_of_ranges_alone_the_side_of_the_sensor_shows_the_sign_of_turns() -> None:
    recording, survey = recorded()
    result = solve_recorded()
    assert np.isnan(measure_signs(result, recording).hand)  # bearings show it
    seen = replace(recording.detections, bearing_rad=np.full(len(recording.detections), np.nan))
    # one drive in a thousand has the wrong sign beforehand, and with -2.3 nats one in a hundred
    sides = (
        (0.05, 0.0, 5.556),
        (-0.05, 0.02, 3.333),
        (0.0, 0.02, 0.0),
        (0.05, -0.0692, -2.133),
        (0.05, -0.0712, -2.356),
    )
    for stated_m, off_m, expected in sides:
        sensor = replace(recording.sensor, mount_robot_sensor=(0.3, stated_m, 0.0))
        parameters = tuple(
            replace(one, value=off_m, prior_sigma=0.03) if one.name == "mount_left_m" else one
            for one in result.parameters
        )
        sided, radio = replace(result, parameters=parameters), replace(recording, detections=seen, sensor=sensor)
        assert measure_signs(sided, radio).hand == pytest.approx(expected, abs=0.001)
        assert ("mirrored" in alarms(sided, radio)) is (expected < -2.3)
        placed = replace(sided, landmarks=replace(sided.landmarks, frame="prior_map"))
        assert np.isnan(measure_signs(placed, radio, survey).hand)
        free = tuple(replace(one, prior_sigma=0.0) if one.name == "mount_left_m" else one for one in parameters)
        assert np.isnan(measure_signs(replace(sided, parameters=free), radio).hand)


def test_a_delay_that_the_estimator_put_right_is_no_suspicion() -> None:
    late = Cause("clock", "front", "stamps of front are 0.12 s late", 0.12, 0.002, 0.99, "stamp_s - 0.12")
    found = judge_signs(GOOD, causes=[late])
    assert (found.kind, found.causes) == (VerdictKind.SOUND, (late,))
    assert judge_signs(GOOD, causes=[replace(late, probability=0.7)]).kind is VerdictKind.SOUND
    assert judge_signs(GOOD, causes=[replace(late, nats=40.0)]).kind is VerdictKind.SENSOR_SUSPECT


def test_every_cause_is_told_once() -> None:
    late = Cause("clock", "front", "stamps of front are 0.12 s late", 0.12, 0.002, 0.99, "stamp_s - 0.12")
    size = Cause("tag-size", "all tags", "tags are 10 % larger", probability=0.99, fix="tag_size_m = 0.176")
    verdict = judge_signs(GOOD, causes=[late, size])
    lines = [verdict.text, *map(cause_text, further_causes(verdict))]
    for cause in (late, size):
        assert sum(cause.message in line and cause.fix in line for line in lines) == 1


def test_a_solution_that_is_no_number_is_lost() -> None:
    recording, _ = recorded()
    result = solve_recorded()
    pose = result.trajectory.pose_world_robot.copy()
    pose[3] = np.nan
    signs = measure_signs(replace(result, trajectory=replace(result.trajectory, pose_world_robot=pose)), recording)
    assert signs.n_unknown == 1
    assert judge_signs(signs).kind is VerdictKind.LOST


def test_an_association_that_is_worse_than_odometry_alone_is_lost() -> None:
    recording, _ = recorded()
    result = solve_recorded()
    for evidence, kind in (
        (AssociationEvidence(0.1, 12, 30, 18, 20.0, 200.0), VerdictKind.SOUND),
        (AssociationEvidence(0.5, 12, 30, 18, 20.0, 200.0), VerdictKind.LOST),
        (AssociationEvidence(0.1, 12, 30, 18, 80.0, 200.0), VerdictKind.LOST),
        (AssociationEvidence(0.1, 12, 30, 18, 20.0, -20.0), VerdictKind.LOST),
    ):
        assert judge_signs(measure_signs(replace(result, association=evidence), recording)).kind is kind


def test_runs_end_with_a_verdict() -> None:
    recording, survey = recorded()
    for in_map in (False, True):
        verdict = solve_recorded(in_map=in_map).verdict
        assert verdict is not None
        assert verdict.kind is VerdictKind.SOUND, verdict.message
    seen = recording.detections
    long = replace(recording, detections=replace(seen, range_m=1e3 * seen.range_m))
    verdict = run_slam(long).verdict
    assert verdict is not None
    assert (verdict.kind, "millimetres" in verdict.message) == (VerdictKind.SENSOR_SUSPECT, True)
    others = (
        replace(survey, landmark_id=survey.landmark_id + 1000),
        replace(survey, position_m=survey.position_m * np.array([1.0, -1.0])),
    )
    for other in others:
        verdict = run_slam(recording, prior_map=other).verdict
        assert verdict is not None
        assert verdict.kind is VerdictKind.MAP_OUTDATED, verdict.message


def alarms(result: SlamResult, recording: Recording, given: Landmarks | None = None) -> set[str]:
    """Return the codes of the signs of a run that are beyond their limits."""
    return {one.code for one in judge_signs(measure_signs(result, recording, given)).symptoms if one.is_alarming}


def test_lengths_that_differ_are_weak_until_a_map_says_which_are_right() -> None:
    recording, survey = recorded()
    driven = recording.odometry
    long = replace(recording, odometry=replace(driven, forward_mps=1.08 * driven.forward_mps))
    verdict = run_slam(long).verdict
    assert verdict is not None
    assert verdict.kind is VerdictKind.WEAK
    assert "differ by 7." in verdict.message
    assert "sigma_odometer_scale" in verdict.message
    in_map = run_slam(long, prior_map=survey)
    assert "scale" not in alarms(in_map, long, survey)


def test_a_scale_far_from_what_is_stated_is_weak_until_a_map_says_which_is_right() -> None:
    recording, survey = recorded()
    scale = ParameterEstimate("odometry_scale", 0.984, 0.002, 1.0, 0.005, "")
    for given, expected in ((None, True), (survey, False)):
        result = solve_recorded(in_map=given is not None)
        other = replace(result, parameters=(*result.parameters, scale))
        assert ("stated-scale" in alarms(other, recording, given)) is expected
        assert "stated-scale" not in alarms(result, recording, given)


def test_a_delay_is_weak_where_it_may_be_the_sensors() -> None:
    recording, survey = recorded()
    result = solve_recorded(in_map=True)
    late = (0.3, 0.001, True), (0.145, 0.01, True), (0.135, 0.01, False), (0.2, 0.15, False)
    # nothing is stamped before it happened; but of a delay that nobody knows nothing follows
    early = (-0.3, 0.001, True), (-0.12, 0.001, True), (-0.04, 0.001, False), (-0.06, 0.02, False)
    for delay_s, sigma_s, expected in (*late, *early):
        parameters = tuple(
            replace(one, value=delay_s, sigma=sigma_s) if one.name == "odometry_delay_s" else one
            for one in result.parameters
        )
        delayed = replace(result, parameters=parameters)
        assert ("clocks" in alarms(delayed, recording, survey)) is expected
        fixed = tuple(replace(one, fixed=True) for one in parameters)  # stated by who knows it
        assert "clocks" not in alarms(replace(delayed, parameters=fixed), recording, survey)


def test_a_solution_that_scatters_detections_more_than_odometry_does_is_lost() -> None:
    recording, _ = recorded()
    result = solve_recorded()
    assert measure_signs(result, recording).over_odometry < 1.0
    pose = result.trajectory.pose_world_robot.copy()
    pose[:, 0] *= 0.5  # halves every way along x
    bent = replace(result, trajectory=replace(result.trajectory, pose_world_robot=pose))
    assert measure_signs(bent, recording).over_odometry > 1.2
    assert "over-odometry" in alarms(bent, recording)


def test_a_landmark_unexplained_for_long_is_weak_unless_its_change_is_reported() -> None:
    recording, _ = recorded()
    result = solve_recorded()
    innovations = result.innovations
    mine = np.flatnonzero(innovations.landmark_id == innovations.landmark_id[0])
    order = mine[np.argsort(innovations.stamp_s[mine])]
    for unused, expected in ((order[len(order) // 2 :], True), (order[::4], False), (order[:2], False)):
        p_inlier = innovations.p_inlier.copy()
        p_inlier[unused] = 0.0
        other = replace(result, innovations=replace(innovations, p_inlier=p_inlier))
        assert ("unexplained" in alarms(other, recording)) is expected
        identity = int(innovations.landmark_id[0])
        change = MapChange((identity,), ChangeKind.MOVED, 0.0, 60.0, (1.0, 0.0), 0.0, 0.99)
        assert "unexplained" not in alarms(replace(other, changes=(change,)), recording)


def test_noise_far_beyond_what_is_usual_is_weak() -> None:
    recording, _ = recorded()
    result = solve_recorded()
    assert not alarms(result, recording)
    for name, code, most in (
        ("sigma_bearing_rad", "noise-of-detections", 4.0),
        ("sigma_turn_per_sqrt_s", "noise-of-odometry", 2.5),
    ):
        for ratio, expected in ((0.95 * most, False), (1.05 * most, True)):
            levels = tuple(
                replace(one, value=ratio * one.prior_mean) if one.name == name else one for one in result.parameters
            )
            assert (code in alarms(replace(result, parameters=levels), recording)) is expected


@pytest.mark.parametrize(
    ("signs", "kind"),
    [
        (GOOD, VerdictKind.SENSOR_SUSPECT),
        (replace(GOOD, away_scale=4.0), VerdictKind.SENSOR_SUSPECT),  # weak, for lengths that contradict each other
        (replace(GOOD, nis=9.0), VerdictKind.LOST),  # scores at what is no solution say nothing
    ],
)
def test_a_run_that_is_weak_is_asked_what_it_held(
    signs: Signs, kind: VerdictKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A focal length that is another makes lengths by odometry and by detections differ."""
    recording, survey = recorded()
    asked = list[object]()
    focal = Suspect("focal-length", "front", 1e-3, lambda inputs, _: inputs, lambda _: "another focal length", str, 0.1)
    scores = SessionScores((CalibrationScore(focal, -0.05, 0.001, 300.0, 4.5),))
    monkeypatch.setattr(verdict, "measure_signs", lambda *_: signs)
    monkeypatch.setattr(verdict, "score_session", lambda session, *_: (asked.append(session), scores)[1])
    result: Any = SimpleNamespace(parameters=(), causes=(), trajectory=None)
    found = verdict.judge(result, recording, SlamConfig(), survey, asked=SESSION)
    assert found.kind is kind
    assert asked == ([] if kind is VerdictKind.LOST else [SESSION])
    if kind is VerdictKind.SENSOR_SUSPECT:
        assert "another focal length" in found.message
    without = verdict.judge(result, recording, SlamConfig(), survey)  # nothing to ask
    assert without.kind is judge_signs(signs).kind


def test_limits_are_those_of_the_documentation() -> None:
    page = (Path(__file__).parents[2] / "docs" / "verdict.md").read_text()
    lines = [line for line in page.split("## Symptoms")[1].split("##")[0].splitlines() if line.startswith("| `")]
    rows = {cells[1].strip(" `"): cells[3:5] for cells in (line.split("|") for line in lines)}
    assert set(rows) == {limit.code for limit in LIMITS}
    for limit in LIMITS:
        text, kind = rows[limit.code][0], rows[limit.code][1].strip()
        assert limit.kind == kind
        assert (limit.least, limit.most) == pytest.approx(read_range(text)), limit.code


def read_range(text: str) -> tuple[float, float]:
    """Return the range that a cell of the documentation states."""
    numbers = [float(one) / (100.0 if share else 1.0) for one, share in re.findall(r"(-?[\d.]*\d)( %)?", text)]
    if " to " in text.split(":", maxsplit=1)[0]:
        return numbers[0], numbers[1]
    number = 1.0 / 3.0 if "a third" in text else 0.0 if "none" in text else numbers[0]
    if "factor" in text:
        return 1.0 / number, number
    return (number, inf) if "or more" in text else (-inf, number)


def test_two_changed_landmarks_are_changes_and_no_outdated_map() -> None:
    of_map = replace(GOOD, common=3, in_map=True)
    for sign, kind in (("moved", VerdictKind.MAP_OUTDATED), ("displaced", VerdictKind.WEAK)):
        assert judge_signs(replace(of_map, **{sign: 2 / 3})).kind is VerdictKind.SOUND
        assert judge_signs(replace(of_map, **{sign: 1.0})).kind is kind


def test_a_map_that_the_session_does_not_fit_is_outdated_unless_the_solution_is_lost() -> None:
    for signs, set_aside, words in (
        (replace(GOOD, common=0), "", "no landmark of the map was seen"),
        (replace(GOOD, common=9), "too few agree", "not localised in the map: too few agree"),
        (replace(GOOD, common=9, in_map=False), "", "lies nowhere on the map"),
    ):
        found = judge_signs(signs, set_aside=set_aside)
        assert (found.kind, words in found.message) == (VerdictKind.MAP_OUTDATED, True)
        assert judge_signs(replace(signs, nis=50.0), set_aside=set_aside).kind is VerdictKind.LOST
        assert judge_signs(signs, ["ranges in mm"], set_aside=set_aside).kind is VerdictKind.SENSOR_SUSPECT
    assert judge_signs(replace(GOOD, common=9, in_map=True)).kind is VerdictKind.SOUND


def test_the_worst_decides_and_what_is_weak_comes_last() -> None:
    weak = replace(GOOD, blind_share=0.9)
    assert judge_signs(weak).kind is VerdictKind.WEAK
    assert judge_signs(replace(weak, moved=0.9, common=9)).kind is VerdictKind.MAP_OUTDATED
    assert judge_signs(replace(weak, moved=0.9, common=9, motion=0.9)).kind is VerdictKind.SENSOR_SUSPECT
    lost = judge_signs(replace(weak, moved=0.9, common=9, motion=0.9, nis=50.0))
    assert (lost.kind, lost.symptoms[0].is_alarming) == (VerdictKind.LOST, True)
    assert [one.code for one in lost.symptoms if one.is_alarming] == ["innovations", "odometry", "map-changed", "blind"]
