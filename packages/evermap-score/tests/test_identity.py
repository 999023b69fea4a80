"""IDF1 and HOTA against other implementations, and brute force."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from evermap_score import Episodes
from evermap_score.identity import ALPHAS, hota_items, make_frames, pair_identities

from .worlds import table, values, world_of


def random_worlds(seed: int, apart_m: float = 3.0) -> tuple[Episodes, Episodes]:
    """Six landmarks over six intervals of a second; the estimate misses some, is off, and swaps names."""
    rng = np.random.default_rng(seed)
    truth, estimate = [], []
    for name in range(6):
        for k in range(6):
            if rng.random() < 0.8:
                x, y = apart_m * (name % 3) + 0.1 * k, apart_m * (name // 3)
                truth.append((f"t{name}", k, k + 1, x, y))
                if rng.random() < 0.8:
                    called = name if rng.random() < 0.7 else (name + 1) % 6
                    estimate.append(
                        (f"e{called}{k if rng.random() < 0.1 else ''}", k, k + 1, x + rng.normal(0, 0.25), y)
                    )
    unique = {(row[0], row[1]): row for row in estimate}
    return table(*truth), table(*unique.values())


@pytest.mark.parametrize("seed", range(4))
def test_idf1_is_that_of_motmetrics(seed: int) -> None:
    motmetrics = pytest.importorskip("motmetrics")
    truth, estimate = random_worlds(seed)
    frames, _, _ = make_frames(world_of(truth, estimate), estimate)
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for frame in frames:
        distance = np.where(frame.similarity >= 0.5, 1.0 - frame.similarity, np.nan)
        accumulator.update(frame.truth.tolist(), frame.estimate.tolist(), distance)
    reference = motmetrics.metrics.create().compute(accumulator, metrics=["idf1"])["idf1"].iloc[0]
    assert values(truth, estimate)["identity/idf1"] == pytest.approx(float(reference))


@pytest.mark.parametrize("apart_m", [0.4, 3.0])
@pytest.mark.parametrize("seed", range(4))
def test_hota_is_that_of_trackeval(seed: int, apart_m: float) -> None:
    """Also where landmarks are so close that who is with whom is decided by the whole time."""
    trackeval = pytest.importorskip("trackeval")
    truth, estimate = random_worlds(seed, apart_m)
    frames, names, of = make_frames(world_of(truth, estimate), estimate)
    reference = trackeval.metrics.HOTA({"PRINT_CONFIG": False}).eval_sequence({
        "num_timesteps": len(frames), "num_gt_ids": len(names), "num_tracker_ids": len(of),
        "num_gt_dets": sum(len(frame.truth) for frame in frames),
        "num_tracker_dets": sum(len(frame.estimate) for frame in frames),
        "gt_ids": [frame.truth for frame in frames], "tracker_ids": [frame.estimate for frame in frames],
        "similarity_scores": [frame.similarity for frame in frames],
    })  # fmt: skip
    found = values(truth, estimate)
    assert found["identity/hota"] == pytest.approx(float(np.mean(reference["HOTA"])))
    assert found["identity/hota_detection"] == pytest.approx(float(np.mean(reference["DetA"])))
    assert found["identity/hota_association"] == pytest.approx(float(np.mean(reference["AssA"])))


def test_idf1_is_the_best_of_all_pairings() -> None:
    truth, estimate = random_worlds(7)
    frames, names, of = make_frames(world_of(truth, estimate), estimate)
    assert len(names) <= len(of)
    n_truth, n_estimate = (sum(len(getattr(frame, side)) for frame in frames) for side in ("truth", "estimate"))

    def agreements(pairs: dict[int, int]) -> int:
        return sum(
            bool(frame.similarity[i, j] >= 0.5)
            for frame in frames
            for i, one in enumerate(frame.truth.tolist())
            for j, other in enumerate(frame.estimate.tolist())
            if pairs.get(one) == other
        )

    common = [(int(i), int(j)) for i in range(len(names)) for j in range(len(of)) if agreements({i: j})]
    choices = [[None, *(j for i, j in common if i == one)] for one in range(len(names))]
    best = max(
        agreements({i: j for i, j in enumerate(chosen) if j is not None})
        for chosen in itertools.product(*choices)
        if len({j for j in chosen if j is not None}) == sum(j is not None for j in chosen)
    )
    assert agreements(pair_identities(frames, len(names), len(of))) == best
    assert values(truth, estimate)["identity/idf1"] == pytest.approx(2 * best / (n_truth + n_estimate))


def test_hota_of_a_name_that_changes_half_way() -> None:
    # one landmark, exactly found in four frames, as 'x' in two of them and as 'y' in two: detection 1; A(c) of each is
    # 2 / (4 + 2 - 2) = .5; HOTA is the root of .5 at every threshold; IDF1 is 2 * 2 / (4 + 4)
    truth = table(*(("a", k, k + 1, 0.2 * k, 0) for k in range(4)))
    estimate = table(*(("x" if k < 2 else "y", k, k + 1, 0.2 * k, 0) for k in range(4)))
    found = values(truth, estimate)
    assert found["identity/hota_detection"] == pytest.approx(1.0)
    assert found["identity/hota_association"] == pytest.approx(0.5)
    assert found["identity/hota"] == pytest.approx(np.sqrt(0.5))
    assert found["identity/idf1"] == pytest.approx(0.5)


def test_rows_that_overlap_by_rounding_are_one_landmark() -> None:
    # .1 * 3 is more than .3: at some boundaries both rows of a landmark hold
    rows = [("a", 0.1 * k - 0.05, 0.1 * k + 0.05, 0.2 * k, 0) for k in range(40)]
    assert any(one[2] > other[1] for one, other in itertools.pairwise(rows))
    truth = table(*rows)
    found = values(truth, truth)
    assert found["identity/idf1"] == found["identity/hota"] == 1.0
    assert len(world_of(truth, truth).instants_s) == 41


def test_hota_counts_a_distance_by_its_similarity() -> None:
    # .25 m is a similarity of .75: a match at 15 of 19 thresholds (.05, ..., .75), a miss and a false one at four
    truth, estimate = table(("a", 0, 1, 0, 0)), table(("a", 0, 1, 0.25, 0))
    frames, names, of = make_frames(world_of(truth, estimate), estimate)
    sums = np.sum([item[2] for item in hota_items(frames, names, of)], axis=0).reshape(4, len(ALPHAS))
    assert sums[0].tolist() == [1.0] * 15 + [0.0] * 4
    assert sums[1].tolist() == sums[2].tolist() == [0.0] * 15 + [1.0] * 4
    assert values(truth, estimate)["identity/hota"] == pytest.approx(15 / 19)
