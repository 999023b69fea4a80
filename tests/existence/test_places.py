"""Where objects will be: the chain of places against other algebra and against the truth of a made world."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from evermap.errors import DataError
from evermap.existence.places import AGE_EDGES_S, PlaceChain, PlaceStays
from evermap.types import UNKNOWN

HOUR_S, DAY_S = 3600.0, 86400.0
TO = np.array([[0.0, 0.7, 0.3], [0.5, 0.0, 0.5], [0.9, 0.1, 0.0]])


def chain_of(rates_hz: list[float]) -> PlaceChain:
    """A chain whose hazards depend on the place alone."""
    hazard = np.tile(np.array(rates_hz)[:, None, None], (1, len(AGE_EDGES_S) - 1, 48))
    return PlaceChain(hazard, np.tile(TO, (48, 1, 1)))


def world(seed: int, objects: int, days: float, *, by_day: bool = False, every_s: float = 0.0) -> PlaceStays:
    """PlaceStays of objects at three places with mean stays of 3, 6 and 12 hours, that leave by day only if `by_day`.

    With `every_s`, places are looked at so often, and nobody sees an object leave.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(objects):
        now, place = rng.uniform(0.0, DAY_S), int(rng.integers(3))
        while now < days * DAY_S:
            end = now + rng.exponential((3.0, 6.0, 12.0)[place] * HOUR_S)
            while by_day and (end / HOUR_S) % 24.0 < 12.0:
                end += rng.exponential(12.0 * HOUR_S)
            to = int(rng.choice(3, p=TO[place]))
            begun, until, gone = now, end, end
            if every_s:
                begun, until, gone = np.ceil(now / every_s), np.floor(end / every_s), np.ceil(end / every_s)
                begun, until, gone = begun * every_s, until * every_s, gone * every_s
            if until >= begun:
                over = gone > days * DAY_S
                last = min(until, days * DAY_S)
                rows.append((place, begun, last, np.inf if over else gone, UNKNOWN if over else to))
            now, place = end, to
    place, begun, until, gone, to = map(np.array, zip(*rows, strict=True))
    return PlaceStays(place.astype(int), begun, until, gone, to.astype(int), 3)


def test_forecasts_are_those_of_the_generator() -> None:
    """Constant hazards make a Markov chain, whose future is a matrix exponential."""
    rates = np.array([1.0 / 3.0, 1.0 / 6.0, 1.0 / 12.0]) / HOUR_S
    generator = rates[:, None] * (TO - np.eye(3))
    horizons = np.array([HOUR_S, 5.0 * HOUR_S, 3.0 * DAY_S])
    found = chain_of(list(rates)).forecast([0, 1, 2], [0.0, HOUR_S, 5.0 * DAY_S], 1000.0, horizons)
    for h, horizon in enumerate(horizons):
        np.testing.assert_allclose(found[:, h], expm(horizon * generator), atol=0.01)
    np.testing.assert_allclose(found.sum(axis=2), 1.0, atol=1e-12)


def test_leaving_has_the_density_of_the_hazard() -> None:
    rate = 1.0 / (4.0 * HOUR_S)
    chain = chain_of([rate, rate, rate])
    stays = chain.log_leaving(0, HOUR_S, 0.0, 6.0 * HOUR_S, None)
    assert stays == pytest.approx(-1.5)
    assert chain.log_leaving(0, HOUR_S, 0.0, 6.0 * HOUR_S, 1) == pytest.approx(-1.5 + np.log(600.0 * rate * 0.7))


@pytest.mark.parametrize("every_s", [0.0, 2.0 * HOUR_S])
def test_hazards_and_destinations_are_those_of_the_world(every_s: float) -> None:
    """Seen to leave, or found to have left at looks hours apart."""
    stays = world(1, 60, 14.0, every_s=every_s)
    chain = PlaceChain.learn(stays)
    at = np.searchsorted(AGE_EDGES_S, [HOUR_S, 4.0 * HOUR_S]) - 1
    mean_hz = chain.hazard_hz[:, at].mean(axis=(1, 2))
    np.testing.assert_allclose(1.0 / mean_hz / HOUR_S, [3.0, 6.0, 12.0], rtol=0.15)
    np.testing.assert_allclose(chain.destinations.mean(axis=0), TO, atol=0.06)


def test_objects_that_leave_by_day_stay_overnight() -> None:
    chain = PlaceChain.learn(world(2, 40, 14.0, by_day=True))
    monday = 4.0 * DAY_S + 14.0 * DAY_S
    night = chain.forecast([0], [HOUR_S], monday + HOUR_S, [3.0 * HOUR_S])[0, 0, 0]
    day = chain.forecast([0], [HOUR_S], monday + 13.0 * HOUR_S, [3.0 * HOUR_S])[0, 0, 0]
    assert night > 0.93
    assert day < 0.6


def test_a_place_that_was_seen_little_is_like_the_others() -> None:
    stays = world(3, 40, 10.0)
    n = 4
    some = PlaceStays(
        np.append(stays.place, n), np.append(stays.from_s, 0.0), np.append(stays.until_s, 60.0),
        np.append(stays.gone_s, 60.0), np.append(stays.next_place, 0), n + 1,
    )  # fmt: skip
    hazard = PlaceChain.learn(some).hazard_hz.mean(axis=(1, 2))
    assert hazard[:3].min() < hazard[n] < 3.0 * hazard[:3].max()
    assert hazard[:3].min() < hazard[3] < hazard[:3].max()  # never seen at all


def test_an_unknown_beginning_tells_where_it_went_only() -> None:
    stays = world(4, 30, 10.0)
    left_s = np.linspace(0.0, 8e5, 200)
    lost = PlaceStays(
        np.append(stays.place, [0] * 200), np.append(stays.from_s, [np.nan] * 200), np.append(stays.until_s, left_s),
        np.append(stays.gone_s, left_s), np.append(stays.next_place, [2] * 200), 3,
    )  # fmt: skip
    before, after = PlaceChain.learn(stays), PlaceChain.learn(lost)
    np.testing.assert_allclose(after.hazard_hz, before.hazard_hz, rtol=1e-9)
    assert after.destinations[:, 0, 2].mean() > before.destinations[:, 0, 2].mean() + 0.2


def test_what_cannot_be_learned_from_is_refused() -> None:
    with pytest.raises(DataError, match="no stay"):
        PlaceStays(*(np.zeros(0),) * 4, np.zeros(0, dtype=int), 1)
    with pytest.raises(DataError, match="before it began"):
        PlaceStays(np.array([0]), np.array([5.0]), np.array([1.0]), np.array([2.0]), np.array([0]), 1)
    going_on = PlaceStays(np.array([0]), np.array([0.0]), np.array([9.0]), np.array([np.inf]), np.array([UNKNOWN]), 1)
    with pytest.raises(DataError, match="none ended"):
        PlaceChain.learn(going_on)
