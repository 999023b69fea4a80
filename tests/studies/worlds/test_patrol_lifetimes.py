"""Months of patrols against the truth that they were drawn from, object by object, and scipy's distributions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from evermap.errors import ConfigError
from evermap_studies.worlds.patrol_lifetimes import DAY_S, PatrolPlace, PatrolRun, PatrolWorld, simulate_patrols

WORLD = PatrolWorld(objects=3000, duration_s=60.0 * DAY_S)


@pytest.fixture(scope="module")
def run() -> PatrolRun:
    return simulate_patrols(WORLD, 0)


def test_same_seed_same_run() -> None:
    small = replace(WORLD, objects=50, p_detect=0.7)
    one, same, other = (simulate_patrols(small, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.first_s, same.first_s)
    assert not np.array_equal(one.lifetime_s, other.lifetime_s)


def test_lifetimes_follow_class_and_place(run: PatrolRun) -> None:
    for c in range(len(WORLD.classes)):
        for p in range(len(WORLD.places)):
            mine = run.lifetime_s[(run.class_id == c) & (run.place_id == p)]
            assert kstest(mine, lambda t, c=c, p=p: 1.0 - WORLD.survival(c, p, t)).pvalue > 1e-4
            shares = np.array([0.1, 0.5, 0.9])
            np.testing.assert_allclose(WORLD.survival(c, p, WORLD.quantile(c, p, shares)), 1.0 - shares, rtol=1e-6)


def test_visits_are_as_rare_and_as_irregular_as_they_should_be() -> None:
    run = simulate_patrols(replace(WORLD, objects=1, duration_s=2000.0 * DAY_S), 3)
    for place, visit in zip(WORLD.places, run.visit_s, strict=True):
        gaps = np.diff(visit)
        assert kstest(gaps, "gamma", (WORLD.gap_shape, 0.0, place.mean_gap_s / WORLD.gap_shape)).pvalue > 1e-3


def test_stays_are_what_somebody_sees_who_goes_there(run: PatrolRun) -> None:
    """Object by object, visit by visit."""
    stay_of = dict(zip(run.object_id.tolist(), range(len(run.object_id)), strict=True))
    assert len(stay_of) == len(run.object_id)  # a detector that never misses makes one stay of each
    for k in range(WORLD.objects):
        there = [
            run.arrival_s[k] <= v <= run.arrival_s[k] + run.lifetime_s[k] for v in run.visit_s[int(run.place_id[k])]
        ]
        assert (k in stay_of) == any(there)
        if not any(there):
            continue
        visit = run.visit_s[int(run.place_id[k])]
        begin, end = there.index(True), len(there) - 1 - there[::-1].index(True)
        stay = stay_of[k]
        assert (run.first_s[stay], run.last_s[stay]) == (visit[begin], visit[end])
        assert run.elsewhere_s[stay] == (visit[begin - 1] if begin else -np.inf)
        assert run.gone_s[stay] == (visit[end + 1] if end + 1 < len(visit) else np.inf)


def test_bounds_hold_the_truth(run: PatrolRun) -> None:
    arrival, end = run.arrival_s[run.object_id], (run.arrival_s + run.lifetime_s)[run.object_id]
    assert ((run.elsewhere_s < arrival) & (arrival <= run.first_s)).all()
    assert ((run.last_s <= end) & (end < run.gone_s)).all()


def test_a_fallible_detector_seldom_splits_a_stay_or_misplaces_its_ends() -> None:
    run = simulate_patrols(replace(WORLD, p_detect=0.9), 4)
    one = np.isin(run.object_id, np.flatnonzero(np.bincount(run.object_id) == 1))
    assert one.mean() > 0.97
    arrival, end = run.arrival_s[run.object_id], (run.arrival_s + run.lifetime_s)[run.object_id]
    right = (run.elsewhere_s < arrival) & (end < run.gone_s)
    assert 0.8 < right.mean() < 1.0  # a miss next to an end moves it by a visit
    ended = np.isfinite(run.gone_s)
    last_visit = np.array([visit[-1] for visit in run.visit_s])[run.place_id[run.object_id]]
    assert (run.gone_s[ended] < last_visit[ended]).all()  # one miss does not say that it is gone


def test_what_cannot_be_is_refused() -> None:
    for make, field in (
        (lambda: PatrolWorld(objects=0), "objects"),
        (lambda: PatrolWorld(p_detect=0.0), "p_detect"),
        (lambda: PatrolWorld(duration_s=-1.0), "duration_s"),
        (lambda: PatrolPlace("x", 1.0, 0.0), "mean_gap_s"),
    ):
        with pytest.raises(ConfigError) as caught:
            make()
        assert caught.value.field == field
