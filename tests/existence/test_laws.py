"""Laws of the filter, and the sum over all times of death that it abbreviates (Rosen 2016, eqs. 6-9)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.existence import single
from evermap.existence.one_stay import PersistenceFilter
from evermap.survival import Exponential, GeneralPurpose, LifetimePrior, Uniform, Weibull

from .priors import PRIORS, Stream, streams

every_prior = pytest.mark.parametrize("prior", PRIORS.values(), ids=PRIORS)


def filtered(prior: LifetimePrior, stream: Stream) -> tuple[single.Belief, np.ndarray]:
    state = single.init(1, prior, evidence=True)
    feature = np.zeros(len(stream), dtype=np.int64)
    return state.run(feature, stream.time, stream.detected, stream.p_miss, stream.p_false)


def summed(prior: LifetimePrior, stream: Stream, query: float) -> tuple[float, float]:
    """Belief at `query` and log evidence, one term for each gap in which the feature may have died."""
    survival = np.exp(prior.log_survival(np.append(stream.time, query)))
    edges = np.concatenate([[1.0], survival[:-1], [0.0]])
    there = np.where(stream.detected == 1.0, 1.0 - stream.p_miss, stream.p_miss)
    gone = np.where(stream.detected == 1.0, stream.p_false, 1.0 - stream.p_false)
    n = len(stream)
    joint = [(edges[k] - edges[k + 1]) * np.prod(there[:k]) * np.prod(gone[k:]) for k in range(n + 1)]
    evidence = float(np.sum(joint))
    return float(np.prod(there) * survival[-1] / evidence), float(np.log(evidence))


@every_prior
@given(stream=streams(), ahead=st.floats(0.0, 0.9))
def test_the_filter_is_the_sum_over_all_times_of_death(prior: LifetimePrior, stream: Stream, ahead: float) -> None:
    query = float(stream.time[-1]) + ahead
    belief, evidence = summed(prior, stream, query)
    state, _ = filtered(prior, stream)
    assert state.log_evidence is not None
    assert state.predict(query)[0] == pytest.approx(belief, rel=1e-9, abs=1e-13)
    assert state.log_evidence[0] == pytest.approx(evidence, rel=1e-9, abs=1e-11)


@every_prior
@given(stream=streams(), split=st.integers(0, 12))
def test_splits_and_roads_do_not_matter(prior: LifetimePrior, stream: Stream, split: int) -> None:
    """A stream in one call, in two calls, look by look in a batch, and through the class for one feature."""
    whole, posterior = filtered(prior, stream)
    halves = single.init(1, prior, evidence=True)
    looks, feature = single.init(1, prior, evidence=True), PersistenceFilter(prior)
    for part in (slice(None, split), slice(split, None)):
        columns = (stream.time[part], stream.detected[part], stream.p_miss[part], stream.p_false[part])
        halves, _ = halves.run(np.zeros(len(columns[0]), dtype=np.int64), *columns)
        for time, detected, p_miss, p_false in zip(*columns, strict=True):
            looks = looks.update(time, detected, p_miss, p_false)
            feature.update(float(time), bool(detected), float(p_miss), float(p_false))
    np.testing.assert_array_equal(halves.inverse_odds, whole.inverse_odds)
    np.testing.assert_allclose(looks.inverse_odds, whole.inverse_odds, rtol=1e-11)
    np.testing.assert_allclose(feature.inverse_odds, whole.inverse_odds[0], rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(feature.log_evidence, whole.log_evidence, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(posterior[-1], looks.probability[0], rtol=1e-12)
    ahead = float(stream.time[-1]) + 0.5
    assert feature.predict(ahead) == pytest.approx(looks.predict(ahead)[0], rel=1e-10)


@given(stream=streams(), scale=st.floats(1e-6, 1e6))
@pytest.mark.parametrize(
    "make",
    [
        lambda s: Exponential(0.02 / s),
        lambda s: GeneralPurpose(1e-4 / s, 2.0 / s),
        lambda s: Uniform(80.0 * s),
        lambda s: Weibull(60.0 * s, 1.7),
    ],
)
def test_the_unit_of_time_does_not_matter(make, stream: Stream, scale: float) -> None:
    scaled = Stream(stream.time * scale, stream.detected, stream.p_miss, stream.p_false)
    np.testing.assert_allclose(filtered(make(scale), scaled)[1], filtered(make(1.0), stream)[1], rtol=1e-9, atol=1e-13)


class Later:
    """The lifetime of those that have outlived `age`, counted from then: `S(age + t) / S(age)`."""

    def __init__(self, prior: LifetimePrior, age: float) -> None:
        self.prior, self.age = prior, age

    def log_conditional_survival(self, a, b):
        return self.prior.log_conditional_survival(self.age + np.asarray(a), self.age + np.asarray(b))

    def log_conditional_death(self, a, b):
        return self.prior.log_conditional_death(self.age + np.asarray(a), self.age + np.asarray(b))


@given(stream=streams(), age=st.floats(0.125, 500.0))
@pytest.mark.parametrize("prior", [PRIORS["exponential"], PRIORS["general purpose"], PRIORS["weibull"]])
def test_a_feature_known_to_be_there_starts_anew(prior: LifetimePrior, stream: Stream, age: float) -> None:
    """Certainty at `age` followed by a stream is the stream under the prior of those that reached `age`."""
    known = single.init(1, prior).update(age, 1, 0.5, 0.0)  # no false alarms: a detection is proof
    assert known.inverse_odds[0] == 0.0
    zeros = np.zeros(len(stream), dtype=np.int64)
    _, shifted = known.run(zeros, stream.time + age, stream.detected, stream.p_miss, stream.p_false)
    _, anew = filtered(Later(prior, age), stream)  # type: ignore[arg-type]
    np.testing.assert_allclose(shifted, anew, rtol=1e-9, atol=1e-13)
    if isinstance(prior, Exponential):
        np.testing.assert_allclose(shifted, filtered(prior, stream)[1], rtol=1e-9)


@every_prior
@given(stream=streams())
def test_a_detector_that_answers_at_random_says_nothing(prior: LifetimePrior, stream: Stream) -> None:
    blind = Stream(stream.time, stream.detected, 1.0 - stream.p_false, stream.p_false)
    np.testing.assert_allclose(filtered(prior, blind)[1], np.exp(prior.log_survival(stream.time)), rtol=1e-9)


@given(data=st.data())
def test_grouping_order_and_permutation_of_features(data: st.DataObject) -> None:
    """A shuffled stream over features of different priors is each feature's own stream."""
    priors = tuple(PRIORS.values())
    own = [data.draw(streams(6)) for _ in range(5)]
    index = np.array([data.draw(st.integers(0, len(priors) - 1)) for _ in own])
    feature = np.concatenate([np.full(len(s), k) for k, s in enumerate(own)])
    columns = [np.concatenate([getattr(s, c) for s in own]) for c in ("time", "detected", "p_miss", "p_false")]
    order = data.draw(st.permutations(range(len(feature))))
    order = np.array(sorted(order, key=lambda i: columns[0][i]) if len(set(columns[0])) < len(feature) else order)
    for k in range(len(own)):  # looks of one feature at one time keep their order in any grouping
        mine = order[feature[order] == k]
        order[feature[order] == k] = np.sort(mine)
    state = single.init(5, priors, prior_of_row=index, evidence=True)
    state, posterior = state.run(feature[order], *(c[order] for c in columns))
    for k, stream in enumerate(own):
        alone, expected = filtered(priors[index[k]], stream)
        np.testing.assert_allclose(state.inverse_odds[k], alone.inverse_odds[0], rtol=1e-12)
        np.testing.assert_allclose(state.log_evidence[k], alone.log_evidence[0], rtol=1e-12)  # type: ignore[index]
        np.testing.assert_allclose(posterior[feature[order] == k], expected, rtol=1e-12)


def test_rows_not_looked_at_stay_and_inputs_are_not_touched() -> None:
    before = single.init(3, PRIORS["exponential"]).update(5.0, 1, 0.1, 0.1)
    copy = before.inverse_odds.copy()
    by_index = before.update(7.0, 0, 0.1, 0.1, rows=[2, 0])
    by_mask = before.update([7.0, np.nan, 7.0], [0, np.nan, 0], 0.1, 0.1)
    np.testing.assert_array_equal(by_index.inverse_odds, by_mask.inverse_odds)
    np.testing.assert_array_equal(by_index.stamp_s, [7.0, 5.0, 7.0])
    assert by_index.inverse_odds[1] == before.inverse_odds[1]
    np.testing.assert_array_equal(before.inverse_odds, copy)
    np.testing.assert_array_equal(before.predict(9.0, rows=[1]), before.predict(9.0)[1:2])


def test_doubt_stays_finite_and_certainty_stays_certain() -> None:
    """Ten thousand hits in a row do not make a certainty, and misses still count afterwards."""
    state = single.init(1, Exponential(1e-3))
    state = state.run(np.zeros(10_000, dtype=np.int64), np.full(10_000, 1.0), np.ones(10_000), 0.1, 0.01)[0]
    assert state.inverse_odds[0] == 1e-300
    state = state.run(np.zeros(400, dtype=np.int64), np.full(400, 1.0), np.zeros(400), 0.1, 0.01)[0]
    assert state.probability[0] < 1e-6
    gone = single.init(1, Uniform(10.0)).update(11.0, 1, 0.1, 0.1)
    assert np.isinf(gone.inverse_odds[0])
    assert gone.predict(20.0)[0] == 0.0
    assert gone.predict(11.0)[0] == 0.0
