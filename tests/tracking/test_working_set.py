"""The working set against brute force, and its size."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.survival import Exponential
from evermap.tracking.working_set import Stored, WorkingSet, empty_rows

FOREVER = (Exponential(1e-12),)


def objects(position: np.ndarray, first_id: int = 0, n_appearance: int = 0) -> Stored:
    n = len(position)
    return empty_rows(n, n_appearance)._replace(
        track_id=first_id + np.arange(n), position=position, covariance=np.full((n, 6), 0.01, dtype=np.float32)
    )


@given(
    seed=st.integers(0, 2**32 - 1),
    size_m=st.sampled_from([1.0, 30.0, 1e5]),
    chunk_m=st.sampled_from([0.5, 10.0]),
    rounds=st.integers(1, 6),
)
def test_it_holds_what_was_put_in_and_not_taken_out(seed: int, size_m: float, chunk_m: float, rounds: int) -> None:
    rng = np.random.default_rng(seed)
    kept = WorkingSet(chunk_m, FOREVER, 1, 0)
    truth: dict[int, tuple[int, np.ndarray]] = {}
    next_id = 0
    for _ in range(rounds):
        place = rng.uniform(-size_m, size_m, (int(rng.integers(0, 60)), 3))
        rows = kept.insert_arrays(objects(place, next_id))
        truth |= {int(row): (next_id + k, place[k]) for k, row in enumerate(rows)}
        next_id += len(place)
        gone = rng.choice(np.array(sorted(truth)), int(rng.integers(0, len(truth) + 1)), replace=False) if truth else []
        kept.remove(np.array(gone, dtype=np.int64))
        for row in gone:
            del truth[int(row)]
        assert len(kept) == len(truth)
        assert kept.rows.tolist() == sorted(truth)
        centre, reach = rng.uniform(-size_m, size_m, (3, 3)), rng.uniform(0.0, 1.5 * size_m, 3)
        near = [
            row
            for row in sorted(truth)
            if any(np.linalg.norm(truth[row][1] - c) <= r for c, r in zip(centre, reach, strict=True))
        ]
        assert kept.near(centre, reach).tolist() == near
        assert kept.stored.track_id[near].tolist() == [truth[row][0] for row in near]


def test_a_million_objects_are_small() -> None:
    rng = np.random.default_rng(0)
    n = 1_000_000
    kept = WorkingSet(10.0, FOREVER, 8, 0)
    kept.insert_arrays(objects(rng.uniform(0.0, 1000.0, (n, 3))))
    assert len(kept) == n
    assert sum(column.nbytes for column in kept.stored) / n < 300
    centre = np.array([[500.0, 500.0, 500.0]])
    found = kept.near(centre, np.array([20.0]))
    distance = np.linalg.norm(kept.stored.position[:n] - centre, axis=1)
    assert found.tolist() == np.flatnonzero(distance <= 20.0).tolist()


def test_misses_and_lifetimes_are_the_persistence_filters() -> None:
    from evermap.existence.one_stay import PersistenceFilter

    rate = 0.01
    kept = WorkingSet(10.0, (Exponential(rate),), 1, 0)
    rows = kept.insert_arrays(objects(np.zeros((1, 3))))
    reference = PersistenceFilter(Exponential(rate))
    for stamp, p_detect in ((10.0, 0.5), (60.0, 0.9), (61.0, 0.1)):
        odds = kept.missed(rows, stamp, np.array([p_detect]))
        assert 1.0 / (1.0 + odds[0]) == pytest.approx(reference.update(stamp, False, 1.0 - p_detect, 0.0), rel=1e-12)
    assert 1.0 / (1.0 + kept.inverse_odds(rows, 200.0)[0]) == pytest.approx(reference.predict(200.0), rel=1e-12)
