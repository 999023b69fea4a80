"""Several robots in space as one problem: against each alone, and against a dense solver of the same factors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap import Config, run_slam, run_together
from evermap.config import LocalizeConfig
from evermap.errors import DataError, InputError
from evermap.estimate.gauss_newton import Steps
from evermap.estimate.sparse.system import exhaust
from evermap.geometry import se3
from evermap.maps.sessions.spatial import solve_visit
from evermap.metrics.summary import compare_with_truth
from evermap.slam.space.together import SolvedRobot, _lay_together, align_robots, solve_space_together
from evermap.types import Frames, SpatialRecording, rows_of
from evermap_studies.causes.drives import MAKES, SITES, as_recording, simulate

from .corridors import tagged_corridor
from .halls import hall


def part(recording: SpatialRecording, first: int, last: int, name: str) -> SpatialRecording:
    """The frames from `first` to `last` - 1 as a recording of its own, with odometry that begins there."""
    seen = recording.detections
    some = rows_of(seen, np.flatnonzero((seen.frame >= first) & (seen.frame < last)))
    rows = np.arange(first, last)
    return replace(
        recording,
        name=name,
        odometry=rows_of(recording.odometry, rows),
        frames=Frames(recording.frames.stamp_s[rows]),
        detections=replace(some, frame=some.frame - first),
        truth=rows_of(recording.truth, rows),
    )


def pair(seed: int) -> dict[int, SpatialRecording]:
    """Two robots in one hall, each on a lap of its own."""
    whole = hall(seed, n_frames=560, drift=0.05)
    return {1: part(whole, 0, 280, f"hall {seed}"), 2: part(whole, 280, 560, "other")}


def landmark_error(recording: SpatialRecording, result) -> float:
    return float(compare_with_truth(recording, result, rate_hz=10.0).landmarks.rmse_m)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_two_robots_know_the_hall_better_than_each_alone(seed):
    recordings = pair(seed)
    alone = [landmark_error(one, run_slam(one)) for one in recordings.values()]
    results = run_together(recordings)
    together = [landmark_error(one, results[number]) for number, one in recordings.items()]
    assert np.mean(together) < 0.9 * np.mean(alone)
    assert [results[k].trajectory.frame for k in (1, 2)] == ["first_pose", "first_robot"]
    # both have what both saw at one place, in one frame
    _, a, b = np.intersect1d(results[1].landmarks.landmark_id, results[2].landmarks.landmark_id, return_indices=True)
    assert len(a) > 20
    np.testing.assert_allclose(results[1].landmarks.position_m[a], results[2].landmarks.position_m[b], atol=1e-12)
    offset = se3.compose(
        results[1].trajectory.pose_world_robot[0], se3.inverse(recordings[1].truth.pose_world_robot[0])
    )
    true = se3.compose(offset, recordings[2].truth.pose_world_robot)
    away = np.linalg.norm(results[2].trajectory.pose_world_robot[:, :3] - true[:, :3], axis=1)
    assert np.sqrt(np.mean(away**2)) < 0.4


def test_robots_that_see_corners_lose_none_where_their_frames_meet_to_within_centimetres(monkeypatch):
    """A quarter of the second one's corners were let go, and its levels were those of detections worth a twentieth."""
    make = MAKES["corners"]
    site = SITES[make.site](np.random.default_rng([1, 99]))
    monkeypatch.setitem(SITES, make.site, lambda _: site)
    robots = [as_recording(simulate(make, 1000 * number + 1, in_map=False)) for number in (1, 2)]
    visits = [solve_visit(robot, Config(), None, ()) for robot in robots]
    members = [SolvedRobot(visit.intake, visit.solved) for visit in visits]
    together = [one.optimum for one in solve_space_together(members, ["first", "second"], LocalizeConfig())]
    for joint, visit in zip(together, visits, strict=True):
        assert np.mean(joint.now.weight < 0.5) < 0.005
        assert joint.noise.pixel == pytest.approx(0.3, rel=0.05)
        np.testing.assert_array_equal(joint.smoother.problem.share, visit.optimum.smoother.problem.share)
        np.testing.assert_array_equal(joint.last[0].problem.share, 1.0)
    assert any((joint.smoother.problem.share < 0.5).all() for joint in together)


def test_covariances_are_those_of_a_dense_inverse():
    recordings = [tagged_corridor(seed, n_frames=12, n_tags=6).recording for seed in (1, 1)]
    visits = [solve_visit(one, Config(), None, ()) for one in recordings]
    members = [SolvedRobot(visit.intake, visit.solved) for visit in visits]
    joint, start = _lay_together(members, align_robots(members, ["a", "b"], LocalizeConfig()))
    solution = exhaust(joint.minimise_in_slices(start, Steps(10, 1e-5)))
    graph, values = joint.graph(solution.state), solution.now.values
    system, variable = graph.structure.system, joint.variables(np.ones(len(start.place), dtype=np.bool_))
    size = int(system.tree.begin[-1])
    information = np.zeros((size, size))
    for f, rows in enumerate(system.factors.rows.tolist()):
        block = values[system.tree.value_first[f] : system.tree.value_first[f + 1]].reshape(rows, -1)[:, :-1]
        tied = system.factors.variable[system.factors.first[f] : system.factors.first[f + 1]]
        at = np.concatenate([system.tree.begin[k] + np.arange(system.tree.dim[k]) for k in tied])
        information[np.ix_(at, at)] += block.T @ block
    information += np.diag(graph.held)
    border = size - len(graph.border.information)
    information[border:, border:] += np.diag(graph.border.information)
    covariance = np.linalg.inv(information)
    for r, part in enumerate(joint.parts(solution)):
        spread = part.smoother.spread(part.now)
        for k, of in enumerate(variable[r].tolist()):
            dim = int(system.tree.dim[of])
            at = system.tree.begin[of] + np.arange(dim)
            own = spread.own[spread.own_first[k] : spread.own_first[k + 1]].reshape(dim, dim)
            expected = covariance[np.ix_(at, at)]
            np.testing.assert_allclose(own, expected, atol=1e-5 * np.abs(expected).max())
        states = variable[r][-2:]
        at = np.concatenate([system.tree.begin[k] + np.arange(system.tree.dim[k]) for k in states])
        found = part.smoother.factorised(part.now).border_covariance()
        np.testing.assert_allclose(found, covariance[np.ix_(at, at)], atol=1e-6 * np.abs(found).max())
    assert exhaust(system.factorised(values, extra=graph.held)) is not None


@pytest.mark.slow
def test_robots_without_a_common_landmark_are_not_laid_together():
    recordings = pair(3)
    seen = recordings[2].detections
    recordings[2] = replace(recordings[2], detections=replace(seen, landmark_id=seen.landmark_id + 1000))
    with pytest.raises(DataError, match="nothing connects other to hall 3"):
        run_together(recordings)


def test_robots_are_laid_together_by_the_rules_of_the_user():
    strict = Config.model_validate({"slam": {"localize": {"certain_nats": 1e6}}})
    with pytest.raises(DataError, match=r"nothing connects other to hall 1: .* which may be by chance"):
        run_together(pair(1), config=strict)


def test_robots_in_the_plane_and_in_space_are_refused(tmp_path):
    from evermap import read_recording
    from evermap.io.template import write_template

    planar = read_recording(write_template(tmp_path / "drive"))
    with pytest.raises(InputError, match="some in space"):
        run_together({1: planar, 2: hall(3, n_frames=40)})
