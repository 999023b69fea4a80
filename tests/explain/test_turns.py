"""Turns of the odometry that are off by more than is usual of robots: named, undone, and the run is sound."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evermap import run_slam
from evermap.config import Config
from evermap.explain import scores
from evermap.explain.causes.odometry import turn_less
from evermap.explain.causes.suspect import Inputs
from evermap.explain.put_right import add_put_right, solve_with_right_turns
from evermap.explain.scores import TURN_BIAS, ScreenedSession, is_unusual, score_odometry
from evermap.explain.symptoms import Signs
from evermap.explain.trial import Explained, SessionSolution, Taken, Trial
from evermap.explain.verdict import judge_signs
from evermap.geometry import se3
from evermap.maps.sessions import solve
from evermap.types import AnyRecording, Cause, SlamResult, VerdictKind

from .worlds import World

NAN = float("nan")


def record(world: World, kind: str) -> Any:
    return world.plane() if kind == "plane" else world.space(corners=kind == "corners")


def score(recording: AnyRecording) -> dict[str, scores.CalibrationScore]:
    """Return what a session tells of odometry that is solved as given, by codes."""
    config = Config.model_validate({"slam": {"explain": {"on": False}}})
    asked = solve.explain_session(Inputs.of(recording, None), config, ()).best.solution.asked
    return {one.suspect.code: one for one in score_odometry(asked)}


def state_of(result: SlamResult, name: str) -> float:
    return next(one.value for one in result.parameters if one.name == name)


@pytest.mark.parametrize(
    "kind", ["plane", *(pytest.param(name, marks=pytest.mark.slow) for name in ("corners", "poses"))]
)
def test_a_gyroscope_whose_zero_is_off_is_named_and_put_right(kind: str) -> None:
    result = run_slam(record(World(seed=1, seconds=40.0, drift=0.002, bias_radps=-0.03), kind))
    (cause,) = result.causes
    assert (cause.code, cause.subject, cause.probability) == ("turn-bias", "odometry", 1.0)
    assert cause.value == pytest.approx(-0.03, abs=0.001)
    assert 1e-4 < cause.sigma < 0.001
    assert f"turns {-cause.value:.3g} rad/s too much to the right" in cause.message
    assert cause.fix == f"odometry.csv: turns + {-cause.value:.3g} rad/s"
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SOUND
    assert cause in result.verdict.causes


def test_turns_of_another_scale_are_a_state_in_the_plane() -> None:
    result = run_slam(World(seed=1, turns=0.92).plane())
    assert not result.causes
    assert state_of(result, "odometry_turn_scale") == pytest.approx(0.92, abs=0.01)


def test_no_state_takes_in_what_was_undone() -> None:
    """Turns to one side: a scale of turns would explain half of it."""
    right, off = (run_slam(World(seed=1, bias_radps=by).plane()) for by in (0.0, 0.03))
    for name in ("odometry_turn_scale", "odometry_turn_slip_m", "sigma_turn_per_sqrt_s"):
        assert state_of(off, name) == pytest.approx(state_of(right, name), abs=0.003)


def test_turns_of_another_scale_are_named_in_space() -> None:
    result = run_slam(World(seed=1, turns=0.92).space())
    (cause,) = result.causes
    assert (cause.code, cause.value) == ("turn-scale", pytest.approx(0.92, abs=0.01))
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SOUND


@pytest.mark.parametrize("kind", ["plane", "corners"])
def test_what_every_robot_has_is_not_named(kind: str) -> None:
    result = run_slam(record(World(seed=1, bias_radps=0.005, turns=1.02), kind))
    assert not result.causes
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SOUND


def test_zero_and_scale_are_told_from_each_other() -> None:
    found = score(World(seed=1, drift=0.002, bias_radps=0.02, turns=0.95).space())
    assert found["turn-bias"].value == pytest.approx(0.02, abs=0.003)
    assert found["turn-scale"].value == pytest.approx(np.log(0.95), abs=0.01)
    assert is_unusual(found["turn-bias"])
    assert is_unusual(found["turn-scale"])
    assert "odometry-scale" not in found  # it is a state
    assert set(score(World(seed=1).plane())) == {"turn-bias"}


def test_what_is_left_of_a_zero_is_added_to_what_was_undone() -> None:
    inputs, config = Inputs.of(World(seed=1, drift=0.002, bias_radps=0.03).plane(), None), Config()

    def under(given: Inputs) -> Any:
        visit = solve.solve_session(given.recording, config, None, ())
        return SessionSolution(visit, ScreenedSession(solve.solution_of(visit), given), visit.concluded())

    found = solve_with_right_turns(inputs, [Taken(TURN_BIAS, 0.022, 1.0)], under, config.slam)
    assert found is not None
    given, _, (taken,) = found
    assert taken.state == pytest.approx(0.03, abs=0.001)
    assert taken.information > 1e5
    assert given.recording.odometry.angular_radps == pytest.approx(inputs.recording.odometry.angular_radps - 0.022)  # type: ignore[union-attr]
    assert solve_with_right_turns(inputs, [Taken(TURN_BIAS, 0.0, 1.0)], under, config.slam) is None


def test_what_is_usual_has_a_prior() -> None:
    inputs = Inputs.of(World(seed=1, seconds=10.0).space(), None)
    usual = solve.explain_session(inputs, Config(), ()).best.solution.asked.usual
    assert [one.suspect.code for one in usual] == ["odometry-scale", "turn-scale", "turn-bias"]
    wide, narrow = (scores._find_shared(usual, share) for share in (1.0, 0.5))
    sigma = np.array([0.15, 0.15, 0.05])
    assert narrow - wide == pytest.approx(np.diag(3.0 / sigma**2), rel=1e-6)


def test_errors_that_last_are_no_zero_that_is_off() -> None:
    """A rate that wanders for seconds: 300 steps in a row say what few do."""
    recording = World(seed=1, drift=0.0).plane()
    driven = recording.odometry
    wander = np.repeat(np.random.default_rng(5).normal(size=9), -(-len(driven) // 9))[: len(driven)]
    wander += 0.5 - wander.mean()
    off = replace(recording, odometry=replace(driven, angular_radps=driven.angular_radps + 0.03 * wander))
    (found,) = score(off).values()
    assert found.value == pytest.approx(0.015, abs=0.005)
    assert 0.5 * (found.value / found.sigma) ** 2 > 2.0 * found.gain
    assert not is_unusual(found)


def test_what_is_unusual_is_significant_and_large() -> None:
    at = scores.CalibrationScore(TURN_BIAS, 0.0131, 0.001, 10.1, NAN)
    assert is_unusual(at)
    assert is_unusual(replace(at, value=-0.0131))
    assert not is_unusual(replace(at, value=0.0129))
    assert not is_unusual(replace(at, gain=9.9))


def test_turns_are_less_by_a_rate_about_the_axis_of_the_robot() -> None:
    plane: Any = World().plane()
    driven = turn_less(Inputs.of(plane, None), 0.01).recording.odometry
    assert driven is not None
    assert driven.angular_radps == pytest.approx(plane.odometry.angular_radps - 0.01)  # type: ignore[union-attr]
    assert np.array_equal(driven.forward_mps, plane.odometry.forward_mps)  # type: ignore[union-attr]
    space: Any = World().space()
    pose, stamp_s = space.odometry.pose_world_robot, space.odometry.stamp_s
    other: Any = turn_less(Inputs.of(space, None), 0.01).recording.odometry
    was, now = (se3.log(se3.between(one[:-1], one[1:])) for one in (pose, other.pose_world_robot))
    assert now[:, 5] == pytest.approx(was[:, 5] - 0.01 * np.diff(stamp_s), abs=1e-12)
    assert now[:, :5] == pytest.approx(was[:, :5], abs=1e-12)
    assert other.pose_world_robot[0] == pytest.approx(pose[0])


def test_causes_that_were_undone_are_listed_first() -> None:
    best: Any = Trial(None, (), NAN, 1.0)  # type: ignore[type-var]
    other = Cause("clock", "sensor", "late", 0.1, 0.01, 1.0, "")
    found = add_put_right(Explained(best, (other,)), Taken(TURN_BIAS, 0.02, 1e6))
    assert [one.code for one in found.causes] == ["turn-bias", "clock"]
    cause = found.causes[0]
    assert (cause.value, cause.sigma, cause.probability) == (0.02, pytest.approx(1e-3), 1.0)
    assert np.isnan(cause.nats)
    assert [one.suspect.code for one in found.best.taken] == ["turn-bias"]


@pytest.mark.parametrize(
    ("code", "value", "nats", "kind"),
    [
        ("turn-bias", 0.03, NAN, VerdictKind.SOUND),
        ("turn-scale", 0.92, NAN, VerdictKind.SOUND),
        ("turn-scale", 1.34, NAN, VerdictKind.SOUND),
        ("turn-scale", 0.7, NAN, VerdictKind.SENSOR_SUSPECT),
        ("turn-scale", 1.4, NAN, VerdictKind.SENSOR_SUSPECT),
        ("turn-scale", 0.92, 30.0, VerdictKind.SENSOR_SUSPECT),
        ("turn-bias", 0.03, 30.0, VerdictKind.SENSOR_SUSPECT),
        ("odometry-scale", 0.92, NAN, VerdictKind.SENSOR_SUSPECT),
    ],
)
def test_what_was_put_right_suspects_nothing(code: str, value: float, nats: float, kind: VerdictKind) -> None:
    signs = Signs(n_landmarks=9, n_used=99, nis=2.0, used=1.0)
    assert judge_signs(signs, causes=(Cause(code, "odometry", "off", value, 0.01, 1.0, "", nats),)).kind is kind
