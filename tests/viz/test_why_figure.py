"""The figures of `evermap map`: what is drawn is what was given."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.errors import InputError
from evermap.viz.living_map_figures import plot_living_map, plot_why
from evermap.viz.style import ALERT, LANDMARK

HOUR_S = 3600.0


def why_figure(**changed):
    content = {
        "stamp_s": np.array([0.0, 1.0, 20.0, 21.0]) * HOUR_S,
        "p_exists": np.array([0.9, 0.99, 0.4, 0.01]),
        "n_hits": np.array([1, 2, 0, 0]),
        "n_misses": np.array([0, 0, 2, 3]),
        "log_odds": np.array([3.0, 8.0, -4.0, -6.0]),
        "session": np.array([1, 1, 2, 2]),
        "stays": [
            ("site 1", -np.inf, 0.0, HOUR_S, 20 * HOUR_S),
            ("site 2", HOUR_S, 20.5 * HOUR_S, 21 * HOUR_S, np.inf),
        ],
        "now_s": 22 * HOUR_S,
        "title": "landmark 3",
    }
    return plot_why(**(content | changed))


def test_belief_evidence_and_stays_are_those_given() -> None:
    belief, evidence, stays = why_figure().axes
    sessions = [line.get_xydata() for line in belief.lines[:2]]
    np.testing.assert_allclose(sessions[0], [[0.0, 0.9], [1.0, 0.99]])
    np.testing.assert_allclose(sessions[1], [[20.0, 0.4], [21.0, 0.01]])
    bars = [(c.get_segments()[0], c.get_color()[0]) for c in evidence.collections]
    np.testing.assert_allclose([bar[0][1, 1] for bar in bars], [11.0, -10.0])
    assert [text.get_text() for text in evidence.texts] == ["3 hits, 0 misses", "0 hits, 5 misses"]
    assert [label.get_text() for label in stays.get_yticklabels()] == ["site 1", "site 2"]
    thick = [c.get_segments()[0][:, 0] for c in stays.collections if c.get_linewidth()[0] > 5.0]
    np.testing.assert_allclose(thick, [[0.0, 1.0], [20.5, 21.0]])
    crosses = [line.get_xydata() for line in stays.lines if line.get_marker() == "x" and len(line.get_xydata())]
    np.testing.assert_allclose(crosses, [[[20.0, 0.0]]])
    from matplotlib.colors import to_rgba

    assert [tuple(bar[1]) for bar in bars] == [to_rgba(LANDMARK), to_rgba(ALERT)]


def test_nothing_to_draw_is_an_error() -> None:
    none = np.zeros(0)
    empty = dict.fromkeys(("stamp_s", "p_exists", "log_odds"), none)
    counts = dict.fromkeys(("n_hits", "n_misses", "session"), none.astype(np.int64))
    with pytest.raises(InputError, match="nothing to draw"):
        why_figure(**empty, **counts, stays=[], now_s=-np.inf)
    only_stays = why_figure(**empty, **counts)
    assert len(only_stays.axes[2].get_yticklabels()) == 2


def map_figure(**changed):
    content = {
        "landmark_id": np.array([3, 7, 8, 9]),
        "place": np.array([0, 2, 3, -1]),
        "p_exists": np.array([0.9, 0.2, 0.8, 0.9]),
        "class_id": np.array([0, 0, -1, 0]),
        "class_names": ("door",),
        "pinned": np.array([False, False, True, False]),
        "deleted": np.zeros(4, dtype=bool),
        "position_m": np.array([[0.0, 0.0], [1.0, 1.0], [4.0, 2.0], [6.0, 3.0]]),
        "place_landmark": np.array([3, 3, 7, 8]),
        "title": "site",
    }
    return plot_living_map(**(content | changed))


def test_the_map_shows_what_is_there_what_is_gone_and_other_places() -> None:
    (axes,) = map_figure().axes
    dots = {c.get_label(): c.get_offsets().tolist() for c in axes.collections}
    assert dots == {"door": [[0.0, 0.0]], "class not known": [[6.0, 3.0]]}
    lines = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert lines["believed gone"] == [[4.0, 2.0]]
    assert lines["other known place"] == [[1.0, 1.0]]
    assert lines["pinned"] == [[6.0, 3.0]]
    assert sorted(text.get_text() for text in axes.texts) == ["3", "7", "8"]


def test_deleted_landmarks_are_left_out() -> None:
    (axes,) = map_figure(deleted=np.array([True, False, False, False])).axes
    assert sorted(text.get_text() for text in axes.texts) == ["7", "8"]
    with pytest.raises(InputError, match="no landmark"):
        map_figure(deleted=np.ones(4, dtype=bool))
