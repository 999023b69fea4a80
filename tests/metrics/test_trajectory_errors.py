"""Pose errors against evo, scipy and closed forms."""

import numpy as np
import pytest
from evo.core import geometry, metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from synthetic_run import figure_eight, trajectory

from evermap.errors import DataError
from evermap.geometry import se2
from evermap.metrics.trajectory import align_points, drift_per_metre, evaluate_trajectory, interpolate, scored_stamps

STAMPS = np.arange(0.0, 100.0, 0.1)


def as_evo(stamp_s, poses):
    quaternion = Rotation.from_euler("z", poses[:, 2:]).as_quat()[:, [3, 0, 1, 2]]
    xyz = np.column_stack([poses[:, :2], np.zeros(len(poses))])
    return PoseTrajectory3D(positions_xyz=xyz, orientations_quat_wxyz=quaternion, timestamps=stamp_s)


@given(st.floats(-20, 20), st.floats(-20, 20), st.floats(-3.1, 3.1))
@settings(max_examples=25)
def test_an_estimate_in_another_frame_has_no_error(x, y, theta):
    truth = figure_eight(STAMPS)
    estimate = se2.compose(np.array([x, y, theta]), truth)
    errors = evaluate_trajectory(trajectory(STAMPS, estimate), trajectory(STAMPS, truth))
    assert errors.rmse_m < 1e-9
    assert errors.heading_rmse_deg < 1e-7
    np.testing.assert_allclose(se2.compose(errors.pose_truth_estimate, [x, y, theta]), 0, atol=1e-9)


def test_alignment_equals_the_closed_form_and_a_numerical_minimum():
    rng = np.random.default_rng(3)
    source = rng.normal(size=(40, 2)) * [5, 2]
    target = se2.transform(np.array([1.0, -2.0, 2.9]), source) + rng.normal(0, 0.4, (40, 2))
    found = align_points(source, target)

    a, b = source - source.mean(0), target - target.mean(0)
    turn = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    shift = target.mean(0) - se2.rotation(turn) @ source.mean(0)
    np.testing.assert_allclose(found, [*shift, turn], atol=1e-12)

    def cost(pose):
        return np.sum((se2.transform(pose, source) - target) ** 2)

    best = minimize(cost, [0.5, -1.5, 2.5], tol=1e-12)
    np.testing.assert_allclose(found, best.x, atol=1e-5)


@pytest.mark.parametrize("count", [2, 3, 50])
@pytest.mark.parametrize("mirrored", [False, True])
def test_alignment_equals_evo(count, mirrored):
    rng = np.random.default_rng(count)
    source = rng.normal(size=(count, 2)) * [7.0, 3.0] + [100.0, -40.0]
    target = se2.transform(np.array([-3.0, 8.0, -2.6]), source * [1.0, -1.0 if mirrored else 1.0])
    target = target + rng.normal(0, 0.3, (count, 2))
    rotation, shift, _ = geometry.umeyama_alignment(source.T, target.T)
    found = align_points(source, target)
    np.testing.assert_allclose(se2.rotation(found[2]), rotation, atol=1e-11)
    np.testing.assert_allclose(found[:2], shift, atol=1e-9)


def test_alignment_is_refused_where_evo_refuses_it():
    rng = np.random.default_rng(5)
    for spread in (0.0, 1e-9, 1e-8, 1e-7, 1.0):
        source = np.ones((6, 2)) + spread * rng.normal(size=(6, 2))
        try:
            geometry.umeyama_alignment(source.T, (2.0 * source).T)
        except geometry.GeometryException:
            with pytest.raises(DataError, match="coincide"):
                align_points(source, 2.0 * source)
        else:
            align_points(source, 2.0 * source)


def test_alignment_of_a_straight_drive_and_of_standing_still():
    line = np.column_stack([np.linspace(0, 9, 30), np.zeros(30)])
    target = se2.transform(np.array([3.0, 1.0, -2.0]), line)
    np.testing.assert_allclose(align_points(line, target), [3.0, 1.0, -2.0], atol=1e-9)
    with pytest.raises(DataError, match="coincide"):
        align_points(np.zeros((5, 2)), np.ones((5, 2)))

    still = np.tile([2.0, 1.0, 0.5], (len(STAMPS), 1))
    errors = evaluate_trajectory(trajectory(STAMPS, still), trajectory(STAMPS, np.tile([0, 0, -3.0], (len(STAMPS), 1))))
    assert errors.alignment == "mean_heading"
    assert errors.rmse_m < 1e-9
    assert errors.heading_rmse_deg < 1e-9


def test_errors_equal_evo_end_to_end():
    rng = np.random.default_rng(0)
    truth = figure_eight(STAMPS)
    noisy = se2.compose(np.array([4.0, 2.0, 1.0]), se2.compose(truth, rng.normal(size=(len(STAMPS), 3)) * 0.05))
    errors = evaluate_trajectory(trajectory(STAMPS, noisy), trajectory(STAMPS, truth), rate_hz=2.0)

    reference, estimate = as_evo(STAMPS[::5], truth[::5]), as_evo(STAMPS, noisy)
    reference, estimate = sync.associate_trajectories(reference, estimate, max_diff=1e-6)
    # evo aligns in space; a plane is enough there as the noise stays in it
    estimate.align(reference, correct_scale=False)
    position = metrics.APE(metrics.PoseRelation.translation_part)
    position.process_data((reference, estimate))
    heading = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
    heading.process_data((reference, estimate))
    theirs = position.get_all_statistics()
    assert len(errors.stamp_s) == len(STAMPS[::5])
    assert errors.rmse_m == pytest.approx(theirs["rmse"], abs=1e-9)
    assert errors.mean_m == pytest.approx(theirs["mean"], abs=1e-9)
    assert errors.median_m == pytest.approx(theirs["median"], abs=1e-9)
    assert errors.max_m == pytest.approx(theirs["max"], abs=1e-9)
    assert errors.heading_rmse_deg == pytest.approx(heading.get_statistic(metrics.StatisticsType.rmse), abs=1e-6)


def test_known_noise_gives_the_known_rmse():
    rng = np.random.default_rng(1)
    stamps = np.arange(0.0, 4000.0, 0.5)
    truth = figure_eight(stamps)
    noise = rng.normal(size=(len(stamps), 3)) * [0.03, 0.04, np.radians(2.0)]
    errors = evaluate_trajectory(trajectory(stamps, truth + noise), trajectory(stamps, truth), align=False)
    assert errors.rmse_m == pytest.approx(0.05, rel=0.03)
    assert errors.heading_rmse_deg == pytest.approx(2.0, rel=0.03)


def test_headings_wrap_at_pi():
    truth = np.tile([0.0, 0.0, np.pi - 0.001], (len(STAMPS), 1))
    estimate = np.tile([0.0, 0.0, -np.pi + 0.001], (len(STAMPS), 1))
    errors = evaluate_trajectory(trajectory(STAMPS, estimate), trajectory(STAMPS, truth), align=False)
    assert errors.heading_rmse_deg == pytest.approx(np.degrees(0.002))
    np.testing.assert_allclose(errors.heading_error_rad, 0.002, atol=1e-12)


def test_interpolation_follows_the_arc_and_crosses_pi():
    stamps = np.arange(0.0, 30.0, 0.5)
    twist = np.array([0.4, 0.0, 0.7])
    arc = trajectory(stamps, se2.exp(stamps[:, None] * twist), sigma=(0.1, 0.2, 0.3))
    at = np.random.default_rng(0).uniform(0, stamps[-1], 200)
    poses, covariance, gap_s = interpolate(arc, at)
    np.testing.assert_allclose(se2.log(se2.between(se2.exp(at[:, None] * twist), poses)), 0, atol=1e-12)
    np.testing.assert_allclose(covariance, arc.covariance[:1].repeat(200, 0), atol=1e-15)
    np.testing.assert_allclose(gap_s, 0.5)
    exact, _, none = interpolate(arc, stamps)
    np.testing.assert_array_equal(exact, arc.pose_world_robot)
    assert not none.any()


def test_truth_is_scored_where_it_is_and_never_invented():
    stamps = np.concatenate([np.arange(0, 20, 1 / 3), np.arange(50, 60, 1 / 3)])
    truth = trajectory(stamps, figure_eight(stamps))
    rows = scored_stamps(truth, 5.0, 55.0, 2.0)
    scored = stamps[rows]
    assert scored.min() >= 5.0
    assert scored.max() <= 55.0
    assert not np.any((scored > 20) & (scored < 50))
    assert len(rows) == len(set(rows.tolist()))
    fast = np.arange(0, 30, 0.01)
    rows = scored_stamps(trajectory(fast, figure_eight(fast)), 0.0, 30.0, 2.0)
    np.testing.assert_allclose(np.diff(fast[rows]), 0.5, atol=0.011)
    assert len(scored_stamps(truth, 70.0, 80.0, 2.0)) == 0
    stray = np.append(stamps, 4e10)  # a regular clock over that span would need hundreds of gigabytes
    assert len(scored_stamps(trajectory(stray, figure_eight(stray)), 0.0, 5e10, 2.0)) > 40


def test_estimates_far_from_any_pose_can_be_left_out():
    sparse = np.concatenate([np.arange(0, 40, 0.2), np.arange(60, 100, 0.2)])
    truth = trajectory(STAMPS, figure_eight(STAMPS))
    estimate = trajectory(sparse, figure_eight(sparse))
    everything = evaluate_trajectory(estimate, truth)
    near = evaluate_trajectory(estimate, truth, max_gap_s=1.0)
    assert everything.skipped == 0
    assert near.skipped == pytest.approx(40, abs=2)
    assert everything.rmse_m > 0.2
    assert near.rmse_m < 1e-3


def test_nothing_to_compare_is_none():
    truth = trajectory(STAMPS + 1000.0, figure_eight(STAMPS))
    assert evaluate_trajectory(trajectory(STAMPS, figure_eight(STAMPS)), truth) is None
    assert evaluate_trajectory(trajectory(STAMPS[:0], np.zeros((0, 3))), truth) is None


@pytest.mark.parametrize("heading_rad", [0.0, 1.3, -2.8])
def test_pose_nees_is_chi_square_when_the_covariance_is_honest(heading_rad):
    rng = np.random.default_rng(7)
    stamps = np.arange(0.0, 3000.0, 0.5)
    sigma = np.array([0.2, 0.02, 0.01])  # long along the heading: the covariance must be turned, not just taken
    truth = figure_eight(stamps)
    truth = se2.compose(np.array([0, 0, heading_rad]), truth)
    estimate = se2.compose(truth, se2.exp(rng.normal(size=(len(stamps), 3)) * sigma))
    errors = evaluate_trajectory(trajectory(stamps, estimate, sigma), trajectory(stamps, truth), align=False)
    assert np.mean(errors.nees) == pytest.approx(2.0, abs=0.12)
    assert np.mean(errors.nees <= 5.991) == pytest.approx(0.95, abs=0.012)


def test_anchoring_recovers_what_alignment_takes_from_nees():
    # one unknown rotation about the first pose: covariance relative to that pose grows with the distance from it
    rng = np.random.default_rng(0)
    truth = figure_eight(STAMPS)
    anchored, aligned = [], []
    sigma = 0.02
    for turn in rng.normal(0, sigma, 200):
        noise = rng.normal(size=(len(STAMPS), 2)) * 0.01
        estimate = se2.compose(np.array([0, 0, turn]), truth)
        estimate = np.column_stack([estimate[:, :2] + noise, estimate[:, 2]])
        estimate[0] = truth[0]
        side = np.column_stack([-truth[:, 1], truth[:, 0]])
        world = sigma**2 * side[:, :, None] * side[:, None, :] + 1e-4 * np.eye(2)
        covariance = np.zeros((len(STAMPS), 3, 3))
        frame = se2.rotation(estimate[:, 2])
        covariance[:, :2, :2] = np.swapaxes(frame, 1, 2) @ world @ frame
        covariance[:, 2, 2] = sigma**2
        own = trajectory(STAMPS, estimate)
        errors = evaluate_trajectory(type(own)(STAMPS, estimate, covariance), trajectory(STAMPS, truth), rate_hz=0.5)
        anchored.append(np.mean(errors.anchored_nees[1:]))
        aligned.append(np.mean(errors.nees))
    assert np.mean(anchored) == pytest.approx(2.0, abs=0.2)
    assert np.mean(aligned) < 1.6


@pytest.mark.parametrize("gauge", [0, 3])
def test_errors_are_anchored_at_the_pose_that_holds_the_frame(gauge):
    """Poses by the odometry alone may come before the first one that saw anything."""
    truth = figure_eight(STAMPS)
    estimate = truth + [0.1, 0.0, 0.0]
    estimate[gauge] = truth[gauge]
    covariance = np.tile(0.1**2 * np.eye(3), (len(STAMPS), 1, 1))
    covariance[gauge] = 1e-8 * np.eye(3)
    found = evaluate_trajectory(
        type(trajectory(STAMPS, truth))(STAMPS, estimate, covariance), trajectory(STAMPS, truth), rate_hz=100.0
    )
    np.testing.assert_allclose(found.pose_truth_anchor, np.zeros(3), atol=1e-12)
    assert found.anchored_nees[gauge] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(np.delete(found.anchored_nees, gauge), 1.0)


def test_no_error_is_anchored_where_nothing_is_scored_near_the_pose_that_holds_the_frame():
    truth, late = figure_eight(STAMPS), np.arange(len(STAMPS)) > len(STAMPS) // 4
    covariance = np.tile(0.1**2 * np.eye(3), (len(STAMPS), 1, 1))
    covariance[0] = 0.0
    estimate = type(trajectory(STAMPS, truth))(STAMPS, truth, covariance)
    assert evaluate_trajectory(estimate, trajectory(STAMPS[late], truth[late])).anchored_nees is None


def test_drift_equals_evo_relative_error():
    rng = np.random.default_rng(6)
    stamps = np.arange(400.0)
    truth = np.column_stack([stamps / 8, np.zeros(400), np.zeros(400)])  # 10 m are 80 poses, exactly
    estimate = se2.compose(np.array([1.0, 2.0, 0.4]), se2.compose(truth, rng.normal(size=(400, 3)) * 0.02))
    theirs = metrics.RPE(
        metrics.PoseRelation.translation_part, delta=80, delta_unit=metrics.Unit.frames, all_pairs=True
    )
    theirs.process_data((as_evo(stamps, truth), as_evo(stamps, estimate)))
    median = theirs.get_statistic(metrics.StatisticsType.median)
    assert drift_per_metre(estimate, truth) == pytest.approx(median / 10.0, abs=1e-9)


def test_drift_per_metre_of_a_scale_error():
    truth = np.column_stack([np.linspace(0, 60, 601), np.zeros(601), np.zeros(601)])
    assert drift_per_metre(truth * [1.05, 1, 1], truth) == pytest.approx(0.05, rel=1e-6)
    assert drift_per_metre(truth[:50], truth[:50]) is None
