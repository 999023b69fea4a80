"""What a cause changes, linearised alone, against all of a session linearised again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evermap.config import Config
from evermap.estimate.sparse.system import exhaust
from evermap.explain.causes import list_suspects
from evermap.explain.causes.suspect import Inputs
from evermap.explain.evidence import residuals_of
from evermap.explain.linearise import FINE_STEP, STEP, change_by, change_by_motion
from evermap.maps.sessions import solve
from evermap.slam.estimate import Solved
from evermap.slam.intake import prepare
from evermap.slam.smoother import Smoother

from .worlds import World

CONFIG = Config.model_validate({"slam": {"explain": {"on": False}}})


@pytest.mark.parametrize("in_map", [False, True])
def test_a_cause_in_the_plane_changes_residuals_as_if_all_were_linearised(*, in_map: bool) -> None:
    recording = World(seed=2).plane()
    given = recording.true_landmarks if in_map else None
    screened = solve.explain_session(Inputs.of(recording, given), CONFIG, ()).best.solution.asked
    solved, screen, inputs, asked = screened.session, screened.screen, screened.inputs, set()
    assert isinstance(solved, Solved)
    graph, state, problem = screen.optimum.graph, screen.optimum.state, solved.outcome.problem
    for suspect in list_suspects(inputs, calibrations=True):
        found, step = change_by(solved, screen, inputs, suspect), STEP * suspect.sigma
        if found is None:  # a clock that leaves frames behind the odometry
            continue
        undone = suspect.undo(inputs, step)
        other = prepare(undone.recording, None, (), solved.settings.odometry).problem  # type: ignore[arg-type]
        names = ("stamp_s", "drive", "reading", "sigma_given", "mount")
        moved = replace(problem, **{name: getattr(other, name) for name in names})
        if given is not None and undone.prior_map is not None:
            rows = np.searchsorted(given.landmark_id, solved.prepared.landmark_id)
            moved = replace(moved, landmark_mean=undone.prior_map.position_m[rows])
        smoother = Smoother(moved, solved.outcome.noise.noise, robust=solved.settings.robust)
        now = exhaust(replace(graph, blocks=smoother.blocks(state.known)).linearised(state))
        expected = (residuals_of(graph, now)[0] - screen.residual) / step
        assert np.abs(expected).max() > 0.0, suspect.subject
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max()), suspect.subject
        asked.add(suspect.code)
    assert {"range-scale", "odometry-scale", "turn-scale", "mount"} <= asked
    assert ("map-scale" in asked) == in_map


def test_a_lens_changes_residuals_as_if_all_were_read_again() -> None:
    screened = solve.explain_session(Inputs.of(World(seed=2).space(corners=True), None), CONFIG, ()).best.solution.asked
    solved, screen, inputs, asked = screened.session, screened.screen, screened.inputs, 0
    for suspect in list_suspects(inputs, calibrations=True):
        if suspect.code not in {"focal-length", "intrinsics", "distortion"}:
            continue

        def read_again(inputs: Inputs, state: float, undo: Any = suspect.undo) -> Inputs:
            undone = undo(inputs, state)
            return replace(undone, recording=replace(undone.recording, detections=replace(undone.recording.detections)))

        found = change_by(solved, screen, inputs, suspect)
        expected = change_by(solved, screen, inputs, replace(suspect, undo=read_again))
        assert found is not None
        assert expected is not None
        assert np.abs(expected).max() > 0.0
        assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max(), suspect.subject
        asked += 1
    assert asked > 0


def test_noise_of_the_same_size_at_all_ranges_does_not_shrink_them() -> None:
    """Shorter ranges have shorter errors: were their noise to stay, all lengths together would seem too long."""
    recording = World(seed=3).space(corners=False)
    seen = recording.detections
    unstated = replace(seen, covariance_sensor_m2=np.full((len(seen), 3, 3), np.nan))
    sensors = tuple(replace(one, sigma_m=0.03) for one in recording.sensors)
    recording = replace(recording, detections=unstated, sensors=sensors)
    screened = solve.explain_session(Inputs.of(recording, None), CONFIG, ()).best.solution.asked
    solved, screen, inputs = screened.session, screened.screen, screened.inputs
    suspects = {one.code: one for one in list_suspects(inputs, calibrations=True)}
    ranges = change_by(solved, screen, inputs, suspects["range-scale"], FINE_STEP)
    driven = change_by_motion(solved, screen, inputs, suspects["odometry-scale"])
    assert ranges is not None
    assert driven is not None
    lengths = screen.column(ranges + driven)  # of which mounts alone have the metre
    assert abs(screen.pull(lengths)) < 3.0 * lengths.information_with(lengths) ** 0.5
