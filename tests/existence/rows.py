"""Looks at rows by columns one after another: inverse odds, stamps, rates, then time, detected, P_M and P_F."""

from __future__ import annotations

from typing import Any

from evermap.existence import batch
from evermap.existence.batch import Look, Sight, State

_OWN = ("horizon_s", "out", "threads")


def _look(kind: str, names: tuple[str, ...], *columns: Any, **named: Any) -> Look:
    order = ("inverse_odds", "stamp_s", *names, "time_s", "detected", "p_miss", "p_false")
    given = dict(zip(order, columns, strict=False)) | {name: named.pop(name) for name in [*named] if name not in _OWN}
    rates = [given[name] for name in names]
    sight = Sight(*(given[name] for name in order[-4:]))
    answer: Look = getattr(batch, kind)(State(given["inverse_odds"], given["stamp_s"]), *rates, sight, **named)
    return answer


def look_exponential(*columns: Any, **named: Any) -> Look:
    return _look("look_exponential", ("rate_hz",), *columns, **named)


def look_general_purpose(*columns: Any, **named: Any) -> Look:
    return _look("look_general_purpose", ("low_hz", "high_hz"), *columns, **named)


def look_two_state(*columns: Any, **named: Any) -> Look:
    return _look("look_two_state", ("leave_hz", "return_hz"), *columns, **named)
