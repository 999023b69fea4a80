"""What is refused, in which words."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.errors import ConfigError, DataError, EvermapError, InputError, NumericalError
from evermap.existence import single
from evermap.existence.batch import Looked
from evermap.existence.one_stay import PersistenceFilter
from evermap.survival import Exponential, Uniform

from .rows import look_exponential, look_general_purpose

STATE = single.init(3, Exponential(0.1)).update(5.0, 1, 0.1, 0.1)
BAD = {
    "miss above one": (6.0, 1, 1.5, 0.1, InputError, "'p_miss': row 1: 1.5 is not a probability"),
    "negative false": (6.0, 1, 0.1, -0.1, InputError, "'p_false': row 1: -0.1 is not a probability"),
    "nan": (6.0, 1, np.nan, 0.1, InputError, "'p_miss': row 1: nan is not a probability"),
    "back in time": (4.0, 1, 0.1, 0.1, InputError, "row 1: time 4.0 s lies before its last observation at 5.0 s"),
    "infinite time": (np.inf, 1, 0.1, 0.1, InputError, "row 1: time inf is not finite"),
    "impossible": (6.0, 1, 1.0, 0.0, NumericalError, "row 1.*impossible"),
}
bad = pytest.mark.parametrize(("time", "detected", "p_miss", "p_false", "kind", "words"), BAD.values(), ids=BAD)


@bad
def test_update_names_the_row(time, detected, p_miss, p_false, kind: type[EvermapError], words: str) -> None:
    column = [
        np.array([good, wrong, good]) for good, wrong in ((6.0, time), (1, detected), (0.1, p_miss), (0.1, p_false))
    ]
    with pytest.raises(kind, match=words):
        STATE.update(*column)
    with pytest.raises(kind, match=words):
        STATE.update(time, detected, p_miss, p_false, rows=[1])


@bad
def test_kernels_name_the_row(time, detected, p_miss, p_false, kind: type[EvermapError], words: str) -> None:
    column = [
        np.array([good, wrong, good])
        for good, wrong in ((6.0, time), (True, bool(detected)), (0.1, p_miss), (0.1, p_false))
    ]
    rate, ones = np.full(3, 0.1), np.ones(3)
    with pytest.raises(kind, match=words):
        look_exponential(STATE.inverse_odds, STATE.stamp_s, rate, *column)
    with pytest.raises(kind, match=words):
        look_general_purpose(STATE.inverse_odds, STATE.stamp_s, rate, ones, *column)


@bad
def test_one_feature(time, detected, p_miss, p_false, kind: type[EvermapError], words: str) -> None:
    feature = PersistenceFilter(Exponential(0.1))
    feature.update(5.0, True, 0.1, 0.1)
    before = feature.inverse_odds
    with pytest.raises(kind):
        feature.update(time, bool(detected), p_miss, p_false)
    assert (feature.inverse_odds, feature.stamp_s) == (before, 5.0)


def test_streams_name_the_row_as_given() -> None:
    with pytest.raises(InputError, match="entry 1: row 7 of 3 does not exist"):
        STATE.run([0, 7], [6.0, 6.0], 1, 0.1, 0.1)
    with pytest.raises(InputError, match=r"row 0: time 1\.0 s lies before"):
        STATE.run([0, 1], [1.0, 6.0], 1, 0.1, 0.1)
    with pytest.raises(NumericalError, match=r"row 0 \(feature 2 at 9.0 s\).*impossible"):
        STATE.run([2, 1], [9.0, 6.0], 1, [1.0, 0.1], 0.0)
    with pytest.raises(InputError, match="neither a detection nor a miss"):
        STATE.run([2, 1], [9.0, 6.0], [1, 0.5], 0.1, 0.1)


def test_detection_after_certain_death() -> None:
    dead = Uniform(10.0)
    with pytest.raises(NumericalError, match="impossible"):
        single.init(1, dead).update(11.0, 1, 0.1, 0.0)
    with pytest.raises(NumericalError, match="impossible"):
        PersistenceFilter(dead).update(11.0, True, 0.1, 0.0)


def test_questions_about_the_past() -> None:
    with pytest.raises(InputError, match=r"row 2: time 4\.0 s lies before"):
        STATE.predict([5.0, 6.0, 4.0])
    with pytest.raises(InputError, match="before the feature's birth"):
        PersistenceFilter(Exponential(1.0)).predict(-1.0)


def test_shapes_rows_and_priors() -> None:
    with pytest.raises(InputError, match="shape"):
        STATE.update([6.0, 6.0], 1, 0.1, 0.1)
    with pytest.raises(DataError, match="row 1 is observed twice"):
        STATE.update(6.0, 1, 0.1, 0.1, rows=[1, 1])
    with pytest.raises(InputError, match="row 3 of 3 does not exist"):
        STATE.update(6.0, 1, 0.1, 0.1, rows=[3])
    with pytest.raises(InputError, match="row 3 of 3 does not exist"):
        STATE.predict(6.0, rows=[3])
    with pytest.raises(ConfigError, match="row 1 asks for prior 4 of 2"):
        single.init(2, (Exponential(1.0), Uniform(1.0)), prior_of_row=[0, 4])
    with pytest.raises(ConfigError, match="nothing says which row has which"):
        single.init(2, (Exponential(1.0), Uniform(1.0)))


def test_kernel_parameters() -> None:
    one, seen = np.ones(1), np.ones(1, dtype=np.bool_)
    with pytest.raises(InputError, match="'rate_hz': row 0"):
        look_exponential(one, 0 * one, -one, one, seen, 0.1 * one, 0.1 * one)
    with pytest.raises(InputError, match="'low_hz': row 0"):
        look_general_purpose(one, 0 * one, one, one, one, seen, 0.1 * one, 0.1 * one)
    with pytest.raises(InputError, match="shares memory"):
        look_exponential(one, 0 * one, one, one, seen, 0.1 * one, 0.1 * one, out=Looked(one, np.empty(1)))
    with pytest.raises(InputError, match="'inverse_odds': row 0"):
        look_exponential(-one, 0 * one, one, one, seen, 0.1 * one, 0.1 * one)


def test_a_prior_may_be_text_and_anything_else_is_refused_at_once() -> None:
    by_text, by_name = (
        PersistenceFilter("exponential:half-life=1d"),
        PersistenceFilter(Exponential.from_half_life(86400)),
    )
    assert by_text.update(3600.0, False, 0.1, 0.1) == by_name.update(3600.0, False, 0.1, 0.1)
    assert single.init(2, "exponential:half-life=1d").priors == (Exponential.from_half_life(86400),)
    for build in (PersistenceFilter, lambda prior: single.init(2, prior)):
        with pytest.raises(ConfigError, match="exponentiel"):
            build("exponentiel:half-life=1d")
        for wrong in (Exponential, 3.0, None):
            with pytest.raises(InputError, match="a lifetime prior is needed"):
                build(wrong)
