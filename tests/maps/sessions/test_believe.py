"""What is believed over time of what nobody looks at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import LivingConfig
from evermap.maps.lives import DAY_S, EVERYWHERE, Life, Lives
from evermap.maps.living import LivingMap
from evermap.maps.sessions.believe import aged, dynamics_of
from evermap.survival import Exponential, Mixture, never_leaves
from evermap.types import UNKNOWN, FloatArray, Landmarks

STAY_S = 0.8 * DAY_S
STAY = Exponential(1.0 / STAY_S)


def a_map(life: Life, n_sites: int = 1) -> LivingMap:
    """One landmark that was last seen at the first of its sites, at 0 s."""
    living = LivingMap.begun(Landmarks.at(np.array([7]), np.zeros((1, 2)))).from_now_on(0.0)
    at = np.zeros(n_sites, dtype=np.int64)
    sites, places = living.sites[at], living.places[at]
    seen_s = np.where(np.arange(n_sites) == 0, 0.0, -DAY_S)
    sites = replace(sites, site_id=np.arange(n_sites), p_here=1.0 * (seen_s == 0.0), seen_s=seen_s)
    places = replace(places, site_id=np.arange(n_sites), position_m=np.column_stack([np.arange(n_sites), at]))
    lives = Lives(np.array([UNKNOWN]), np.full((1, 2), EVERYWHERE), (life,))
    return replace(living, sites=sites, places=places, covariance_m2=np.eye(2 * n_sites), lives=lives)


def p_known(life: Life, days: FloatArray, n_sites: int = 1, returns: bool = True) -> FloatArray:
    """P(it stands at a known place), by days since it was seen."""
    living, config = a_map(life, n_sites), LivingConfig(returns=returns)
    return np.array([aged(living, config, day * DAY_S).p_here.sum() for day in days.tolist()])


DAYS = np.array([0.25, 1.0, 2.0, 5.0, 20.0])


def test_of_two_positions_the_known_one_is_held_half_of_the_time() -> None:
    """A door of which one position is known: it stays in the other one as long, and then comes back."""
    swings = 0.5 * (1.0 + np.exp(-2.0 * DAYS * DAY_S / STAY_S))
    door = Life(STAY, never_leaves(), p_hop=1.0, p_known=1.0)
    assert p_known(door, DAYS) == pytest.approx(swings, abs=2e-3)
    assert p_known(door, DAYS, n_sites=2) == pytest.approx(np.ones(5), abs=1e-9)


def test_what_is_moved_to_unknown_places_returns_as_often_as_it_is_moved_to_known_ones() -> None:
    """With four places in turn at random, three of which are not known, it is at the known one for 1 / 4."""
    to_known = 1.0 / 3.0  # of the moves from one of the others
    life = Life(STAY, never_leaves(), p_hop=1.0, p_known=to_known)
    at_last = p_known(life, np.array([6.0]))  # eight moves
    assert at_last == pytest.approx(to_known / (1.0 + to_known), abs=0.02)  # a gap has 32 steps


def test_what_never_hops_is_away_for_its_absence() -> None:
    absence = Exponential(1.0 / (3.0 * DAY_S))
    life = Life(STAY, absence, p_hop=0.0, p_known=1.0)
    leave, back = 1.0 / 0.8, 1.0 / 3.0
    expected = (back + leave * np.exp(-(leave + back) * DAYS)) / (leave + back)
    assert p_known(life, DAYS) == pytest.approx(expected, abs=5e-3)
    assert dynamics_of(a_map(life), LivingConfig()).absence == (absence,)


def test_what_may_not_return_is_gone_once_it_left() -> None:
    door = Life(STAY, Exponential(1.0), p_hop=1.0, p_known=1.0)
    assert p_known(door, DAYS, returns=False) == pytest.approx(np.exp(-DAYS * DAY_S / STAY_S), rel=1e-6)


def test_what_vanishes_after_a_move_is_no_more_at_a_place_that_is_not_known() -> None:
    """Of what left, half was moved, and half of that is moved from there; of three sites, those known take their part.

    By hand: p_hop 1/2. One site: all hops lead to unknown places, so of those that are not at it 1/2 stand somewhere,
    and half of these will be moved. Three sites, p_known 3/4: shares 3/8 and 3/16 twice; hops from the newest go to the
    two others with 3/8 / (5/8), to unknown places with 2/5; left 1/5, so 1/5 / (1/5 + 1/2) = 2/7, of which half.
    """
    absence = Exponential(1.0 / DAY_S)
    life = Life(STAY, absence, p_hop=0.5, p_known=0.75)
    for n_sites, p_stands in ((1, 0.25), (3, 1.0 / 7.0)):
        (found,) = dynamics_of(a_map(life, n_sites), LivingConfig()).absence
        assert isinstance(found, Mixture)
        assert found.components == (STAY, absence)
        assert found.weights == pytest.approx((p_stands, 1.0 - p_stands), rel=1e-12)
