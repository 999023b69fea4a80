"""What figures, report and scene show of a run in space, read back from what was drawn."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.patches import FancyArrowPatch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from synthetic_run import LOOKING_AHEAD, make_spatial_run, spatial_trajectory, with_spatial_changes

from evermap.geometry import se3
from evermap.metrics.summary import compare_with_truth, metrics_dict
from evermap.runs.summary import RunInfo, summary_dict, timing_dict
from evermap.types import Landmarks, Up, rows_of
from evermap.viz.change_words import explanations
from evermap.viz.living_map_figures import MapView, plot_living_map
from evermap.viz.map_figure import moves
from evermap.viz.report import render_report
from evermap.viz.rerun_scene import write_scene
from evermap.viz.run_figures import draw_figures


@pytest.fixture(scope="module")
def spatial():
    recording, result = make_spatial_run()
    return recording, with_spatial_changes(result)


@pytest.fixture(scope="module")
def drawn(spatial):
    return {figure.name: figure for figure in draw_figures(*spatial, compare_with_truth(*spatial))}


def line(axes, label):
    return next(line for line in axes.lines if line.get_label().startswith(label))


def aligned(recording, result):
    pose = compare_with_truth(recording, result).poses.pose_truth_estimate
    return pose, se3.transform(pose, result.landmarks.position_m)


def test_the_map_is_drawn_from_above_and_from_the_side_at_one_scale(drawn, spatial):
    assert list(drawn) == ["map", "errors", "consistency", "latency", "calibration"]
    above, side = drawn["map"].figure.axes
    assert (above.get_xlabel(), above.get_ylabel(), side.get_xlabel(), side.get_ylabel()) == (
        "x [m]", "y [m]", "x [m]", "z [m]",
    )  # fmt: skip
    drawn["map"].figure.canvas.draw()  # panels keep their proportions then
    scales = [
        pixels / metres
        for axes in (above, side)
        for pixels, metres in zip(axes.bbox.size, (np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())), strict=True)
    ]
    np.testing.assert_allclose(scales, scales[0], rtol=0.01)
    truth = spatial[0].truth.pose_world_robot
    for axes, view in ((above, [0, 1]), (side, [0, 2])):
        path = np.column_stack(line(axes, "estimated path").get_data())
        assert np.median(np.linalg.norm(path - truth[:, view], axis=1)) < 0.1
        np.testing.assert_array_equal(np.column_stack(line(axes, "true path").get_data()), truth[:, view])


def test_a_narrow_tall_site_is_seen_along_its_shorter_side(spatial):
    recording, result = spatial
    quarter = se3.exp([0, 0, 0, 0, 0, np.pi / 2])
    poses = se3.compose(quarter, recording.truth.pose_world_robot)
    truth = dataclasses.replace(recording.truth, pose_world_robot=poses)
    turned = dataclasses.replace(recording, true_landmarks=None, truth=truth)
    above, side = draw_figures(turned, result, compare_with_truth(turned, result))[0].figure.axes
    assert (side.get_xlabel(), side.get_ylabel()) == ("y [m]", "z [m]")
    assert np.ptp(above.get_xlim()) == pytest.approx(np.ptp(side.get_xlim()))


def test_a_survey_of_much_more_than_was_mapped_may_leave_the_picture(drawn, spatial):
    recording, result = spatial
    survey = recording.true_landmarks
    far = Landmarks.in_space(
        [*survey.landmark_id, 999], np.vstack([survey.position_m, [500.0, 0.0, 0.0]]),
        rotation=np.vstack([survey.rotation, [0.0, 0.0, 0.0, 1.0]]),
    )  # fmt: skip
    larger = dataclasses.replace(recording, true_landmarks=far)
    figure = draw_figures(larger, result, compare_with_truth(larger, result))[0].figure
    assert figure.axes[0].get_xlim() == drawn["map"].figure.axes[0].get_xlim()


def test_ellipses_are_two_sigma_of_what_a_panel_shows(drawn, spatial):
    pose, _ = aligned(*spatial)
    turn = se3.rotation_of(pose)
    covariance = turn @ spatial[1].landmarks.covariance_m2 @ turn.T
    factors = []
    for axes, view in zip(drawn["map"].figure.axes, ([0, 1], [0, 2]), strict=True):
        ellipses = next(item for item in axes.collections if isinstance(item, EllipseCollection))
        sigma = np.sqrt(np.linalg.eigvalsh(covariance[:, view][:, :, view]))
        ratio = np.stack([ellipses._heights, ellipses._widths], axis=1) / (2 * sigma)  # matplotlib keeps half axes
        np.testing.assert_allclose(ratio, ratio[0, 0])
        factors.append(ratio[0, 0])
    assert factors[0] == pytest.approx(factors[1])
    label = line(drawn["map"].figure.axes[0], "2σ").get_label()
    assert label.endswith(f"{factors[0]:.0f} × larger")


def test_ellipses_wider_than_the_panel_are_counted_not_drawn(spatial):
    recording, result = spatial
    covariance = result.landmarks.covariance_m2.copy()
    covariance[:3] *= 1e6
    unsure = dataclasses.replace(result, landmarks=dataclasses.replace(result.landmarks, covariance_m2=covariance))
    above = draw_figures(recording, unsure, compare_with_truth(recording, unsure))[0].figure.axes[0]
    ellipses = next(item for item in above.collections if isinstance(item, EllipseCollection))
    assert len(ellipses._widths) == len(result.landmarks) - 3
    assert line(above, "2σ").get_label().endswith("(3 wider than the panel)")


def test_tags_face_the_path_and_boxes_are_as_large_as_they_are(drawn, spatial):
    landmarks = spatial[1].landmarks
    pose, places = aligned(*spatial)
    boxes = np.flatnonzero(np.isfinite(landmarks.size_m[:, 0]))
    tags = np.flatnonzero(np.isfinite(landmarks.rotation[:, 0]) & np.isnan(landmarks.size_m[:, 0]))
    path = se3.transform(pose, spatial[1].trajectory.pose_world_robot[:, :3])
    for axes, view in zip(drawn["map"].figure.axes, ([0, 1], [0, 2]), strict=True):
        (lines,) = [item for item in axes.collections if isinstance(item, LineCollection)]
        segments = np.array(lines.get_segments())
        edges, normals = segments[: 12 * len(boxes)].reshape(len(boxes), 24, 2), segments[12 * len(boxes) :]
        for row, ends in zip(boxes, edges, strict=True):
            corners = np.stack(np.meshgrid(*([-0.5, 0.5],) * 3), axis=-1).reshape(-1, 3) * landmarks.size_m[row]
            turn = Rotation.from_quat(pose[3:]) * Rotation.from_quat(landmarks.rotation[row])
            expected = ConvexHull((turn.apply(corners) + places[row])[:, view])
            assert ConvexHull(ends).volume == pytest.approx(expected.volume)
        np.testing.assert_allclose(normals[:, 0], places[tags][:, view], atol=1e-9)
        if view == [0, 1]:  # the robot walked within the walls
            assert all((end - start) @ (path[:, :2].mean(axis=0) - start) > 0 for start, end in normals)


def test_arrows_lead_from_where_landmarks_were(drawn, spatial):
    recording, result = spatial
    pose, places = aligned(recording, result)
    turn = se3.rotation_of(pose)
    drawn_moves = moves(result, pose)
    crates = next(move for move in drawn_moves if len(move.change.landmark_ids) == 2)
    rows = np.searchsorted(result.landmarks.landmark_id, crates.change.landmark_ids)
    np.testing.assert_allclose(crates.after_m, places[rows])
    step = turn @ np.array(crates.change.displacement_m)
    np.testing.assert_allclose(crates.before_m, places[rows] - step, atol=1e-12)
    for axes in drawn["map"].figure.axes:
        assert len([patch for patch in axes.patches if isinstance(patch, FancyArrowPatch)]) == 3
    told = explanations(result)
    assert told[0] == "landmark 5 moved by (+0.20, +0.10, +0.90) m before the session, probability 98 %"
    assert "landmarks 85, 90 turned by 28.6° and moved by (+0.70, -0.40, 0.00) m" in told[1]


def test_errors_are_those_of_positions_and_orientations(drawn, spatial):
    poses = compare_with_truth(*spatial).poses
    above, below = drawn["errors"].figure.axes
    np.testing.assert_array_equal(line(above, "smoothed").get_ydata(), poses.position_error_m)
    assert below.get_ylabel() == "orientation error [°]"
    assert below.get_ylim()[0] == 0.0
    shown = max(below.lines[:2], key=lambda one: one.get_linewidth()).get_ydata()
    np.testing.assert_allclose(shown, np.degrees(poses.orientation_error_rad))


def test_the_report_tells_orientations_and_three_coordinates(drawn, spatial):
    recording, result = spatial
    evaluation = compare_with_truth(recording, result)
    info = RunInfo()
    summary = summary_dict(
        recording, result, metrics_dict(evaluation), config={}, info=info, timing=timing_dict(recording, result, info)
    ) | {"outputs": []}
    page = render_report(recording, result, evaluation, summary, list(drawn.values()))
    for text in ("Orientation error", "quaternion x, y, z, w", "Δz [m]", "z [m]", "turned [°]", "umeyama_se3"):
        assert text in page
    assert "Heading error" not in page
    assert "below 6" in page
    assert summary["counts"]["odometry_rows"] == len(recording.odometry)
    assert summary["changes"][0]["displacement_m"] == [0.2, 0.1, 0.9]
    assert summary["changes"][2]["displacement_m"] == [None, None, None]
    assert "axes as at that pose" in summary["frames"]["world"]


@pytest.fixture(scope="module")
def chunks(spatial, tmp_path_factory):
    reader = pytest.importorskip("rerun.chunk")
    path = write_scene(*spatial, tmp_path_factory.mktemp("scene") / "scene.rrd")
    out = {}
    for chunk in reader.RrdReader(str(path)).stream():
        if not chunk.is_static:
            out.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return out


def values(chunks, entity, name):
    found = [
        value for batch in chunks[entity] if name in batch.schema.names for value in batch.column(name).to_pylist()
    ]
    return [np.array(value) for value in found]


def test_the_scene_has_poses_bodies_and_ellipsoids(chunks, spatial):
    recording, result = spatial
    pose, places = aligned(recording, result)
    robot = se3.compose(pose, result.trajectory.pose_world_robot)
    np.testing.assert_allclose(
        np.concatenate(values(chunks, "/world/robot", "Transform3D:translation")), robot[:, :3], atol=1e-5
    )
    np.testing.assert_allclose(
        np.concatenate(values(chunks, "/world/robot", "Transform3D:quaternion")), robot[:, 3:], atol=1e-6
    )
    crate = int(np.flatnonzero(np.isfinite(result.landmarks.size_m[:, 0]))[0])
    entity = f"/world/landmarks/{result.landmarks.landmark_id[crate]}"
    (half,) = values(chunks, f"{entity}/body", "Boxes3D:half_sizes")
    np.testing.assert_allclose(2 * half[0], result.landmarks.size_m[crate], rtol=1e-6)
    (outlines,) = values(chunks, f"{entity}/two_sigma", "LineStrips3D:strips")
    turn = se3.rotation_of(pose)
    covariance = turn @ result.landmarks.covariance_m2[crate] @ turn.T
    away = outlines.reshape(-1, 3) - places[crate]
    np.testing.assert_allclose(np.einsum("ki,ij,kj->k", away, np.linalg.inv(covariance), away), 4.0, rtol=1e-3)


def test_rays_lead_to_what_was_seen_also_where_an_image_has_no_depth(chunks, spatial, tmp_path):
    reader = pytest.importorskip("rerun.chunk")
    recording, result = spatial
    _, places = aligned(recording, result)
    detections = recording.detections
    camera = se3.compose(recording.truth.pose_world_robot, LOOKING_AHEAD)[detections.frame]
    rays = np.concatenate([ray for ray in values(chunks, "/world/detections", "LineStrips3D:strips") if len(ray)])
    assert len(rays) == len(detections)
    assert np.median(np.linalg.norm(rays[:, 0] - camera[:, :3], axis=1)) < 0.1
    seen = se3.transform(camera, detections.position_sensor_m)
    assert np.median(np.linalg.norm(rays[:, 1] - seen, axis=1)) < 0.15

    blank = np.full_like(detections.position_sensor_m, np.nan)
    flat = dataclasses.replace(recording, detections=dataclasses.replace(detections, position_sensor_m=blank))
    path = write_scene(flat, result, tmp_path / "scene.rrd")
    (chunk,) = [
        chunk for chunk in reader.RrdReader(str(path)).stream()
        if chunk.entity_path == "/world/detections" and not chunk.is_static
    ]  # fmt: skip
    rays = [ray for rays in chunk.to_record_batch().column("LineStrips3D:strips").to_pylist() for ray in rays]
    mapped = np.isin(detections.landmark_id, result.landmarks.landmark_id)
    assert len(rays) == mapped.sum()
    rows = np.searchsorted(result.landmarks.landmark_id, detections.landmark_id[mapped])
    np.testing.assert_allclose(np.array(rays)[:, 1], places[rows], atol=1e-5)


def test_objects_plot_themselves_in_space(spatial):
    recording, result = spatial
    assert len(result.trajectory.plot().axes) == 2
    assert len(result.landmarks.plot().axes) == 2
    assert len(result.plot().axes) == len(result.plot(recording).axes) == 2
    assert len(recording.plot().axes) == 4 + 2
    by_hand = dataclasses.replace(
        recording, odometry=None, truth=None,
        detections=dataclasses.replace(
            recording.detections, position_sensor_m=np.full((len(recording.detections), 3), np.nan)
        ),
    )  # fmt: skip
    assert [axes.get_ylabel() for axes in by_hand.plot().axes] == ["column [px]", "landmark"]


def test_no_line_crosses_where_the_robot_could_not_be_located(spatial):
    recording, result = spatial
    kept = np.abs(result.trajectory.stamp_s - 35.0) > 5.0
    lost = dataclasses.replace(result, trajectory=rows_of(result.trajectory, kept))
    above = draw_figures(recording, lost, compare_with_truth(recording, lost))[0].figure.axes[0]
    path = line(above, "estimated path").get_xdata()
    assert np.isnan(path).sum() == 1
    assert np.isnan(path[np.count_nonzero(result.trajectory.stamp_s < 30.0)])


def test_a_map_in_space_shows_other_places_in_both_panels_and_the_floor_from_above(spatial):
    landmarks = dataclasses.replace(spatial[1].landmarks, p_exists=np.linspace(0.3, 1.0, len(spatial[1].landmarks)))
    landmarks = dataclasses.replace(landmarks, up=Up(np.array([0.0, 0.0, 1.0]), 0.02, "imu"))
    view = MapView(
        landmarks, np.zeros(len(landmarks), dtype=bool), other_m=landmarks.position_m[:2] + [3.0, 0.0, 1.0],
        other_of=np.array([0, 1]), seen_from_m=np.array([[0.0, 0.0], [30.0, 0.0]]),
    )  # fmt: skip
    above, side = plot_living_map(view, title="stair").axes
    assert above.get_xlim()[1] > 30.0
    assert (above.get_title(loc="left"), side.get_title(loc="left")) == ("stair, from above", "from the side")
    for axes, columns in ((above, [0, 1]), (side, [0, 2])):
        others = next(one for one in axes.lines if one.get_marker() == "." and len(one.get_xdata()) == 2)
        np.testing.assert_allclose(others.get_xydata(), view.other_m[:, columns])
    floor = [any(isinstance(item, PolyCollection) for item in axes.collections) for axes in (above, side)]
    assert floor == [True, False]


def test_runs_without_odometry_truth_or_landmarks_are_drawn(spatial, tmp_path):
    pytest.importorskip("rerun")
    recording, result = spatial
    nothing = spatial_trajectory(np.zeros(0), np.zeros((0, 7)))
    bare = dataclasses.replace(recording, odometry=None, truth=None, true_landmarks=None)
    by_hand = dataclasses.replace(result, dead_reckoning=nothing, gone=Landmarks.at([], np.zeros((0, 2))))
    figures = draw_figures(bare, by_hand, compare_with_truth(bare, by_hand))
    above = figures[0].figure.axes[0]
    assert not [one for one in above.lines if one.get_label().startswith(("odometry", "true"))]
    write_scene(bare, by_hand, tmp_path / "scene.rrd")
    empty = dataclasses.replace(by_hand, landmarks=by_hand.gone, changes=(), trajectory=nothing, online=nothing)
    empty = dataclasses.replace(empty, step_s=np.zeros(0))
    assert draw_figures(bare, empty, compare_with_truth(bare, empty))
    write_scene(bare, empty, tmp_path / "empty.rrd")
