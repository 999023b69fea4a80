"""CLEAR MOT and IDF1 against py-motmetrics, every possible assignment, and cases that are counted by hand."""

from __future__ import annotations

import contextlib
import csv
import io
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.errors import DataError
from evermap.runs.track.write import write_track
from evermap.tracking.detections import read_input
from evermap.tracking.run import run_track
from evermap_studies.lifetimes.tracking_scores import Points, TrackingScores, score_tracks

GATE_M = 1.0

PY_MOTMETRICS = {
    # true, reported, switches, fragmentations, missed, false, MOTP, MOTA, IDF1, IDTP: version 1.4.0, scipy's solver
    0: (659, 626, 57, 109, 143, 110, 0.5763020883749853, 0.5295902883156298, 0.3657587548638132, 235),
    1: (650, 624, 40, 118, 155, 129, 0.5781282370814258, 0.5015384615384615, 0.43328100470957615, 276),
    2: (645, 608, 32, 106, 147, 110, 0.5873702537867277, 0.5519379844961241, 0.47086991221069435, 295),
}


def wild_frames(seed: int) -> tuple[list[Points], list[Points]]:
    """Twelve objects on random walks for sixty frames; tracks are exchanged, begun anew, missed and invented."""
    rng = np.random.default_rng(seed)
    n, n_frames = 12, 60
    walk = np.cumsum(rng.normal(0, 0.4, (n_frames, n, 3)), axis=0) + rng.uniform(0, 8, (n, 3))
    owner = np.arange(n)
    truth, tracks = [], []
    for k in range(n_frames):
        if rng.random() < 0.3:
            i, j = rng.choice(n, 2, replace=False)
            owner[[i, j]] = owner[[j, i]]
        if rng.random() < 0.2:
            owner[rng.integers(n)] = 100 + k
        there = rng.random(n) < 0.9
        seen = there & (rng.random(n) < 0.85)
        false = rng.uniform(0, 8, (rng.poisson(1.0), 3))
        truth.append((np.flatnonzero(there), walk[k, there]))
        ids = np.r_[owner[seen], 1000 + 10 * k + np.arange(len(false))]
        tracks.append((ids, np.vstack([walk[k, seen] + rng.normal(0, 0.4, (seen.sum(), 3)), false])))
    return truth, tracks


def on_a_line(*frames: dict[int, float]) -> list[Points]:
    """Ids and their x."""
    return [
        (np.array(list(f), dtype=int), np.array([[x, 0.0, 0.0] for x in f.values()]).reshape(-1, 3)) for f in frames
    ]


def score(truth: list[Points], tracks: list[Points]) -> TrackingScores:
    return score_tracks(truth, tracks, GATE_M)


@pytest.mark.parametrize("seed", PY_MOTMETRICS)
def test_equals_py_motmetrics(seed: int) -> None:
    s = score(*wild_frames(seed))
    expected = PY_MOTMETRICS[seed]
    counts = (s.n_true, s.n_reported, s.switches, s.fragmentations, s.n_missed, s.n_false)
    assert (*counts, s.n_identified) == (*expected[:6], expected[9])
    np.testing.assert_allclose([s.motp_m, s.mota, s.idf1], expected[6:9], rtol=1e-12)


def by_trackeval(truth: list[Points], tracks: list[Points]) -> tuple[int, int, int, float]:
    """Matched, missed and false positions, and IDF1, by TrackEval; points are similar from half the gate on."""
    quiet = {"THRESHOLD": 0.5, "PRINT_CONFIG": False}
    with contextlib.redirect_stdout(io.StringIO()):  # it warns of what is not built in it
        from trackeval.metrics import CLEAR, Identity
    names: dict[str, Any] = {}
    for kind, points in (("gt", truth), ("tracker", tracks)):
        known, row = np.unique(np.concatenate([ids for ids, _ in points]), return_inverse=True)
        names[f"num_{kind}_ids"], names[f"num_{kind}_dets"] = len(known), len(row)
        names[f"{kind}_ids"] = np.split(row, np.cumsum([len(ids) for ids, _ in points])[:-1])
    gap = [np.linalg.norm(a[:, None] - b[None], axis=2) for (_, a), (_, b) in zip(truth, tracks, strict=True)]
    data = {**names, "similarity_scores": [np.maximum(1.0 - 0.5 * one / GATE_M, 0.0) for one in gap]}
    data["num_timesteps"] = len(truth)
    clear, identity = CLEAR(quiet).eval_sequence(data), Identity(quiet).eval_sequence(data)
    return int(clear["CLR_TP"]), int(clear["CLR_FN"]), int(clear["CLR_FP"]), float(identity["IDF1"])


def test_written_tracks_are_scored_by_trackeval_as_by_us(tmp_path: Path) -> None:
    """From detections to `tracks.csv`, and from there to both."""
    truth, rng = wild_frames(5)[0], np.random.default_rng(1)
    lines = ["stamp_s,x_m,y_m,z_m"]
    for k, (_, position) in enumerate(truth):
        seen = position[rng.random(len(position)) < 0.9] + rng.normal(0.0, 0.05, (1, 3))
        seen = np.vstack([seen, rng.uniform(0, 8, (rng.poisson(0.5), 3))])
        lines += [",".join([f"{0.1 * k:.1f}", *(f"{x:.4f}" for x in row)]) for row in seen]
    (tmp_path / "detections.csv").write_text("\n".join(lines) + "\n")
    write_track(tmp_path / "run", run_track(read_input(tmp_path / "detections.csv")))
    with (tmp_path / "run" / "tracks.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if float(row["p_exists"]) >= 0.5]
    frame = np.array([round(10.0 * float(row["stamp_s"])) for row in rows])
    name = np.array([int(row["track_id"]) for row in rows])
    at = np.array([[float(row[axis]) for axis in ("x_m", "y_m", "z_m")] for row in rows])
    tracks = [(name[frame == k], at[frame == k]) for k in range(len(truth))]
    ours = score(truth, tracks)
    assert ours.n_matched > 0.5 * ours.n_true
    matched, missed, false, idf1 = by_trackeval(truth, tracks)
    assert (ours.n_matched, ours.n_missed, ours.n_false) == (matched, missed, false)
    assert ours.idf1 == pytest.approx(idf1, abs=1e-12)


def test_perfect_tracks() -> None:
    truth, _ = wild_frames(0)
    s = score(truth, [(ids + 7, position) for ids, position in truth])
    assert (s.mota, s.idf1, s.motp_m, s.switches) == (1.0, 1.0, 0.0, 0)


def test_a_switch_by_hand() -> None:
    """Four frames of one object, whose track is another from the third on: one switch, half of the identity."""
    s = score(on_a_line(*[{1: 0.0}] * 4), on_a_line({5: 0.0}, {5: 0.1}, {6: 0.0}, {6: 0.1}))
    assert (s.n_matched, s.switches, s.fragmentations) == (4, 1, 0)
    assert s.mota == pytest.approx(0.75)
    assert s.motp_m == pytest.approx(0.05)
    assert s.idf1 == pytest.approx(0.5)


def test_a_gap_is_a_fragmentation_and_no_switch() -> None:
    s = score(on_a_line(*[{1: 0.0}] * 3), on_a_line({5: 0.0}, {}, {5: 0.0}))
    assert (s.n_missed, s.n_false, s.switches, s.fragmentations) == (1, 0, 0, 1)


def test_an_absence_from_the_world_is_no_fragmentation() -> None:
    s = score(on_a_line({1: 0.0}, {}, {1: 0.0}), on_a_line({5: 0.0}, {}, {5: 0.0}))
    assert (s.mota, s.fragmentations) == (1.0, 0)


def test_an_object_keeps_its_track_though_another_is_nearer() -> None:
    s = score(on_a_line({1: 0.0}, {1: 0.0}), on_a_line({5: 0.0}, {5: 0.9, 6: 0.1}))
    assert (s.switches, s.n_false) == (0, 1)
    assert s.motp_m == pytest.approx(0.45)


def test_as_many_as_possible_are_matched() -> None:
    """The nearest pair first would leave the second object alone."""
    s = score(on_a_line({1: 0.0, 2: 1.0}), on_a_line({5: 0.6, 6: -0.9}))
    assert s.n_matched == 2
    assert s.motp_m == pytest.approx((0.9 + 0.4) / 2)


def test_without_anything() -> None:
    s = score(on_a_line({}), on_a_line({}))
    assert (s.n_true, s.n_reported) == (0, 0)
    assert np.isnan([s.mota, s.motp_m, s.idf1]).all()


positions = st.lists(st.integers(0, 6), min_size=1, max_size=4)


@given(positions, positions)
def test_one_frame_against_every_assignment(objects: list[int], reports: list[int]) -> None:
    there, seen = 0.5 * np.array(objects, dtype=float), 0.5 * np.array(reports, dtype=float) + 0.07
    s = score(on_a_line(dict(enumerate(there))), on_a_line(dict(enumerate(seen))))
    padded = [*range(len(seen)), *[None] * len(there)]
    best = min(
        (-len(d), sum(d))
        for order in permutations(padded, len(there))
        for d in [[abs(there[i] - seen[k]) for i, k in enumerate(order) if k is not None]]
        if all(x <= GATE_M for x in d)
    )
    assert s.n_matched == -best[0]
    assert s.n_matched == 0 or s.motp_m * s.n_matched == pytest.approx(best[1])


@given(st.integers(0, 2**31), st.integers(0, 2**31))
def test_names_and_orders_do_not_matter(seed: int, shuffle: int) -> None:
    truth, tracks = (frames[:8] for frames in wild_frames(seed))
    rng = np.random.default_rng(shuffle)
    name = rng.permutation(5000)
    mixed = []
    for ids, position in tracks:
        order = rng.permutation(len(ids))
        mixed.append((name[ids[order]], position[order]))
    one, other = score(truth, tracks), score(truth, mixed)
    assert one.n_identified == other.n_identified
    assert (one.n_matched, one.switches, one.fragmentations) == (other.n_matched, other.switches, other.fragmentations)
    assert one.motp_m == pytest.approx(other.motp_m, nan_ok=True)


@pytest.mark.parametrize(
    ("truth", "tracks", "problem"),
    [
        (on_a_line({1: 0.0}), [], "0 frames of tracks for 1"),
        ([(np.array([1, 1]), np.zeros((2, 3)))], on_a_line({}), "frame 0: an id twice"),
        (on_a_line({}), [(np.array([1]), np.zeros((1, 2)))], "frame 0: shapes"),
    ],
)
def test_what_cannot_be_compared_is_refused(truth, tracks, problem) -> None:
    with pytest.raises(DataError, match=problem):
        score(truth, tracks)
