"""The judge of boxes: overlaps by other means, scores worked out by hand; and the peer on a straight line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.ab3dmot import CLASSES, Ab3dmot, generalised_overlap
from benchmarks.kitti_score import Clear, Judged, clear, identities, swept, thresholds
from benchmarks.overlap import overlap
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from benchmarks import kitti
from evermap.errors import InputError

RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "data" / "kitti_tracking"


def halfspaces(box: np.ndarray) -> np.ndarray:
    c, s = np.cos(box[6]), np.sin(box[6])
    axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.array(
        [[*(sign * a), -sign * a @ box[:3] - h / 2] for a, h in zip(axes, box[3:6], strict=True) for sign in (1, -1)]
    )


def volume_by_scipy(a: np.ndarray, b: np.ndarray) -> float:
    """Of what two boxes share: the hull of the corners of all halfspaces, from a point found by linear programming."""
    from scipy.optimize import linprog

    sides = np.vstack([halfspaces(a), halfspaces(b)])
    lengths = np.linalg.norm(sides[:, :3], axis=1)
    found = linprog(
        [0, 0, 0, -1], A_ub=np.c_[sides[:, :3], lengths], b_ub=-sides[:, 3], bounds=[(None, None)] * 3 + [(0, None)]
    )
    if not found.success or found.x[3] < 1e-9:
        return 0.0
    try:
        return float(ConvexHull(HalfspaceIntersection(sides, found.x[:3]).intersections).volume)
    except QhullError:
        return 0.0


number = st.floats(-2.0, 2.0)
size = st.floats(0.3, 4.0)
boxes = st.tuples(number, number, number, size, size, size, st.floats(-7.0, 7.0)).map(np.array)


@settings(max_examples=settings.default.max_examples * 2 // 5)
@given(boxes, boxes)
def test_overlap_is_that_of_halfspaces(a: np.ndarray, b: np.ndarray) -> None:
    shared = volume_by_scipy(a, b)
    both = a[3:6].prod() + b[3:6].prod() - shared
    assert overlap(a[None], b[None])[0, 0] == pytest.approx(shared / both, abs=1e-6)
    assert overlap(b[None], a[None])[0, 0] == pytest.approx(overlap(a[None], b[None])[0, 0], abs=1e-9)


def test_overlap_of_boxes_by_counting_points() -> None:
    rng = np.random.default_rng(0)
    a, b = np.array([0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.3]), np.array([0.5, 0.4, 0.2, 3.0, 2.5, 1.5, -0.9])
    point = rng.uniform(-4.0, 4.0, (400_000, 3))

    def inside(box: np.ndarray) -> np.ndarray:
        sides = halfspaces(box)
        return np.asarray((point @ sides[:, :3].T + sides[:, 3] <= 0.0).all(axis=1))

    counted = (inside(a) & inside(b)).sum() / (inside(a) | inside(b)).sum()
    assert overlap(a[None], b[None])[0, 0] == pytest.approx(counted, abs=0.01)
    assert overlap(a[None], a[None])[0, 0] == pytest.approx(1.0)
    assert generalised_overlap(a[None], a[None])[0, 0] == pytest.approx(1.0)
    assert generalised_overlap(a[None], (a + [9, 0, 0, 0, 0, 0, 0])[None])[0, 0] < 0.0


def one(
    label: list[int], track: list[int], pairs: dict[tuple[int, int], float], counted: list[bool] | None = None
) -> Judged:
    overlaps = np.zeros((len(label), len(track)))
    for (g, t), value in pairs.items():
        overlaps[label.index(g), track.index(t)] = value
    return Judged(
        np.array(label, dtype=np.int64), np.array(counted or [True] * len(label), dtype=np.bool_),
        np.array(track, dtype=np.int64), np.zeros(len(track), dtype=np.bool_), overlaps,
    )  # fmt: skip


SWITCHED = [
    one([1], [7], {(1, 7): 0.8}),
    one([1], [7], {(1, 7): 0.6}),
    one([1], [8], {(1, 8): 0.4}),
    one([1], [8], {(1, 8): 0.2}),
]
"""A label in four frames: track 7 twice, then track 8, at last too far off."""


def test_clear_by_hand() -> None:
    found = clear([SWITCHED], [{7: 5.0, 8: 1.0}], 0.0)
    assert found[:6] == (4, 3, 1, 1, 1, 0)
    assert found.mota == pytest.approx(1.0 - 3.0 / 4.0)
    assert found.motp == pytest.approx((0.8 + 0.6 + 0.4) / 3.0)
    assert clear([SWITCHED], [{7: 5.0, 8: 1.0}], 2.0)[:6] == (4, 2, 2, 0, 0, 0)


def test_what_does_not_count_is_neither_right_nor_wrong() -> None:
    frames = [one([1, 2], [7, 8], {(1, 7): 0.9, (2, 8): 0.9}, counted=[True, False])] * 3
    assert clear([frames], [{7: 1.0, 8: 1.0}], 0.0)[:6] == (3, 3, 0, 0, 0, 0)
    assert identities([frames])["IDF1"] == 1.0
    excused = [frame._replace(overlap=0.0 * frame.overlap, excused=np.array([False, True])) for frame in frames]
    assert clear([excused], [{7: 1.0, 8: 1.0}], 0.0)[:4] == (3, 0, 3, 3)


def test_hota_and_idf1_by_hand() -> None:
    """Of one label and two tracks: up to an overlap of .2 four matches, each track has half of the label."""
    alphas = np.arange(0.05, 0.99, 0.05)
    hota = []
    for alpha in alphas:
        of_7, of_8 = sum(v >= alpha - 1e-9 for v in (0.8, 0.6)), sum(v >= alpha - 1e-9 for v in (0.4, 0.2))
        right = of_7 + of_8
        det = right / (8 - right)
        ass = sum(n * n / (4 + 2 - n) for n in (of_7, of_8)) / max(right, 1)
        hota.append(np.sqrt(det * ass))
    found = identities([SWITCHED])
    assert found["HOTA"] == pytest.approx(np.mean(hota))
    assert found["IDF1"] == pytest.approx(2 * 2 / (2 * 2 + 2 + 2))


def test_recall_is_swept() -> None:
    assert [recall for _, recall in thresholds([1.0] * 40, 40)] == pytest.approx(np.arange(1, 40) / 40)
    perfect = [one([1], [7], {(1, 7): 1.0})] * 80
    found = swept([perfect], [{7: 1.0}])
    assert found["MOTA"] == 1.0
    assert found["sAMOTA"] == pytest.approx(1.0)
    assert Clear(100, 50, 50, 0, 0, 0, 50.0, []).smota(0.5) == 1.0


def test_the_peer_follows_a_car_and_its_flips() -> None:
    peer = Ab3dmot(CLASSES["Car"])
    for k in range(20):
        box = np.array([[0.8 * k, 0.0, 0.0, 4.0, 1.6, 1.5, np.pi * (k % 3 == 0)]])
        ids, found, scores = peer.step(box, np.array([5.0]))
        assert ids.tolist() == [0]
        assert overlap(found, box)[0, 0] > 0.8
        assert scores.tolist() == [5.0]
    assert [len(peer.step(np.empty((0, 7)), np.empty(0))[0]) for _ in range(3)] == [1, 0, 0]


@pytest.mark.data
@pytest.mark.slow
def test_ahead_of_the_peer_in_every_class() -> None:
    if not RECORDINGS.is_dir():
        pytest.skip(f"no recordings in {RECORDINGS}")
    _, shown = kitti.run(RECORDINGS)
    for rows in shown["classes"].values():
        ours, peer = rows["evermap"], rows["AB3DMOT"]
        for key in ("MOTA", "HOTA", "IDF1"):
            assert ours["swept"][key] > peer["swept"][key]
            assert ours["at_once"][key] > peer["at_once"][key]
        assert ours["swept"]["sAMOTA"] > peer["swept"]["sAMOTA"]
        assert ours["swept"]["IDS"] == 0
    assert shown["ms_a_frame"]["evermap"] < 5.0


def test_a_folder_without_sequences_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no sequences"):
        kitti.run(tmp_path)


def test_tables_and_figure_of_a_run_are_written(tmp_path: Path) -> None:
    row = swept([SWITCHED], [{7: 5.0, 8: 1.0}]) | identities([SWITCHED])
    both = {"swept": row, "at_once": row}
    drive = {
        "sequence": "0000", "odometry_m": 2.0, "ours_m": 1.2, "calibrated_m": 0.9, "all_stand_m": 3.0, "as_is_m": 0.1,
        "range_scale": 1.03, "range_scale_sigma": 0.002, "factor": 1.03, "landmarks": 9, "cpu_ms": 4.0,
        "parked_or_moving": {"ranges": [19, 20, 1], "reference": [18, 20, 1]},
    }  # fmt: skip
    shown = {
        "classes": {"Car": {"evermap": both, "AB3DMOT": both}},
        "ms_a_frame": {"evermap": 9.0, "AB3DMOT": 1.0},
        "slam": [drive],
    }
    kitti.write(shown, tmp_path / "out")
    text = (tmp_path / "out" / "table.md").read_text()
    assert "| least lead over AB3DMOT in MOTA, IDF1 and HOTA | ≥ 0 | 0.0000 | yes |" in text
    assert "| CPU time of a frame [ms] | ≤ 5 | 9.00 | **no** |" in text
    assert "| Car | evermap |" in text
    assert (tmp_path / "out" / "kitti.png").stat().st_size > 1000
    assert "| sequences where a worse odometry's error is halved | ≥ 1 | 0 | **no** |" in text
    assert "| the same, with the factor on ranges known | ≥ 1 | 1 | yes |" in text
    assert "| 0000 \\* | 2.00 | 1.20 | 0.90 | 3.00 | 0.10 | 1.0300 ± 0.0020 | 9 | 4.0 |" in text
    assert "95.0 % (19 of 20)" in text
