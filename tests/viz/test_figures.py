"""What the figures show, read back from the drawn artists."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection
from matplotlib.text import Text

from evermap.metrics.summary import compare_with_truth
from evermap.types import Innovations, Landmarks, Trajectory
from evermap.viz.run_figures import blind_stretches, draw_figures, quantity
from evermap.viz.style import ROLES, inline_svg, save_png, save_svg


def by_name(figures, name):
    return next(figure.figure for figure in figures if figure.name == name)


def line(axes, label):
    return next(line for line in axes.lines if line.get_label().startswith(label))


def test_all_figures_are_drawn_with_titles_and_captions(figures):
    assert [figure.name for figure in figures] == ["map", "errors", "consistency", "latency", "calibration"]
    assert all(figure.title and figure.caption.endswith(".") for figure in figures)


def test_text_is_legible_and_axes_carry_units(figures):
    for named in figures:
        sizes = [text.get_fontsize() for text in named.figure.findobj(Text) if text.get_text()]
        assert min(sizes) >= 8, named.name
        for axes in named.figure.axes:
            labels = [label for label in (axes.get_xlabel(), axes.get_ylabel()) if label]
            assert all(label.endswith("]") for label in labels), labels


def test_map_lays_the_estimate_on_the_truth(figures, run):
    axes = by_name(figures, "map").axes[0]
    assert axes.get_aspect() == 1.0
    estimated = np.column_stack(line(axes, "estimated path").get_data())
    truth = np.column_stack(line(axes, "true path").get_data())
    distance = np.min(np.linalg.norm(estimated[::40, None] - truth[None], axis=2), axis=1)
    assert np.median(distance) < 0.06
    (low_x, high_x), (low_y, high_y) = axes.get_xlim(), axes.get_ylim()
    surveyed = run[0].true_landmarks.position_m
    assert np.all((surveyed > [low_x, low_y]) & (surveyed < [high_x, high_y]))


def test_odometry_that_runs_away_does_not_shrink_the_map(run):
    recording, result = run
    wild = result.dead_reckoning.pose_world_robot * [50.0, 50.0, 1.0]
    far = dataclasses.replace(result, dead_reckoning=dataclasses.replace(result.dead_reckoning, pose_world_robot=wild))
    drawn = draw_figures(recording, far, compare_with_truth(recording, far))
    axes = by_name(drawn, "map").axes[0]
    assert np.ptp(axes.get_xlim()) < 25
    assert line(axes, "odometry alone").get_label().endswith("(leaves the figure)")


def test_ellipses_are_two_sigma_times_the_stated_factor(figures, run, evaluation):
    figure = by_name(figures, "map")
    axes = figure.axes[0]
    ellipses = next(item for item in axes.collections if isinstance(item, EllipseCollection))
    label = next(handle.get_label() for handle in axes.lines if handle.get_label().startswith("2σ"))
    factor = float(label.split("drawn ")[1].split()[0]) if "drawn" in label else 1.0
    sigma = np.sqrt(np.linalg.eigvalsh(run[1].landmarks.covariance_m2))
    np.testing.assert_allclose(2 * ellipses._widths, 4 * factor * sigma[:, 1])  # matplotlib keeps half axes
    np.testing.assert_allclose(2 * ellipses._heights, 4 * factor * sigma[:, 0])


def test_ellipse_points_along_the_larger_axis_after_the_alignment(run):
    recording, result = run
    landmarks = Landmarks.at([3], [[1.0, 0.0]], frame="first_pose")
    covariance = np.array([[[0.09, 0.0], [0.0, 0.0001]]])  # long along the map's x axis
    landmarks = dataclasses.replace(landmarks, covariance_m2=covariance, n_hits=np.array([20]))
    single = dataclasses.replace(result, landmarks=landmarks)
    evaluation = compare_with_truth(recording, single)
    axes = by_name(draw_figures(recording, single, evaluation), "map").axes[0]
    ellipses = next(item for item in axes.collections if isinstance(item, EllipseCollection))
    turn = np.degrees(evaluation.poses.pose_truth_estimate[2])
    assert np.degrees(ellipses._angles[0]) % 180 == pytest.approx(turn % 180, abs=1e-6)


def test_error_figure_shows_the_errors_and_shades_the_blind_stretch(figures, run, evaluation):
    above, below = by_name(figures, "errors").axes
    np.testing.assert_array_equal(line(above, "smoothed").get_ydata(), evaluation.poses.position_error_m)
    (blind,) = blind_stretches(run[0].frames.stamp_s)
    assert blind == pytest.approx([100.0, 130.0], abs=0.3)
    shaded = next(patch for patch in below.patches if patch.get_x() > 50)
    assert shaded.get_width() == pytest.approx(blind[1] - blind[0])


def test_no_gap_is_no_blind_stretch():
    assert blind_stretches(np.arange(0.0, 9.0)).shape == (0, 2)
    assert blind_stretches(np.zeros(0)).shape == (0, 2)


def test_nis_histogram_has_the_density_of_the_draws(figures):
    right = by_name(figures, "consistency").axes[1]
    steps = next(patch for patch in right.patches if patch.get_label() == "detections")
    values, edges, _ = steps.get_data()
    assert np.sum(values * np.diff(edges)) == pytest.approx(1.0, abs=0.01)
    assert values[0] == pytest.approx(0.5 * np.exp(-0.125), rel=0.2)


@pytest.mark.parametrize(
    ("value", "sigma", "unit", "text"),
    [
        (0.21037, 0.00381, "s", "0.2104 ± 0.0038 s"),
        (-0.4951, 0.0123, "1/rad^2", "−0.495 ± 0.012 1/rad²"),
        (1.5, 0.0, "1", "1.5"),
        (123.4, 25.0, "m", "123 ± 25 m"),
        (0.9, float("nan"), "m", "0.9 m"),
    ],
)
def test_quantities_get_two_digits_of_uncertainty(value, sigma, unit, text):
    assert quantity(value, sigma, unit) == text


def test_runs_with_little_to_show_still_draw(run):
    recording, result = run
    empty, none = np.zeros(0), np.zeros(0, dtype=np.int64)
    bare = dataclasses.replace(recording, truth=None, true_landmarks=None)
    nothing = dataclasses.replace(
        result,
        landmarks=Landmarks.at([], np.zeros((0, 2))),
        innovations=Innovations(empty, none, none, empty, empty),
        parameters=(),
        online=Trajectory(empty, np.zeros((0, 3)), np.zeros((0, 3, 3))),
        step_s=empty,
    )
    drawn = draw_figures(bare, nothing, compare_with_truth(bare, nothing))
    assert [figure.name for figure in drawn] == ["map", "errors"]
    alone = dataclasses.replace(recording, truth=None)
    assert len(draw_figures(alone, result, compare_with_truth(alone, result))) == 5


def test_files_are_reproducible_and_svg_is_themed(figures, tmp_path):
    for name, save in (("a.png", save_png), ("a.svg", save_svg)):
        save(figures[1].figure, tmp_path / name)
        save(figures[1].figure, tmp_path / f"again-{name}")
        assert (tmp_path / name).read_bytes() == (tmp_path / f"again-{name}").read_bytes()
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    inline = inline_svg(figures[1].figure, "errors")
    assert "var(--estimate)" in inline
    assert "http" not in inline
    assert not any(colour in inline for colour in ROLES)


def test_drawing_never_loads_pyplot_or_changes_the_settings():
    code = (
        "import sys, matplotlib as mpl; before = mpl.rcParams.copy()\n"
        f"sys.path.insert(0, {str(Path(__file__).parents[1] / 'metrics')!r})\n"
        "from synthetic_run import make_run\n"
        "from evermap.metrics.summary import compare_with_truth\n"
        "from evermap.viz.run_figures import draw_figures\n"
        "run = make_run(duration_s=60.0)\n"
        "draw_figures(*run, compare_with_truth(*run))\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
        "assert dict.__eq__(before, mpl.rcParams.copy())  # not by item: asking for the backend loads one\n"
    )
    source = str(Path(__file__).parents[2] / "src")
    done = subprocess.run([sys.executable, "-c", code], check=False, env={"PYTHONPATH": source}, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
