"""Static spells, and the censored samples that they are, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.config import TrackerConfig
from evermap.survival.censored import lifetimes_of_sightings
from evermap.tracking.record import StaticSpells
from evermap.tracking.tracker import Tracker
from evermap.tracking.views import View

from .observer import look

NOTHING = np.empty((0, 3))
ONE = np.array([[1.0, 2.0, 0.5]])


def test_lifetimes_by_hand() -> None:
    """Four spells: both ends seen; never seen gone; there at first sight; there at first sight and never seen gone."""
    spells = StaticSpells(
        track_id=np.arange(4),
        class_id=np.array([0, 1, 0, 1]),
        position_m=np.zeros((4, 3)),
        elsewhere_s=np.array([90.0, 90.0, -np.inf, -np.inf]),
        first_s=np.full(4, 100.0),
        last_s=np.full(4, 500.0),
        gone_s=np.array([560.0, np.inf, 560.0, np.inf]),
    )
    samples, spell = lifetimes_of_sightings(spells.elsewhere_s, spells.first_s, spells.last_s, spells.gone_s)
    assert set(spell.tolist()) == {0, 1}  # of the others nobody knows when they came
    assert samples.left_s.min() >= 400.0
    assert samples.right_s[spell == 0].max() <= 470.0
    assert (samples.right_s[spell == 1] == np.inf).all()
    np.testing.assert_array_equal(spells[spell].track_id, spell)


def test_one_that_is_there_all_the_time_is_open_at_both_ends() -> None:
    tracker = Tracker()
    look(tracker, 0.0, 50, ONE)
    spells = tracker.static_spells()
    assert (spells.elsewhere_s[0], spells.gone_s[0]) == (-np.inf, np.inf)
    assert spells.first_s[0] == pytest.approx(2.0)  # what has been seen for shorter might not be at rest
    assert spells.last_s[0] == pytest.approx(4.9)
    np.testing.assert_allclose(spells.position_m[0], ONE[0])


def test_one_that_comes_and_goes_in_view_is_an_interval(here: View) -> None:
    """It appears at 5 s, and is missing from 25 s on."""
    tracker = Tracker()
    look(tracker, 0.0, 50, NOTHING, view=here)
    look(tracker, 5.0, 200, ONE, view=here)
    look(tracker, 25.0, 30, NOTHING, view=here)
    spells = tracker.static_spells()
    assert len(spells) == 1
    assert spells.first_s[0] == pytest.approx(7.0, abs=0.11)
    assert spells.last_s[0] == pytest.approx(24.9)
    assert spells.elsewhere_s[0] == pytest.approx(4.7)  # three misses at P_D = 0.9 are one in a thousand
    assert 25.0 < spells.gone_s[0] < 26.5
    seen_s, possible_s = spells.last_s - spells.first_s, spells.gone_s - spells.elsewhere_s
    assert 17.0 < seen_s[0] < 20.0 < possible_s[0] < 22.0


def test_an_absence_from_view_is_part_of_the_spell(here: View, elsewhere: View) -> None:
    tracker = Tracker()
    look(tracker, 0.0, 40, ONE, view=here)
    look(tracker, 4.0, 20, NOTHING, view=elsewhere)
    look(tracker, 9000.0, 40, ONE, view=here)
    spells = tracker.static_spells()
    assert len(spells) == 1
    assert spells.first_s[0] == pytest.approx(2.0)
    assert spells.gone_s[0] == np.inf
    assert spells.last_s[0] == pytest.approx(9003.9)


def test_one_gone_when_its_place_is_visited_again(here: View, elsewhere: View) -> None:
    tracker = Tracker()
    look(tracker, 0.0, 40, ONE, view=here)
    look(tracker, 4.0, 20, NOTHING, view=elsewhere)
    for k in range(12):
        tracker.step(9000.0 + k, NOTHING, view=here)
    spells = tracker.static_spells()
    assert len(spells) == 1
    assert spells.last_s[0] == pytest.approx(3.9)
    assert 9000.0 <= spells.gone_s[0] <= 9011.0


def test_one_that_came_while_nobody_looked(here: View, elsewhere: View) -> None:
    tracker = Tracker()
    look(tracker, 0.0, 40, NOTHING, view=here)
    for k in range(100):
        tracker.step(10.0 + k, NOTHING, view=elsewhere)
    look(tracker, 9000.0, 40, ONE, view=here)
    spells = tracker.static_spells()
    assert 0.0 <= spells.elsewhere_s[0] < 4.0
    assert spells.first_s[0] == pytest.approx(9002.0, abs=0.11)


def test_a_parked_one_that_drives_off_ends_its_spell_and_starts_another() -> None:
    """Parked until 20 s, 4 m in 4 s with no more than 1 m/s^2, parked again from 24 s on."""
    rng = np.random.default_rng(0)
    tracker = Tracker(TrackerConfig(sigma_position_m=0.1))
    for k in range(600):
        stamp = 0.1 * k
        driven = np.clip(stamp - 20.0, 0.0, 4.0)
        x = 0.5 * driven**2 if driven < 2.0 else 4.0 - 0.5 * (4.0 - driven) ** 2
        tracker.step(stamp, ONE + [x, 0.0, 0.0] + rng.normal(0.0, 0.1, 3))
    spells = tracker.static_spells()
    assert spells.track_id.tolist() == [0, 0]
    assert 16.0 <= spells.last_s[0] - spells.first_s[0] <= 20.0 < spells.gone_s[0] <= 22.0
    assert 20.0 <= spells.elsewhere_s[1] <= 24.0 <= spells.first_s[1] <= 27.0
    assert spells.gone_s[1] == np.inf
    np.testing.assert_allclose(spells.position_m, ONE + [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]], atol=0.3)


def test_noise_does_not_end_a_spell() -> None:
    """A hundred objects at rest for a minute: nearly all spells are whole."""
    rng = np.random.default_rng(1)
    place = np.stack(np.meshgrid(np.arange(10), np.arange(10), [0.0], indexing="ij"), axis=-1).reshape(-1, 3) * 10.0
    tracker = Tracker()
    for k in range(600):
        seen = rng.random(100) < 0.9
        tracker.step(0.1 * k, (place + rng.normal(0.0, 0.3, place.shape))[seen])
    spells = tracker.static_spells()
    assert np.isinf(spells.gone_s).mean() >= 0.99
    assert tracker.followed().static.mean() >= 0.99


def test_a_slow_drift_is_no_rest() -> None:
    """At 0.3 m/s no instant's velocity is above the threshold, but it does not stay where it is."""
    rng = np.random.default_rng(2)
    tracker = Tracker(TrackerConfig(sigma_position_m=0.1))
    for k in range(600):
        tracker.step(0.1 * k, ONE + [0.03 * k, 0.0, 0.0] + rng.normal(0.0, 0.1, 3))
    spells = tracker.static_spells()
    lengths = spells.last_s - spells.first_s
    assert lengths.max(initial=0.0) < 6.0
