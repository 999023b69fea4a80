"""Verdicts by signs, and of runs in made worlds: as they are, and with a mistake or a wrong map."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from evermap import run_slam
from evermap.explain.symptoms import Signs, measure_signs
from evermap.explain.verdict import LIMITS, Limit, judge_signs
from evermap.types import AssociationEvidence, Cause, Landmarks, Recording, VerdictKind
from evermap.viz.verdict_words import cause_text, further_causes
from evermap_studies.worlds.lasers import LaserWorld, simulate_laser

GOOD = Signs(n_landmarks=12, n_used=500, nis=2.0, used=0.98, sigma_m=0.02, size_m=10.0)


def recorded() -> tuple[Recording, Landmarks]:
    recording = simulate_laser(LaserWorld(duration_s=60.0, n_landmarks=12), seed=5)
    survey = recording.true_landmarks
    assert survey is not None
    return recording, Landmarks.at(survey.landmark_id, survey.position_m, sigma_m=0.02, frame="prior_map")


@pytest.mark.parametrize("limit", LIMITS, ids=lambda limit: limit.code)
def test_a_sign_beyond_its_limit_decides(limit: Limit) -> None:
    edge, way = (limit.most, 1.0) if limit.most < inf else (limit.least, -1.0)
    signs = replace(GOOD, common=12)
    for value, kind in ((edge, VerdictKind.SOUND), (edge + way * max(0.01 * abs(edge), 1e-6), limit.kind)):
        changed = {"sigma_m": value * GOOD.size_m} if limit.sign == "sigma_share" else {limit.sign: value}
        assert judge_signs(replace(signs, **changed)).kind is kind


def test_a_cause_is_told_with_its_remedy_where_it_is_sure() -> None:
    size = Cause("tag-size", "all tags", "tags are 10 % larger", probability=0.99, fix="tag_size_m = 0.176")
    found = judge_signs(GOOD, causes=[size])
    assert (found.kind, found.message) == (
        VerdictKind.SENSOR_SUSPECT, "tags are 10 % larger (try: tag_size_m = 0.176)"
    )  # fmt: skip
    assert judge_signs(GOOD, causes=[replace(size, probability=0.5)]).kind is VerdictKind.SOUND
    of_map = replace(size, code="map-scale", subject="map")
    assert judge_signs(GOOD, causes=[of_map]).kind is VerdictKind.MAP_OUTDATED


def test_a_delay_that_the_estimator_put_right_is_no_suspicion() -> None:
    late = Cause("clock", "front", "stamps of front are 0.12 s late", 0.12, 0.002, 0.99, "stamp_s - 0.12")
    found = judge_signs(GOOD, causes=[late])
    assert (found.kind, found.causes) == (VerdictKind.SOUND, (late,))
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
    result = run_slam(recording)
    pose = result.trajectory.pose_world_robot.copy()
    pose[3] = np.nan
    signs = measure_signs(replace(result, trajectory=replace(result.trajectory, pose_world_robot=pose)), recording)
    assert signs.n_unknown == 1
    assert judge_signs(signs).kind is VerdictKind.LOST


def test_an_association_that_is_worse_than_odometry_alone_is_lost() -> None:
    recording, _ = recorded()
    result = run_slam(recording)
    for evidence, kind in (
        (AssociationEvidence(0.1, 12, 30, 18, 20.0, 200.0), VerdictKind.SOUND),
        (AssociationEvidence(0.5, 12, 30, 18, 20.0, 200.0), VerdictKind.LOST),
        (AssociationEvidence(0.1, 12, 30, 18, 80.0, 200.0), VerdictKind.LOST),
        (AssociationEvidence(0.1, 12, 30, 18, 20.0, -20.0), VerdictKind.LOST),
    ):
        assert judge_signs(measure_signs(replace(result, association=evidence), recording)).kind is kind


def test_runs_end_with_a_verdict() -> None:
    recording, survey = recorded()
    for given in (None, survey):
        verdict = run_slam(recording, prior_map=given).verdict
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
