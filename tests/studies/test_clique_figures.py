"""Figures and recording of cliques: what they show are the numbers that they were given."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from evermap.errors import MissingExtraError
from evermap.viz.style import ALERT, ESTIMATE, INK, LANDMARK, MUTED, PAPER, house_style, new_figure, settle
from evermap_studies.bateman2020.clique_belief_figure import draw_clique_beliefs, removals
from evermap_studies.bateman2020.clique_recording import belief_colours, log_clique_run
from evermap_studies.bateman2020.clique_scene_figure import DISC_M, FRAMES, discs, draw_clique_scene

STEPS, LANDMARKS = 40, 9


@dataclass
class Scene:
    """A sensor that turns on its way around three objects of three landmarks each."""

    position_m: np.ndarray
    rotation: np.ndarray
    landmark_m: np.ndarray
    normal: np.ndarray
    clique: np.ndarray
    detected: np.ndarray
    outline_m: np.ndarray


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(0)
    angle = np.linspace(0.0, 2.0 * np.pi, STEPS, endpoint=False)
    detected = rng.random((STEPS, LANDMARKS)) < 0.3
    detected[5] = False
    return Scene(
        position_m=np.column_stack([3.0 * np.cos(angle), 2.0 * np.sin(angle), 0.2 * np.sin(3.0 * angle)]),
        rotation=Rotation.from_euler("ZYX", np.column_stack([angle, 0.1 * angle, 0.05 * angle])).as_matrix(),
        landmark_m=rng.uniform(-8.0, 8.0, (LANDMARKS, 3)),
        normal=Rotation.random(LANDMARKS, rng=rng).apply([1.0, 0.0, 0.0]),
        clique=np.repeat(np.arange(3), 3),
        detected=detected,
        outline_m=rng.uniform(0.5, 2.0, (4, 11, 3)),
    )


def axes_of(scene: Scene, step: int):
    with house_style():
        figure = new_figure(6.0, 5.0)
        draw_clique_scene(
            figure,
            scene.position_m,
            scene.rotation,
            scene.landmark_m,
            scene.normal,
            scene.clique,
            step=step,
            detected=scene.detected[step],
            field_outline_m=scene.outline_m,
        )
        settle(figure)
    (axes,) = figure.axes
    return axes


def lines_of(axes, colour):
    """All segments of the line collections of one colour."""
    from matplotlib.colors import to_hex
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    found = [c for c in axes.collections if isinstance(c, Line3DCollection) and to_hex(c.get_colors()[0]) == colour]
    return [np.concatenate([np.asarray(s)[None] for s in c._segments3d]) for c in found if len(c._segments3d)]


def test_scene_shows_the_trajectory_and_rings_what_was_detected(scene):
    for step in (5, 17):
        axes = axes_of(scene, step)
        lines = {line.get_label(): np.array(line.get_data_3d()).T for line in axes.lines}
        np.testing.assert_array_equal(lines["trajectory"], scene.position_m)
        np.testing.assert_array_equal(lines["detected in this step"], scene.landmark_m[scene.detected[step]])
        np.testing.assert_array_equal(lines["sensor, its field cut off"], scene.position_m[[step]])
        rays = lines_of(axes, ALERT)
        if step == 5:
            assert rays == []
        else:
            np.testing.assert_allclose(rays[0][:, 0], np.tile(scene.position_m[step], (len(rays[0]), 1)))
            np.testing.assert_allclose(rays[0][:, 1], scene.landmark_m[scene.detected[step]])


def test_scene_shows_the_field_from_the_sensor_of_the_step(scene):
    axes = axes_of(scene, 17)
    turned = Rotation.from_matrix(scene.rotation[17])
    expected = [turned.apply(line) + scene.position_m[17] for line in scene.outline_m]
    shown = next(lines for lines in lines_of(axes, MUTED) if lines.shape == (4, 11, 3))
    np.testing.assert_allclose(shown, expected)


def test_frames_along_the_path_point_where_the_sensor_looks(scene):
    (forward,) = lines_of(axes_of(scene, 17), INK)
    assert forward.shape == (FRAMES, 2, 3)
    for begin, end in forward:
        row = np.argmin(np.linalg.norm(scene.position_m - begin, axis=1))
        np.testing.assert_allclose(scene.position_m[row], begin)
        ahead = Rotation.from_matrix(scene.rotation[row]).apply([1.0, 0.0, 0.0])
        np.testing.assert_allclose((end - begin) / np.linalg.norm(end - begin), ahead, atol=1e-12)


def test_landmarks_are_filled_where_they_face_the_sensor(scene):
    from matplotlib.colors import to_hex
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    filled, hollow = [], []
    for patches in axes_of(scene, 17).collections:
        if isinstance(patches, Poly3DCollection) and patches.get_zorder() == 4:
            towards = to_hex(patches.get_facecolor()[0]) != PAPER
            (filled if towards else hollow).extend(np.asarray(patches._faces).mean(axis=1))
    expected = {True: [], False: []}
    for point, normal in zip(scene.landmark_m, scene.normal, strict=True):
        expected[bool(np.dot(normal, scene.position_m[17] - point) > 0.0)].append(point)
    assert len(filled) + len(hollow) == LANDMARKS
    for shown, wanted in ((filled, expected[True]), (hollow, expected[False])):
        np.testing.assert_allclose(sorted(map(tuple, shown)), sorted(map(tuple, wanted)), atol=1e-9)


def test_discs_lie_across_their_normals():
    normal = np.concatenate([Rotation.random(20, rng=np.random.default_rng(4)).apply([1.0, 0.0, 0.0]), np.eye(3)])
    centre = np.arange(69.0).reshape(23, 3)
    spokes = discs(centre, normal) - centre[:, None]
    np.testing.assert_allclose(np.linalg.norm(spokes, axis=2), DISC_M)
    np.testing.assert_allclose(np.einsum("kpi,ki->kp", spokes, normal), 0.0, atol=1e-12)
    np.testing.assert_allclose(spokes.mean(axis=1), 0.0, atol=1e-12)


BELIEF = np.array([np.nan, 1.0, 0.95, 0.5, 0.15, 0.1, 0.5, 0.95, 0.3, 0.19, 0.92, 0.9, 0.1, 0.0, 0.0])


def test_removals_by_hand():
    # falls at row 4; 0.1 and 0.5 after it are no way back; back at 7, falls at 9; back at 10, falls at 12
    np.testing.assert_array_equal(removals(BELIEF, rho_high=0.9, rho_low=0.2), [4, 9, 12])
    np.testing.assert_array_equal(removals(np.array([0.1, 0.1]), rho_high=0.9, rho_low=0.2), [0])
    assert len(removals(np.array([0.2, 0.5, 0.2]), rho_high=0.9, rho_low=0.2)) == 0


@given(st.lists(st.floats(0.0, 1.0), max_size=40))
def test_between_two_removals_the_landmark_came_back(values):
    belief = np.array(values)
    at = removals(belief, rho_high=0.9, rho_low=0.2)
    assert np.all(belief[at] < 0.2)
    # cut where it came back: in each piece only the first low value counts
    pieces = np.split(belief, at + 1)
    for k, piece in enumerate(pieces):
        low = np.flatnonzero(piece < 0.2)
        back = np.flatnonzero(piece >= 0.9)
        if k == len(pieces) - 1:
            assert k > 0 or not low.size
            assert not low.size or not back.size or low.max() < back.min()
        elif k > 0:
            assert back.size
            assert back.min() < low.max() == len(piece) - 1


@pytest.fixture(scope="module")
def rows():
    step = np.arange(100, 115)
    in_view = np.ones(15, dtype=bool)
    in_view[[5, 6, 7, 10]] = False
    detected = in_view & (np.arange(15) % 2 == 0)
    with house_style():
        figure = new_figure(7.2, 4.0)
        draw_clique_beliefs(
            figure,
            step,
            {"IFF": BELIEF, "JCFR": np.linspace(1.0, 0.5, 15)},
            survival_step=110.5,
            in_view=in_view,
            detected=detected,
            rho_high=0.9,
            rho_low=0.2,
        )
        settle(figure)
    return figure.axes, step, in_view, detected


def test_each_filter_has_its_row_with_its_belief(rows):
    (first, second, _), step, _, _ = rows
    assert [axes.get_title(loc="left") for axes in (first, second)] == ["IFF", "JCFR"]
    for axes, belief in ((first, BELIEF), (second, np.linspace(1.0, 0.5, 15))):
        curve = next(line for line in axes.lines if line.get_label() == "P(there)")
        np.testing.assert_array_equal(curve.get_xdata(), step)
        np.testing.assert_array_equal(curve.get_ydata(), belief)
        assert curve.get_drawstyle() == "steps-post"


def test_removals_are_told_apart_by_the_true_disappearance(rows):
    (first, second, _), _, _, _ = rows
    shown = {line.get_label(): line.get_xdata().tolist() for line in first.lines if line.get_marker() == "v"}
    assert shown == {"removed too early": [104, 109], "removed rightly": [112]}
    assert all(len(line.get_xdata()) == 0 for line in second.lines if line.get_marker() == "v")


def test_truth_thresholds_and_steps_out_of_view_are_in_every_row(rows):
    axes_of_rows, _, _, _ = rows
    for axes in axes_of_rows:
        (truth,) = (line for line in axes.lines if line.get_label() == "truly gone")
        assert set(truth.get_xdata()) == {110.5}
        spans = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in axes.patches]
        assert spans == [(105.0, 108.0), (110.0, 111.0)]
    for axes in axes_of_rows[:2]:
        levels = {line.get_ydata()[0] for line in axes.lines if line.get_color() == MUTED}
        assert levels == {0.9, 0.2}


def test_looks_are_those_in_view(rows):
    (_, _, last), step, in_view, detected = rows
    hits, misses = (
        next(line for line in last.lines if line.get_color() == colour).get_xdata() for colour in (LANDMARK, ALERT)
    )
    np.testing.assert_array_equal(hits, step[detected])
    assert sorted([*hits, *misses]) == step[in_view].tolist()


def test_colours_of_belief_run_from_gone_to_there():
    shown = belief_colours(np.array([[0.0, 0.5], [1.0, np.nan]]))
    expected = [[ALERT, PAPER], [ESTIMATE, MUTED]]
    np.testing.assert_array_equal(shown, [[list(bytes.fromhex(c[1:])) for c in row] for row in expected])
    quarter = belief_colours(np.array(0.25)).astype(float)
    np.testing.assert_allclose(quarter, (shown[0, 0].astype(float) + shown[0, 1]) / 2.0, atol=0.5)


@pytest.fixture(scope="module")
def recorded(scene, tmp_path_factory):
    reader = pytest.importorskip("rerun.chunk")
    belief = np.column_stack([np.linspace(1.0, 0.0, STEPS), np.linspace(0.0, 1.0, STEPS), np.full(STEPS, 0.7)])
    there = np.ones((STEPS, 3), dtype=bool)
    there[13:, 0] = False
    path = log_clique_run(
        tmp_path_factory.mktemp("cliques") / "run.rrd",
        position_m=scene.position_m,
        rotation=scene.rotation,
        landmark_m=scene.landmark_m,
        clique=scene.clique,
        detected=scene.detected,
        belief=belief,
        there=there,
        field_outline_m=scene.outline_m,
    )
    chunks: dict[str, list] = {}
    for chunk in reader.RrdReader(str(path)).stream():
        chunks.setdefault(chunk.entity_path, []).append(chunk)
    return chunks, belief, there


def column(chunks, entity, name):
    """(steps, values) of one component, in order of time."""
    steps, values = [], []
    for chunk in chunks[entity]:
        batch = chunk.to_record_batch()
        if not chunk.is_static and name in batch.schema.names:
            steps += batch.column("step").to_pylist()
            values += batch.column(name).to_pylist()
    order = np.argsort(steps, kind="stable")
    return np.array(steps)[order], [values[i] for i in order]


def test_recorded_sensor_is_where_it_was(recorded, scene):
    steps, places = column(recorded[0], "/world/sensor", "Transform3D:translation")
    np.testing.assert_array_equal(steps, np.arange(STEPS))
    np.testing.assert_allclose(np.array(places)[:, 0], scene.position_m, atol=1e-6)
    _, matrices = column(recorded[0], "/world/sensor", "Transform3D:mat3x3")  # kept column by column
    kept = np.array(matrices)[:, 0].reshape(STEPS, 3, 3)
    np.testing.assert_allclose(np.swapaxes(kept, 1, 2), scene.rotation, atol=1e-6)


def test_recorded_rays_go_to_what_each_step_detected(recorded, scene):
    steps, rays = column(recorded[0], "/world/detections", "LineStrips3D:strips")
    np.testing.assert_array_equal(steps, np.arange(STEPS))
    for step, strips in zip(steps, rays, strict=True):
        ends = np.array(strips or np.zeros((0, 2, 3)))
        np.testing.assert_allclose(ends[:, 1], scene.landmark_m[scene.detected[step]], atol=1e-6)
        np.testing.assert_allclose(ends[:, 0], np.tile(scene.position_m[step], (len(ends), 1)), atol=1e-6)


def test_recorded_landmarks_have_the_colour_of_their_cliques_belief(recorded, scene):
    chunks, belief, _ = recorded
    _, colours = column(chunks, "/world/landmarks", "Points3D:colors")
    wanted = belief_colours(belief).astype(np.uint32)
    packed = (wanted[..., 0] << 24) | (wanted[..., 1] << 16) | (wanted[..., 2] << 8) | 255
    np.testing.assert_array_equal(np.array(colours), packed[:, scene.clique])


def test_recorded_objects_end_when_they_are_gone(recorded):
    chunks, belief, there = recorded
    steps, _ = column(chunks, "/world/objects/0", "Clear:is_recursive")
    assert steps.tolist() == [13]
    assert column(chunks, "/world/objects/1", "Clear:is_recursive")[0].size == 0
    for c in range(3):
        np.testing.assert_allclose(np.ravel(column(chunks, f"/clique/{c}/belief", "Scalars:scalars")[1]), belief[:, c])
        np.testing.assert_allclose(np.ravel(column(chunks, f"/clique/{c}/truth", "Scalars:scalars")[1]), there[:, c])


def test_missing_rerun_is_said_in_one_line(scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"evermap\[rerun\]"):
        log_clique_run(
            tmp_path / "run.rrd",
            position_m=scene.position_m,
            rotation=scene.rotation,
            landmark_m=scene.landmark_m,
            clique=scene.clique,
            detected=scene.detected,
            belief=np.ones((STEPS, 3)),
            there=np.ones((STEPS, 3), dtype=bool),
            field_outline_m=scene.outline_m,
        )
    assert not (tmp_path / "run.rrd").exists()
