"""Chunks against brute force, rings by their bound, pooling against the truth and rings, figures read back."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.text import Text

from evermap.errors import ConfigError, DataError, NumericalError
from evermap.existence import single
from evermap.survival import Weibull
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.hazard_regression import HazardDraws
from evermap.survival.parametric_fit import fit, log_likelihood
from evermap.types import FloatArray, IntArray
from evermap_studies.lifetimes.pooling import chunks_of, pooled_fit
from evermap_studies.lifetimes.rings import ChunkIndex, ring_query
from evermap_studies.lifetimes.sample_figures import plot_chunks, plot_samples

INF = float("inf")
SIDE_M = 10.0


@given(st.integers(0, 2**31), st.integers(0, 4), st.floats(0.5, 20.0))
def test_rings_hold_what_brute_force_finds(seed: int, radius: int, size_m: float) -> None:
    place = np.random.default_rng(seed).uniform(-30.0, 30.0, (60, 2))
    index = ChunkIndex.of(place, size_m)
    chunk = index.chunk(place[0])
    away = np.abs(np.floor(place / size_m) - np.floor(place[0] / size_m)).max(axis=1)
    np.testing.assert_array_equal(np.sort(index.ring(chunk, radius)), np.flatnonzero(away == radius))
    assert index.farthest(chunk) == away.max()
    assert sum(map(len, index.rows.values())) == 60


@pytest.mark.parametrize(
    ("place", "size_m", "error", "message"),
    [
        ([[1.0, 2.0]], 0.0, ConfigError, "size_m.*positive"),
        ([[1.0, 2.0], [1.0, math.nan]], 1.0, DataError, "place_m.*row 1"),
        ([1.0, 2.0], 1.0, DataError, "place_m.*shape"),
    ],
)
def test_places_that_cannot_be(place: Any, size_m: float, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ChunkIndex.of(place, size_m)


class Town:
    """Two classes in square chunks, some full and some nearly empty, whose hazards vary smoothly and by themselves."""

    shape = np.array([0.8, 1.5])
    scale_s = np.array([2e4, 8e4])

    def __init__(self, seed: int, side: int, samples: float) -> None:
        rng = np.random.default_rng(seed)
        x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
        smooth = np.sin(x / 3 + rng.uniform(0, 6)) + 0.7 * np.cos(y / 2.5 + rng.uniform(0, 6))
        self.log_factor = smooth + rng.normal(0.0, 0.4, (side, side))
        count = rng.poisson(samples * rng.lognormal(0.0, 1.0, (side, side))).ravel()
        corner = np.column_stack([np.repeat(x.ravel(), count), np.repeat(y.ravel(), count)])
        n = len(corner)
        self.class_id: IntArray = rng.integers(0, 2, n)
        self.place_m = SIDE_M * (corner + rng.uniform(0.0, 1.0, (n, 2)))
        shape, scale = self.shape[self.class_id], self.scale_s[self.class_id]
        hazard = np.exp(self.log_factor[corner[:, 0], corner[:, 1]])
        lifetime = scale * (rng.exponential(size=n) / hazard) ** (1.0 / shape)
        visits = np.cumsum(rng.exponential(1e4, (n, 20)), axis=1)
        visits = np.hstack([np.zeros((n, 1)), visits, np.full((n, 1), INF)])
        last, rows = (visits < lifetime[:, None]).sum(axis=1) - 1, np.arange(n)
        self.data = CensoredLifetimes.of(visits[rows, last], visits[rows, last + 1])
        self.held_out = rng.random(n) < 0.3

    def truth(self, x: int, y: int, class_id: int) -> Weibull:
        shape = float(self.shape[class_id])
        return Weibull(float(self.scale_s[class_id] * np.exp(-self.log_factor[x, y] / shape)), shape)

    def score(self, prior_at: Callable[[int, int, int], Any]) -> float:
        """Mean log likelihood of what was held out."""
        cells = np.column_stack([chunks_of(self.place_m, SIDE_M), self.class_id])
        total = 0.0
        for x, y, k in np.unique(cells[self.held_out], axis=0).tolist():
            rows = np.flatnonzero(self.held_out & (cells == (x, y, k)).all(axis=1))
            total += float(log_likelihood(prior_at(x, y, k), self.data[rows]).sum())
        return total / self.held_out.sum()


def middle(x: int, y: int) -> FloatArray:
    return SIDE_M * np.array([x + 0.5, y + 0.5])


def test_a_query_widens_just_as_far_as_its_bound_asks() -> None:
    town = Town(0, 6, 10.0)
    index = ChunkIndex.of(town.place_m, SIDE_M)
    bounds = [0.02, 0.002, 0.0008, 1e-9]
    found = [ring_query(town.data, index, (2, 3), bound) for bound in bounds]
    radii = [one.radius for one in found]
    assert radii == sorted(radii)
    assert radii[0] < radii[-1] == index.farthest((2, 3))
    for bound, one in zip(bounds[:-1], found[:-1], strict=True):
        assert one.variance <= bound
        away = np.abs(chunks_of(town.place_m, SIDE_M) - [2, 3]).max(axis=1)
        np.testing.assert_array_equal(one.rows, np.flatnonzero(away <= one.radius))
        assert one.fitted.loglik == pytest.approx(fit("weibull", town.data[one.rows]).loglik)
        if one.radius:
            closer = fit("weibull", town.data[np.flatnonzero(away < one.radius)])
            assert closer.variance(closer.prior.quantile(0.5)) > bound
    assert found[-1].variance > 1e-9  # all there is, and it says that it is not enough
    assert len(found[-1].rows) == len(town.data.left_s)


def test_variance_of_a_query_is_that_of_its_estimates_over_repetitions() -> None:
    rng = np.random.default_rng(5)
    estimates, variances = [], []
    for _ in range(60):
        lifetime = Weibull(1.0, 1.5).sample(rng, 150)
        data = CensoredLifetimes.of(np.floor(3 * lifetime) / 3, np.ceil(3 * lifetime) / 3)
        one = ring_query(data, ChunkIndex.of(np.zeros((150, 2)), 1.0), (0, 0), 1.0)
        estimates.append(math.exp(one.fitted.prior.log_survival(Weibull(1.0, 1.5).quantile(0.5))))
        variances.append(one.variance)
    # a sample variance of 60 has a relative standard deviation of 0.18
    assert np.var(estimates) == pytest.approx(np.mean(variances), rel=0.5)


def test_queries_that_cannot_be_answered() -> None:
    data = CensoredLifetimes.of([0.0, 0.0], [1.0, 2.0])
    index = ChunkIndex.of([[0.0, 0.0], [1.0, 1.0]], 1.0)
    with pytest.raises(NumericalError):
        ring_query(data, index, (0, 0), 0.01)
    with pytest.raises(ConfigError, match=r"variance_bound"):
        ring_query(data, index, (0, 0), 0.0)


@pytest.fixture(scope="module")
def town() -> Town:
    return Town(1, 6, 14.0)


@pytest.mark.slow
def test_pooling_predicts_better_than_rings_and_than_classes_alone(town: Town) -> None:
    """Mean log likelihood of 30 % held out: the truth -2.142, pooled -2.174, rings at best -2.216, classes -2.282."""
    known = ~town.held_out
    data, place, classes = town.data[known], town.place_m[known], town.class_id[known]
    pooled = pooled_fit(data, place, SIDE_M, classes)
    of_class = [np.flatnonzero(classes == k) for k in (0, 1)]
    indices = [ChunkIndex.of(place[rows], SIDE_M) for rows in of_class]
    alone = [fit("weibull", data[rows]).prior for rows in of_class]

    def by_rings(bound: float) -> float:
        return town.score(
            lambda x, y, k: ring_query(data[of_class[k]], indices[k], (x, y), bound).fitted.prior,
        )

    scores = {
        "truth": town.score(town.truth),
        "pooled": town.score(lambda x, y, k: pooled.at(middle(x, y), k).prior()),
        "rings": max(by_rings(bound) for bound in (0.002, 0.005)),
        "classes": town.score(lambda x, y, k: alone[k]),
    }
    assert scores["truth"] > scores["pooled"] > scores["rings"] > scores["classes"]
    assert scores["truth"] - scores["pooled"] < 0.75 * (scores["truth"] - scores["rings"])


@pytest.mark.slow
def test_bands_of_pooling_cover_the_truth() -> None:
    covered = []
    for seed in range(6):
        town = Town(10 + seed, 6, 14.0)
        pooled = pooled_fit(town.data, town.place_m, SIDE_M, town.class_id)
        for x, y, k in np.ndindex(6, 6, 2):
            truth = town.truth(x, y, k)
            _, lower, upper = pooled.at(middle(x, y), k).survival(truth.quantile([0.25, 0.5, 0.75]))
            covered += ((lower <= [0.75, 0.5, 0.25]) & (upper >= [0.75, 0.5, 0.25])).tolist()
    assert 0.92 <= np.mean(covered) <= 0.99


def test_a_chunk_shrinks_as_far_as_its_data_are_thin() -> None:
    """Exponential stays; one chunk differs from all others, first with many samples and then with few."""
    rng = np.random.default_rng(2)
    corners = np.array([(x, y) for x in range(4) for y in range(4)])
    odd = (1, 1)

    def median(samples: int) -> float:
        count = np.where((corners == odd).all(axis=1), samples, 60)
        corner = np.repeat(corners, count, axis=0)
        mean_s = np.where((corner == odd).all(axis=1), 1000.0, 100.0)
        stays = rng.exponential(mean_s)
        pooled = pooled_fit(CensoredLifetimes.of(stays, stays), SIDE_M * (corner + 0.5), SIDE_M)
        return float(pooled.at(middle(*odd)).prior().quantile(0.5))

    many, few = median(200), median(1)
    assert many == pytest.approx(1000.0 * math.log(2.0), rel=0.25)
    assert few < 300.0


def test_places_without_data_are_told_with_doubt(town: Town) -> None:
    pooled = pooled_fit(town.data, town.place_m, SIDE_M, town.class_id)
    assert pooled.class_ids.tolist() == [0, 1]
    t = 2e4
    width = {}
    for name, place in {"full": middle(*max(ChunkIndex.of(town.place_m, SIDE_M).rows)), "far": [5000.0, 0.0]}.items():
        _, lower, upper = pooled.at(place, 0).survival(t)
        width[name] = upper - lower
    assert width["far"] > 1.5 * width["full"]
    prior = pooled.at(middle(0, 0), 1).prior()
    belief = single.init(1, prior).predict(t)
    assert belief[0] == pytest.approx(math.exp(prior.log_survival(t)))


def test_pooling_refuses_what_does_not_fit() -> None:
    data = CensoredLifetimes.of([1.0, 2.0], [2.0, 3.0])
    with pytest.raises(DataError, match=r"place_m.*3 rows for 2"):
        pooled_fit(data, np.zeros((3, 2)), 1.0)
    with pytest.raises(DataError, match=r"class_id.*1 rows for 2"):
        pooled_fit(data, np.zeros((2, 2)), 1.0, np.zeros(1, dtype=np.int64))
    with pytest.raises(DataError, match=r"larger chunks"):
        pooled_fit(CensoredLifetimes.of(np.ones(400), np.full(400, 2.0)), np.arange(800.0).reshape(-1, 2), 0.1)
    with pytest.raises(DataError, match=r"class 7 was never seen"):
        pooled_fit(data, np.zeros((2, 2)), 1.0).at([0.0, 0.0], 7)


def line(axes: Any, label: str) -> Any:
    return next(item for item in axes.lines if item.get_label() == label)


def texts(figure: Any) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def test_maps_show_medians_and_their_doubt_where_the_chunks_are() -> None:
    rng = np.random.default_rng(2)
    rates = [np.exp(rng.normal(np.log(rate), sigma, (400, 1))) for rate, sigma in ((1e-4, 0.1), (1e-6, 0.5))]
    hazards = [HazardDraws(np.zeros(1), rate) for rate in rates]
    figure: Any = plot_chunks([(0, 0), (-2, 3)], 5.0, hazards, title="cars")
    medians, doubts = (axes.collections[0] for axes in figure.axes[:2])
    np.testing.assert_allclose(medians.get_array(), [np.median(np.log(2.0) / rate) for rate in rates])
    factors = [np.quantile(1 / rate, 0.975) / np.quantile(1 / rate, 0.025) for rate in rates]
    np.testing.assert_allclose(doubts.get_array(), factors)
    corners = [path.get_extents().p0.tolist() for path in medians.get_paths()]
    assert corners == [[0.0, 0.0], [-10.0, 15.0]]
    assert {"cars", "half have gone after", "6 h", "1 day", "1 week"} <= set(texts(figure))
    with pytest.raises(ConfigError, match="hazards"):
        plot_chunks([(0, 0)], 5.0, [])


def test_samples_have_a_row_each() -> None:
    data = CensoredLifetimes.of([60.0, 60.0, 60.0, 0.0], [60.0, 120.0, INF, 90.0], [0.0, 0.0, 30.0, 0.0])
    figure: Any = plot_samples(data, ["exact", "interval", "late", "left"])
    axes: Any = figure.axes[0]
    seen, maybe = axes.containers
    np.testing.assert_allclose([bar.get_x() for bar in seen], [0.0, 0.0, 30.0, 0.0])
    np.testing.assert_allclose([bar.get_width() for bar in seen], [60.0, 60.0, 30.0, 0.0])
    np.testing.assert_allclose([bar.get_width() for bar in maybe][:2], [0.0, 60.0])
    assert line(axes, "the end was watched").get_xdata().tolist() == [60.0]
    assert line(axes, "never seen gone").get_ydata().tolist() == [1]
    with pytest.raises(ConfigError, match="names"):
        plot_samples(data, ["a"])
