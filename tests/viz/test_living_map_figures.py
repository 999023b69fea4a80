"""The figures of `evermap map`: what is drawn is what was given."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, PathCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba

from evermap.errors import InputError
from evermap.types import Clock, Landmarks
from evermap.viz.living_map_figures import MapView, plot_living_map, plot_why
from evermap.viz.style import ALERT, LANDMARK, NO_CLASS, class_looks

HOUR_S = 3600.0
LOOKS = {
    "stamp_s": np.array([0.0, 1.0, 20.0, 21.0]) * HOUR_S,
    "p_exists": np.array([0.9, 0.99999, 0.4, 1e-7]),
    "n_hits": np.array([1, 2, 0, 0]),
    "n_misses": np.array([0, 0, 2, 3]),
    "log_odds": np.array([3.0, 80.0, -4.0, -6.0]),
}
STAYS = np.array([[-np.inf, 0.0, HOUR_S, 20 * HOUR_S], [HOUR_S, 20.5 * HOUR_S, 21 * HOUR_S, np.inf]])
COLUMNS = ("elsewhere_s", "first_s", "last_s", "gone_s")


def why_figure(
    *,
    n_looks: Any = (2, 2),
    stays: Any = STAYS,
    now_s: float = 22 * HOUR_S,
    clock: Clock = Clock.RECORDING,
    **looks: Any,
) -> Any:
    columns = dict(zip(COLUMNS, stays.T, strict=True))
    answer = SimpleNamespace(
        evidence=SimpleNamespace(**(LOOKS | looks)),
        visits=[SimpleNamespace(n_looks=count) for count in n_looks],
        stays=SimpleNamespace(site_id=7 + 2 * np.arange(len(stays)), **columns),
        stamp_s=now_s,
        clock=clock,
        headline="landmark 3",
    )
    return plot_why(answer)


def legend_texts(figure: Any) -> list[str]:
    return [text.get_text().strip("\N{ZERO WIDTH SPACE}") for text in figure.legends[0].get_texts()]


def test_belief_evidence_and_stays_are_those_given() -> None:
    figure = why_figure()
    belief, evidence, stays = figure.axes
    sessions = [line.get_xydata() for line in belief.lines[:2]]
    np.testing.assert_allclose(sessions[0], [[0.0, 0.9], [1.0, 0.999]])
    np.testing.assert_allclose(sessions[1], [[20.0, 0.4], [21.0, 0.001]])
    assert "P(exists), cut at 0.1 % and 99.9 %" in legend_texts(figure)
    bars = [(s, to_hex(c.get_color()[0])) for c in evidence.collections for s in c.get_segments()]
    np.testing.assert_allclose([bar[0][1, 1] for bar in bars], [20.0, -10.0])
    assert [bar[1] for bar in bars] == [LANDMARK, ALERT]
    cut = [line for line in evidence.lines if line.get_marker() == "^" and len(line.get_xydata())]
    np.testing.assert_allclose(cut[0].get_xydata(), [[0.5, 20.0]])
    assert "more than 20 nats" in legend_texts(figure)
    assert [text.get_text() for text in evidence.texts] == ["3 hits, 0 misses", "0 hits, 5 misses"]
    assert [label.get_text() for label in stays.get_yticklabels()] == ["site 1", "site 2"]
    thick = [c.get_segments()[0][:, 0] for c in stays.collections if c.get_linewidth()[0] > 5.0]
    np.testing.assert_allclose(thick, [[0.0, 1.0], [20.5, 21.0]])
    crosses = [line.get_xydata() for line in stays.lines if line.get_marker() == "x" and len(line.get_xydata())]
    np.testing.assert_allclose(crosses, [[[20.0, 0.0]]])


def test_beliefs_are_read_in_percent_on_an_axis_of_log_odds() -> None:
    belief, *_, stays = why_figure().axes
    assert belief.get_yscale() == "logit"
    assert [label.get_text() for label in belief.get_yticklabels()] == ["1 %", "10 %", "50 %", "90 %", "99 %"]
    start = 1.7e9
    dated = why_figure(stamp_s=LOOKS["stamp_s"] + start, stays=STAYS[:0], now_s=start + 22 * HOUR_S, clock=Clock.UNIX)
    assert dated.axes[2].get_xlabel() == "time [UTC]"
    ticks = [text.get_text() for text in dated.axes[2].get_xticklabels() if text.get_text()]
    assert ticks
    assert not any("1.7" in text or "e9" in text for text in ticks)
    plain = why_figure(p_exists=np.array([0.9, 0.99, 0.4, 0.01]))
    assert "P(exists)" in legend_texts(plain)
    assert stays.get_xlabel() == "time [h]"


def test_nothing_to_draw_is_an_error() -> None:
    none = np.zeros(0)
    empty = dict.fromkeys(("stamp_s", "p_exists", "log_odds"), none)
    counts = dict.fromkeys(("n_hits", "n_misses"), none.astype(np.int64))
    with pytest.raises(InputError, match="nothing to draw"):
        why_figure(**empty, **counts, n_looks=(), stays=STAYS[:0], now_s=-np.inf)
    only_stays = why_figure(**empty, **counts, n_looks=())
    assert len(only_stays.axes[2].get_yticklabels()) == 2


def view(**changed: Any) -> MapView:
    """A door there, one gone, a landmark of no class, and a chair that is pinned."""
    landmarks = Landmarks.at([3, 7, 8, 9], [[0.0, 0.0], [4.0, 2.0], [6.0, 3.0], [9.0, 1.0]], sigma_m=[[0.3, 0.1]] * 4)
    landmarks = dataclasses.replace(
        landmarks,
        class_id=np.array([1, 1, -1, 0]),
        class_names=("chair", "door"),
        p_exists=np.array([0.5, 0.2, 1.0, 0.75]),
        names={9: "throne"},
    )
    other = {"other_m": np.array([[1.0, 1.0]]), "other_of": np.array([0])}
    seen = {"seen_from_m": np.array([[2.0, 1.0], [2.5, 1.0]])}
    return MapView(
        **({"landmarks": landmarks, "pinned": np.array([False, False, False, True])} | other | seen | changed)
    )


def test_landmarks_have_the_look_of_their_class_and_fade_with_their_probability() -> None:
    (axes,) = plot_living_map(view(), title="site").axes
    looks = class_looks(("chair", "door"))
    dots = [c for c in axes.collections if isinstance(c, PathCollection)]
    shown = {str(c.get_label()): (c.get_offsets().tolist(), tuple(c.get_facecolor()[0])) for c in dots}
    opacity = {"door": 0.3, "chair": 0.65, "class unknown": 1.0}
    at = {"door": [[0.0, 0.0]], "chair": [[9.0, 1.0]], "class unknown": [[6.0, 3.0]]}
    for name, look in {"door": looks["door"], "chair": looks["chair"], "class unknown": NO_CLASS}.items():
        found, colour = shown[name]
        assert found == at[name]
        assert colour == pytest.approx(to_rgba(look.colour, opacity[name]))


def test_what_is_gone_is_crossed_out_in_the_look_of_its_class() -> None:
    (axes,) = plot_living_map(view(), title="site").axes
    (cross,) = [line for line in axes.lines if line.get_marker() == "x" and len(line.get_xdata())]
    assert cross.get_xydata().tolist() == [[4.0, 2.0]]
    assert cross.get_alpha() < 1.0
    door = class_looks(("chair", "door"))["door"]
    (hollow,) = [line for line in axes.lines if line.get_marker() == door.marker and line.get_mfc() == "none"]
    assert (hollow.get_mec(), hollow.get_xydata().tolist()) == (door.colour, [[4.0, 2.0]])


def test_uncertainty_floor_and_other_places_are_drawn() -> None:
    (axes,) = plot_living_map(view(), title="site").axes
    (ellipses,) = [c for c in axes.collections if isinstance(c, EllipseCollection)]
    assert len(ellipses.get_offsets()) == 3
    assert sorted({round(float(2.0 * half), 6) for half in (*ellipses._widths, *ellipses._heights)}) == [0.4, 1.2]
    (floor,) = [c for c in axes.collections if isinstance(c, PolyCollection)]
    corners = floor.get_paths()[0].get_extents()
    assert (corners.x0, corners.x1, corners.y0, corners.y1) == (1.75, 2.25, 0.75, 1.25)
    lines = [line.get_xydata().tolist() for line in axes.lines]
    assert [[1.0, 1.0], [0.0, 0.0]] in lines
    assert [[9.0, 1.0]] in lines


def test_the_legend_explains_every_mark() -> None:
    assert set(legend_texts(plot_living_map(view(), title="site"))) == {
        "chair", "door", "class unknown", "sensor positions", "2σ of its position",
        "other known place", "gone: P(exists) below 50 %", "pinned",
        "faint: P(exists) from 50 % upwards",
    }  # fmt: skip
    bare = dataclasses.replace(view().landmarks, p_exists=np.ones(4))
    few = plot_living_map(MapView(bare, np.zeros(4, dtype=bool)), title="site")
    assert set(legend_texts(few)) == {
        "chair", "door", "class unknown", "2σ of its position",
        "faint: P(exists) from 50 % upwards",
    }  # fmt: skip


def test_the_legend_fits_the_width_of_the_figure() -> None:
    names = tuple(f"fixture number {k}" for k in range(8))
    many = dataclasses.replace(view().landmarks, class_names=names, class_id=np.array([0, 3, 5, 7]))
    figure: Any = plot_living_map(view(landmarks=many), title="site")
    extent = figure.legends[0].get_window_extent(figure.canvas.get_renderer())
    assert 0.0 <= extent.x0 < extent.x1 <= figure.bbox.x1


def test_landmarks_are_called_by_their_names_and_labels_do_not_overlap() -> None:
    place = np.random.default_rng(1).normal(0.0, 0.3, (30, 2))
    place[0] = 4.0, 0.0  # so that the others crowd
    crowd = Landmarks.at(np.arange(30), place, sigma_m=0.01)
    figure: Any = plot_living_map(MapView(crowd, np.zeros(30, dtype=bool)), title="site")
    renderer = figure.canvas.get_renderer()
    from matplotlib.text import Text

    boxes = [Text.get_window_extent(text, renderer) for text in figure.axes[0].texts]
    assert [text.get_text() for text in figure.axes[0].texts] == [str(k) for k in range(30)]
    overlaps = [(a, b) for a in range(30) for b in range(a) if boxes[a].overlaps(boxes[b])]
    assert overlaps == []
    led = [text.arrow_patch.get_visible() for text in figure.axes[0].texts]
    assert any(led)
    assert not all(led)
    named = plot_living_map(view(), title="site").axes[0]
    assert [text.get_text() for text in named.texts] == ["3", "7", "8", "throne"]


def test_a_street_shows_boxes_as_large_as_they_are_and_a_mark_for_what_would_be_too_small() -> None:
    at = np.array([[0.0, 0.0, 0.5], [30.0, 4.0, 0.5], [300.0, 0.0, 0.5]])
    turned = [0.0, 0.0, np.sin(0.3), np.cos(0.3)]
    street = Landmarks.in_space(
        [1, 2, 3], at, rotation=np.array([turned, turned, turned]), class_id=np.array([0, 0, 1]),
        class_names=("Car", "Pedestrian"),
        size_m=np.array([[4.0, 2.0, 1.5], [4.0, 2.0, 1.5], [0.6, 0.6, 1.8]]),
    )  # fmt: skip
    street = dataclasses.replace(street, p_exists=np.array([1.0, 0.6, 1.0]))
    figure = plot_living_map(MapView(street, np.zeros(3, dtype=np.bool_)), title="street")
    (axes,) = figure.axes
    (drawn,) = [c for c in axes.collections if isinstance(c, PolyCollection)]
    corners = np.array([path.vertices[:4] for path in drawn.get_paths()])
    np.testing.assert_allclose(corners.mean(axis=1), at[:, :2], atol=1e-9)
    np.testing.assert_allclose(sorted(np.linalg.norm(np.diff(corners[0], axis=0), axis=1)), [2.0, 2.0, 4.0])
    np.testing.assert_allclose(drawn.get_facecolor()[:, 3], 0.75 * street.p_exists)
    marks = [c.get_offsets() for c in axes.collections if isinstance(c, PathCollection)]
    np.testing.assert_allclose(np.concatenate(marks), at[2:, :2])
    assert not any(isinstance(c, EllipseCollection) for c in axes.collections)
    assert "box, filled by P(exists)" in legend_texts(figure)


def test_a_map_without_landmarks_is_refused() -> None:
    with pytest.raises(InputError, match="no landmark"):
        plot_living_map(MapView(Landmarks.at([], np.zeros((0, 2))), np.zeros(0, dtype=bool)), title="site")
