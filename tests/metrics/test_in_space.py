"""Errors of poses and landmarks in space against evo, scipy and what was put in."""

import dataclasses
import json

import numpy as np
import pytest
from evo.core import geometry, metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from scipy import stats
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.special import gammaln, logsumexp
from synthetic_run import make_spatial_run, spatial_trajectory, spiral_stair

from evermap.errors import DataError
from evermap.estimate.innovations import comparable_nis
from evermap.geometry import se3
from evermap.geometry.group import PLANE, SPACE, group_of
from evermap.metrics.landmarks import evaluate_landmarks
from evermap.metrics.summary import compare_with_truth, metrics_dict
from evermap.metrics.trajectory import align_points, align_poses, drift_per_metre, evaluate_trajectory, interpolate
from evermap.types import Innovations

STAMPS = np.arange(0.0, 100.0, 0.1)
ELSEWHERE = se3.exp([4.0, -2.0, 1.0, 0.4, -1.1, 2.0])


@pytest.fixture(scope="module")
def spatial():
    return make_spatial_run()


def as_evo(stamp_s, poses):
    return PoseTrajectory3D(
        positions_xyz=poses[:, :3].copy(), orientations_quat_wxyz=poses[:, [6, 3, 4, 5]], timestamps=stamp_s
    )


def noisy(truth, rng, sigma=0.05):
    return se3.compose(ELSEWHERE, se3.retract(truth, sigma * rng.normal(size=(len(truth), 6))))


def test_the_group_of_poses_is_that_of_their_numbers():
    assert group_of(np.zeros((0, 3))) is PLANE
    assert group_of(se3.identity(4, 2)) is SPACE


@pytest.mark.parametrize("count", [3, 4, 50])
@pytest.mark.parametrize("mirrored", [False, True])
def test_alignment_of_points_equals_evo(count, mirrored):
    rng = np.random.default_rng(count)
    source = rng.normal(size=(count, 3)) * [7.0, 3.0, 2.0] + [100.0, -40.0, 5.0]
    target = se3.transform(ELSEWHERE, source * [1.0, -1.0 if mirrored else 1.0, 1.0])
    target = target + rng.normal(0, 0.3, (count, 3))
    rotation, shift, _ = geometry.umeyama_alignment(source.T, target.T)
    found = align_points(source, target)
    np.testing.assert_allclose(se3.rotation_of(found), rotation, atol=1e-9)
    np.testing.assert_allclose(found[:3], shift, atol=1e-7)


def test_points_on_a_line_are_refused_as_evo_refuses_them_and_their_poses_are_not():
    line = np.linspace(0, 9, 30)[:, None] * [1.0, 2.0, -1.0]
    target = se3.transform(ELSEWHERE, line)
    with pytest.raises(geometry.GeometryException):
        geometry.umeyama_alignment((line * [1, 0, 0]).T, (line * [1, 0, 0]).T)
    with pytest.raises(DataError, match="lie on a line"):
        align_points(line, target)
    with pytest.raises(DataError, match="at least three"):
        align_points(line[:2], target[:2])
    poses = np.column_stack([line, Rotation.random(30, random_state=1).as_quat()])
    found, how = align_poses(poses, se3.compose(ELSEWHERE, poses))
    assert how == "mean_orientation"
    np.testing.assert_allclose(se3.local(found, ELSEWHERE), 0, atol=1e-9)


def test_the_mean_orientation_equals_scipy():
    rng = np.random.default_rng(2)
    source = np.column_stack([np.zeros((40, 3)), Rotation.random(40, random_state=3).as_quat()])
    target = se3.compose(ELSEWHERE, se3.retract(source, np.pad(0.3 * rng.normal(size=(40, 3)), ((0, 0), (3, 0)))))
    found, _ = align_poses(source, target)
    turns = Rotation.from_quat(target[:, 3:]) * Rotation.from_quat(source[:, 3:]).inv()
    assert (Rotation.from_quat(found[3:]).inv() * turns.mean()).magnitude() < 1e-9


def test_errors_equal_evo_end_to_end():
    truth = spiral_stair(STAMPS)
    estimate = noisy(truth, np.random.default_rng(0))
    errors = evaluate_trajectory(spatial_trajectory(STAMPS, estimate), spatial_trajectory(STAMPS, truth), rate_hz=2.0)
    reference, theirs = sync.associate_trajectories(
        as_evo(STAMPS[::5], truth[::5]), as_evo(STAMPS, estimate), max_diff=1e-6
    )
    theirs.align(reference, correct_scale=False)
    position = metrics.APE(metrics.PoseRelation.translation_part)
    position.process_data((reference, theirs))
    turn = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
    turn.process_data((reference, theirs))
    expected = position.get_all_statistics()
    assert errors.alignment == "umeyama_se3"
    assert errors.rmse_m == pytest.approx(expected["rmse"], abs=1e-9)
    assert errors.mean_m == pytest.approx(expected["mean"], abs=1e-9)
    assert errors.median_m == pytest.approx(expected["median"], abs=1e-9)
    assert errors.max_m == pytest.approx(expected["max"], abs=1e-9)
    assert errors.orientation_rmse_deg == pytest.approx(turn.get_statistic(metrics.StatisticsType.rmse), abs=1e-6)
    np.testing.assert_allclose(np.degrees(errors.orientation_error_rad), turn.error, atol=1e-5)
    assert np.isnan(errors.heading_error_rad).all()


def test_what_has_no_pose_is_not_scored_as_evo_does_not():
    truth = spiral_stair(STAMPS)
    estimate = noisy(truth, np.random.default_rng(1))
    seen = (STAMPS < 20.0) | ((STAMPS > 23.0) & (STAMPS < 60.0)) | (STAMPS > 60.5)
    seen[400:500:3] = False
    mine = spatial_trajectory(STAMPS[seen] + 1e-7, estimate[seen])  # as a sum of a start and a time since then
    true = spatial_trajectory(STAMPS, truth)
    errors = evaluate_trajectory(mine, true, rate_hz=10.0, looked_s=STAMPS)
    reference, theirs = sync.associate_trajectories(
        as_evo(STAMPS, truth), as_evo(mine.stamp_s, estimate[seen]), max_diff=1e-3
    )
    theirs.align(reference, correct_scale=False)
    position = metrics.APE(metrics.PoseRelation.translation_part)
    position.process_data((reference, theirs))
    assert len(errors.stamp_s) == len(position.error)
    assert errors.skipped == np.count_nonzero(~seen)
    assert errors.rmse_m == pytest.approx(position.get_statistic(metrics.StatisticsType.rmse), abs=1e-6)
    everywhere = evaluate_trajectory(mine, true, rate_hz=10.0)
    assert everywhere.skipped == 0
    assert everywhere.rmse_m > errors.rmse_m
    # between frames that both have a pose, a truth of other stamps is scored
    denser = spatial_trajectory(STAMPS + 0.05, spiral_stair(STAMPS + 0.05))
    between = evaluate_trajectory(mine, denser, rate_hz=10.0, looked_s=STAMPS)
    assert len(between.stamp_s) == np.count_nonzero(seen[:-1] & seen[1:])


def test_drift_equals_evo_relative_error():
    rng = np.random.default_rng(6)
    stamps = np.arange(400.0)
    truth = np.column_stack([stamps[:, None] * [0.1, 0.06, 0.08] / np.sqrt(2), Rotation.random(400, rng).as_quat()])
    truth[:, :3] *= 1.25  # 10 m are 80 poses
    estimate = noisy(truth, rng, 0.02)
    theirs = metrics.RPE(
        metrics.PoseRelation.translation_part, delta=80, delta_unit=metrics.Unit.frames, all_pairs=True
    )
    theirs.process_data((as_evo(stamps, truth), as_evo(stamps, estimate)))
    median = theirs.get_statistic(metrics.StatisticsType.median)
    assert drift_per_metre(estimate, truth, 10.0 - 1e-9) == pytest.approx(median / 10.0, abs=1e-6)


def test_interpolation_follows_the_screw():
    twist = np.array([0.4, 0.1, -0.2, 0.5, -0.3, 0.7])
    stamps = np.arange(0.0, 9.0, 0.5)
    screw = spatial_trajectory(stamps, se3.exp(stamps[:, None] * twist), sigma=np.arange(1, 7) / 10)
    at = np.array([0.1, 3.3, 7.77])
    poses, covariance, gap_s = interpolate(screw, at)
    for pose, stamp_s in zip(poses, at, strict=True):
        matrix = np.zeros((4, 4))
        matrix[:3, :3] = np.cross(np.eye(3), twist[3:])
        matrix[:3, 3] = twist[:3]
        expected = expm(stamp_s * matrix)
        np.testing.assert_allclose(pose[:3], expected[:3, 3], atol=1e-12)
        np.testing.assert_allclose(se3.rotation_of(pose), expected[:3, :3], atol=1e-12)
    np.testing.assert_allclose(covariance, screw.covariance[:3], atol=1e-15)
    np.testing.assert_allclose(gap_s, 0.5)


def test_nees_is_chi_square_when_the_covariance_is_honest():
    rng = np.random.default_rng(7)
    stamps = np.arange(0.0, 3000.0, 0.5)
    sigma = np.array([0.3, 0.02, 0.05, 0.001, 0.004, 0.0005])  # its determinant is tiny: units must not matter
    truth = spiral_stair(stamps)
    estimate = se3.retract(truth, rng.normal(size=(len(stamps), 6)) * sigma)
    mine, true = spatial_trajectory(stamps, estimate, sigma), spatial_trajectory(stamps, truth)
    errors = evaluate_trajectory(mine, true, align=False)
    assert errors.dof == 3
    assert np.mean(errors.nees) == pytest.approx(3.0, abs=0.15)
    assert np.mean(errors.nees <= stats.chi2.ppf(0.95, 3)) == pytest.approx(0.95, abs=0.012)
    assert np.mean(errors.whole_nees) == pytest.approx(6.0, abs=0.2)
    assert np.mean(errors.whole_nees <= stats.chi2.ppf(0.95, 6)) == pytest.approx(0.95, abs=0.012)
    assert np.isnan(evaluate_trajectory(true, true, align=False).whole_nees).all()


def test_landmarks_are_compared_by_place_and_orientation(spatial):
    truth = spatial[0].true_landmarks
    turn = np.radians(3.0)
    moved = truth.position_m + [0.0, 0.0, 0.05]
    turned = se3.retract(np.pad(np.nan_to_num(truth.rotation, nan=0.5), ((0, 0), (3, 0))), [0, 0, 0, 0, turn, 0])[:, 3:]
    there = se3.compose(se3.inverse(ELSEWHERE), np.column_stack([moved, turned]))
    estimate = dataclasses.replace(
        truth, position_m=there[:, :3], rotation=there[:, 3:], n_hits=np.full(len(truth), 20),
        covariance_m2=np.tile(np.diag([0.01, 0.01, 0.01]), (len(truth), 1, 1)),
    )  # fmt: skip
    errors = evaluate_landmarks(estimate, truth, ELSEWHERE)
    assert (errors.rmse_m, errors.median_m, errors.max_m) == pytest.approx((0.05, 0.05, 0.05))
    assert errors.orientation_rmse_deg == pytest.approx(3.0)
    assert np.isnan(errors.orientation_error_rad[-1])  # the lamp is a point
    np.testing.assert_allclose(errors.nees, 0.25)
    own = evaluate_landmarks(estimate, truth, None)
    assert own.rmse_m == pytest.approx(0.0, abs=1e-9)
    assert own.orientation_rmse_deg == pytest.approx(3.0)
    points = dataclasses.replace(truth, rotation=None, rotation_covariance=None, n_hits=np.full(len(truth), 20))
    assert evaluate_landmarks(points, truth, None).orientation_rmse_deg is None


def test_what_looks_the_same_is_no_error(spatial):
    truth = spatial[0].true_landmarks
    kinds = np.array([0, 1, 2] * len(truth))[: len(truth)]
    truth = dataclasses.replace(truth, class_id=kinds, class_names=("can", "box", "mug"))
    turn = np.select([kinds == 0, kinds == 1], [1.0, np.pi], 0.1)
    known = np.pad(np.nan_to_num(truth.rotation, nan=0.5), ((0, 0), (3, 0)))
    turned = se3.retract(known, np.eye(6)[5] * turn[:, None])[:, 3:]
    turned[np.isnan(truth.rotation)] = np.nan
    estimate = dataclasses.replace(truth, rotation=turned, n_hits=np.full(len(truth), 20))
    still = se3.identity()
    alike = {"can": ("axis:z",), "box": ("180:z",), "spoon": ("180:x",)}
    found = evaluate_landmarks(estimate, truth, still, symmetries=alike).orientation_error_rad
    there = np.isfinite(truth.rotation[:, 0])
    assert found[there] == pytest.approx(np.where(kinds == 2, 0.1, 0.0)[there], abs=1e-7)
    plain = evaluate_landmarks(estimate, truth, still).orientation_error_rad
    assert plain[there] == pytest.approx(turn[there], abs=1e-7)
    assert np.isnan(plain[~there]).all()


def test_covariances_turn_with_the_map(spatial):
    truth = spatial[0].true_landmarks
    quarter = se3.exp([0, 0, 0, 0, np.pi / 2, 0])  # the map's z is the truth's x
    at = se3.transform(se3.inverse(quarter), truth.position_m + [0.2, 0.0, 0.0])
    spread = np.tile(np.diag([1e-4, 1e-4, 0.04]), (len(truth), 1, 1))
    estimate = dataclasses.replace(truth, position_m=at, covariance_m2=spread)
    np.testing.assert_allclose(evaluate_landmarks(estimate, truth, quarter).nees, 1.0)


def test_nis_of_any_degrees_of_freedom_have_one_scale():
    dof = np.repeat([1, 2, 3, 6, 8], 7)
    nis = np.tile([0.0, 1e-6, 0.3, 2.0, 15.0, 400.0, 5000.0], 5)
    none = np.arange(len(nis))
    given = Innovations(np.zeros(len(nis)), none, none, nis, np.ones(len(nis)), dof)
    near = nis < 1000.0
    np.testing.assert_allclose(comparable_nis(given)[near], -2.0 * stats.chi2.logsf(nis, dof)[near], rtol=1e-9)
    for size, found in zip(dof[~near], comparable_nis(given)[~near], strict=True):
        if size % 2 == 0:  # the tail is that of a Poisson variable; scipy's underflows
            k = np.arange(size / 2)
            assert found == pytest.approx(-2.0 * logsumexp(k * np.log(2500.0) - 2500.0 - gammaln(k + 1)), rel=1e-6)
    usual = dataclasses.replace(given, dof=None)
    assert comparable_nis(usual) is usual.nis
    np.testing.assert_array_equal(comparable_nis(dataclasses.replace(given, nis=np.full(35, np.nan))), np.nan)


def test_the_summary_has_the_keys_of_the_plane_and_says_null_of_headings(spatial, run):
    recording, result = spatial
    summary, plane = metrics_dict(compare_with_truth(*spatial)), metrics_dict(compare_with_truth(*run))
    assert summary.keys() == plane.keys()
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert [key for key in summary if summary[key] is None] == [key for key in summary if "heading" in key]
    assert plane["orientation_rmse_deg"] == plane["heading_rmse_deg"]
    assert (plane["nees_dof"], summary["nees_dof"]) == (2, 3)
    assert summary["pose_rmse_m"] == pytest.approx(0.03 * np.sqrt(3), rel=0.1)
    assert summary["orientation_rmse_deg"] == pytest.approx(np.degrees(0.01 * np.sqrt(3)), rel=0.1)
    assert summary["nis_mean"] == pytest.approx(2.0, abs=0.2)
    assert summary["alignment"]["pose_truth_estimate"].keys() == {"x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"}
    nothing = spatial_trajectory(np.zeros(0), np.zeros((0, 7)))
    by_hand = dataclasses.replace(result, dead_reckoning=nothing)
    without = metrics_dict(compare_with_truth(dataclasses.replace(recording, odometry=None), by_hand))
    assert without["dead_reckoning_rmse_m"] is None
    seen = np.unique(recording.detections.frame)
    told = result.trajectory
    some = dataclasses.replace(
        told, stamp_s=told.stamp_s[seen], pose_world_robot=told.pose_world_robot[seen], covariance=told.covariance[seen]
    )
    partial = metrics_dict(compare_with_truth(recording, dataclasses.replace(by_hand, trajectory=some), rate_hz=10.0))
    assert partial["alignment"]["scored_stamps"] == len(seen)
    assert partial["alignment"]["skipped_stamps"] == seen[-1] - seen[0] + 1 - len(seen)
