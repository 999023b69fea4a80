"""What a run says about changes: words, arrows, report and timeline show the same."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from matplotlib.patches import FancyArrowPatch
from synthetic_run import with_changes

from evermap.geometry import se2
from evermap.metrics.summary import compare_with_truth
from evermap.types import Alternative, ChangeKind, Clock, Landmarks, MapChange
from evermap.viz.change_words import describe, describe_all, explanations, near_alternatives, probability
from evermap.viz.map_figure import GROUP_COLOURS, moves
from evermap.viz.report import change_table
from evermap.viz.rerun_scene import write_scene
from evermap.viz.run_figures import draw_figures
from evermap.viz.style import MUTED

NAN = math.nan


@pytest.fixture(scope="module")
def changed(run):
    return with_changes(run[1])


def change(*ids, kind=ChangeKind.MOVED, start=NAN, stop=1000.0, by=(1.0, 0.0), turn=0.0, p=0.99):
    return MapChange(ids, kind, start, stop, by, turn, p)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (change(11, 12, 13), "landmarks 11, 12, 13 moved by (+1.00, 0.00) m before the session"),
        (
            change(4, start=1310.2, stop=1330.4, by=(-0.004, -0.126)),
            "landmark 4 moved by (0.00, -0.13) m between 310 s and 330 s after the start",
        ),
        (
            change(1, 2, kind=ChangeKind.ROTATED, start=1050.0, stop=1050.1, turn=-0.35),
            "landmarks 1, 2 turned by -20.1° and moved by (+1.00, 0.00) m 50 s after the start",
        ),
        (
            change(1, 2, kind=ChangeKind.ROTATED, by=(0.004, 0.0), turn=0.1),
            "landmarks 1, 2 turned by +5.7° in place before the session",
        ),
        (
            change(3, by=(0.0, 0.0, 0.03), turn=math.pi / 2),
            "landmark 3 turned by 90.0° in place before the session",
        ),
        (
            change(3, by=(0.0, 0.0, 0.5), turn=math.pi / 2),
            "landmark 3 turned by 90.0° and moved by (0.00, 0.00, +0.50) m before the session",
        ),
        (change(3, by=(0.2, 0.0, 0.0), turn=0.1), "landmark 3 moved by (+0.20, 0.00, 0.00) m before the session"),
        (change(11, 17, kind=ChangeKind.SWAPPED), "landmarks 11, 17 exchanged their identities before the session"),
        (
            change(*range(40)),
            "landmarks 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11 and 28 more moved by (+1.00, 0.00) m before the session",
        ),
    ],
)
def test_a_change_in_words(found, words):
    assert describe(found, start_s=1000.0) == words


@pytest.mark.parametrize(
    ("value", "words"), [(0.99, "99 %"), (0.9951, "> 99 %"), (1.0, "> 99 %"), (0.5, "50 %"), (0.003, "< 1 %")]
)
def test_a_probability_is_never_certain(value, words):
    assert probability(value) == f"probability {words}"


def test_changes_come_first_and_then_what_else_it_may_be(changed):
    first, second, third, other = explanations(changed)
    assert first.endswith("before the session, probability 97 %")
    assert "between 150 s and 158 s" in second
    assert "exchanged" in third
    assert other.startswith("or: landmarks 12, 15, 18")
    assert other.endswith("probability 12 %")


def test_alternatives_are_told_within_five_nats_of_the_best(run, changed):
    best = min(found.probability for found in changed.changes)
    just, hardly = (dataclasses.replace(changed.alternatives[0], probability=best * math.exp(-n)) for n in (4.9, 5.1))
    assert near_alternatives(dataclasses.replace(changed, alternatives=(just, hardly))) == (just,)
    doubtful = Alternative((change(3, p=0.3),), 0.3, run[1].landmarks)
    unchanged = dataclasses.replace(run[1], alternatives=(doubtful,))
    assert explanations(unchanged)[0] == "most probably nothing moved"
    assert explanations(unchanged)[1].startswith("or: landmark 3 moved")
    assert explanations(run[1]) == []
    assert describe_all((), 0.0) == "nothing moved"


def test_places_before_are_the_displacement_away(run, changed):
    drawn = {move.change.kind: move for move in moves(changed, np.zeros(3)) if not move.alternative}
    position = dict(zip(changed.landmarks.landmark_id.tolist(), changed.landmarks.position_m, strict=True))
    for move in drawn.values():
        np.testing.assert_array_equal(move.after_m, [position[identity] for identity in move.change.landmark_ids])
    moved, turned, swapped = (drawn[kind] for kind in (ChangeKind.MOVED, ChangeKind.ROTATED, ChangeKind.SWAPPED))
    assert moved.after_m - moved.before_m == pytest.approx(np.array([[-1.0, 0.0]] * 3), abs=1e-12)
    again = se2.move_together(turned.before_m, turned.change.displacement_m, turned.change.rotation_rad)
    assert again == pytest.approx(turned.after_m, abs=1e-12)
    np.testing.assert_array_equal(swapped.before_m, swapped.after_m[::-1])
    (other,) = (move for move in moves(changed, np.zeros(3)) if move.alternative)
    assert other.after_m - other.before_m == pytest.approx(np.tile([1.0, 0.0], (11, 1)), abs=1e-12)


def test_what_moved_twice_has_two_arrows_one_after_the_other(run):
    ids = run[1].landmarks.landmark_id[:2].tolist()
    there = change(*ids, stop=10.0, by=(1.0, 0.0))
    back = change(*ids, start=100.0, stop=110.0, by=(0.0, 2.0))
    first, second = moves(dataclasses.replace(run[1], changes=(back, there)), np.zeros(3))
    assert (first.change, second.change) == (there, back)
    np.testing.assert_array_equal(first.after_m, second.before_m)
    assert second.after_m - first.before_m == pytest.approx(np.array([[1.0, 2.0]] * 2), abs=1e-12)


def test_landmarks_that_are_not_in_the_map_have_no_arrow(run):
    known = int(run[1].landmarks.landmark_id[0])
    found = moves(dataclasses.replace(run[1], changes=(change(known, 998), change(999))), np.zeros(3))
    assert [len(move.before_m) for move in found] == [1]


def test_the_map_figure_has_an_arrow_a_landmark_and_a_legend_line_a_change(run, changed):
    recording = run[0]
    evaluation = compare_with_truth(recording, changed)
    figure = next(f for f in draw_figures(recording, changed, evaluation) if f.name == "map")
    axes = figure.figure.axes[0]
    arrows = [patch for patch in axes.patches if isinstance(patch, FancyArrowPatch)]
    assert len(arrows) == 3 + 3 + 2 + 11
    dashed = [arrow for arrow in arrows if arrow.get_linestyle() != "-"]
    assert len(dashed) == 11
    pose = evaluation.poses.pose_truth_estimate
    tips = np.array([arrow._posA_posB[1] for arrow in arrows[:3]])
    assert tips == pytest.approx(se2.transform(pose, changed.landmarks.position_m[:3]), abs=1e-9)
    legend = [text.get_text() for text in figure.figure.legends[1].get_texts()]
    assert legend[0] == "landmarks 3, 6, 9 moved by (-1.00, 0.00) m, probability 97 %"
    assert len(legend) == 4
    assert legend[3].startswith("or: ")
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    ends = np.array([end for arrow in arrows for end in arrow._posA_posB])
    assert np.all((ends > low) & (ends < high))
    assert "diamond" in figure.caption
    plain = next(f for f in draw_figures(*run, compare_with_truth(*run)) if f.name == "map")
    assert len(plain.figure.legends) == 1
    assert "diamond" not in plain.caption


def test_groups_have_colours_of_their_own_and_alternatives_none(changed):
    drawn = moves(changed, np.zeros(3))
    assert tuple(move.colour for move in drawn[:3]) == GROUP_COLOURS
    assert drawn[3].colour == MUTED


def test_the_scene_shows_an_arrow_from_when_the_change_is_over(run, changed, evaluation, tmp_path):
    reader = pytest.importorskip("rerun.chunk")
    path = write_scene(run[0], changed, tmp_path / "scene.rrd", evaluation=evaluation)
    chunks = {chunk.entity_path: chunk.to_record_batch() for chunk in reader.RrdReader(str(path)).stream()
              if chunk.entity_path.startswith("/world/changes/")}  # fmt: skip
    drawn = moves(changed, evaluation.poses.pose_truth_estimate)
    assert len(chunks) == len(drawn) == 4
    for number, move in enumerate(drawn, start=1):
        batch = chunks[f"/world/changes/{number}"]
        (stamp,) = batch.column("stamp_s").cast("int64").to_pylist()
        assert stamp * 1e-9 == pytest.approx(move.change.stamp_to_s)
        origins, vectors = (np.array(batch.column(f"Arrows3D:{name}")[0].as_py()) for name in ("origins", "vectors"))
        assert origins[:, :2] == pytest.approx(move.before_m, abs=1e-5)
        assert (origins + vectors)[:, :2] == pytest.approx(move.after_m, abs=1e-5)


def test_many_changes_share_a_line_of_the_legend_a_kind_and_what_vanished_is_crossed_out(run):
    recording, result = run
    ids = result.landmarks.landmark_id.tolist()
    kinds = [ChangeKind.MOVED] * 6 + [ChangeKind.APPEARED] * 3
    changes = [change(name, kind=kind, by=(1.0, 0.0) if kind is ChangeKind.MOVED else (NAN, NAN))
               for name, kind in zip(ids, kinds, strict=False)]  # fmt: skip
    gone = Landmarks.at([990, 991], [[0.0, 0.0], [1.0, 0.5]])
    changes.append(change(991, kind=ChangeKind.VANISHED, by=(NAN, NAN)))
    many = dataclasses.replace(result, changes=tuple(changes), gone=gone)
    figure = next(f for f in draw_figures(recording, many, compare_with_truth(recording, many)) if f.name == "map")
    axes = figure.figure.axes[0]
    texts = [text.get_text() for text in figure.figure.legends[1].get_texts()]
    assert texts == ["moved, 6 landmarks", "appeared, 3 landmarks", "vanished, 1 landmarks"]
    crosses = {(line.get_alpha(), len(line.get_xdata())) for line in axes.lines if line.get_marker() == "x"}
    assert {(0.8, 2), (None, 1)} <= crosses
    assert "gone: P(exists) below 50 %" in [text.get_text() for text in figure.figure.legends[0].get_texts()]


def test_numbers_of_a_change_are_dates_and_never_nan(run):
    result = run[1]
    dated = dataclasses.replace(result.landmarks, clock=Clock.UNIX)
    seen = change(3, kind=ChangeKind.APPEARED, start=1704277600.0, stop=1704357870.0, by=(NAN, NAN))
    html = change_table(dataclasses.replace(result, landmarks=dated, changes=(seen,)))
    assert "nan" not in html
    assert "1704" not in html
    assert "2024-01-03 10:26:40" in html
    assert "not before (UTC)" in html
