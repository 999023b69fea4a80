"""Filters with the arguments one after another; rows are inverse odds, stamps, rates, time, detected, P_M and P_F."""

from __future__ import annotations

from typing import Any

from evermap.existence import batch, sites
from evermap.existence.batch import Looked, RowLooks, RowState
from evermap.existence.sites import SiteBeliefs, SiteSensor

_OWN = ("horizon_s", "out", "threads")


def _look(kind: type[Any], *columns: Any, **named: Any) -> Looked:
    names = kind._fields
    order = ("inverse_odds", "stamp_s", *names, "time_s", "detected", "p_miss", "p_false")
    given = dict(zip(order, columns, strict=False)) | {name: named.pop(name) for name in [*named] if name not in _OWN}
    rates = kind(*(given[name] for name in names))
    sight = RowLooks(*(given[name] for name in order[-4:]))
    return batch.look(RowState(given["inverse_odds"], given["stamp_s"]), rates, sight, **named)


def look_exponential(*columns: Any, **named: Any) -> Looked:
    return _look(batch.ConstantRate, *columns, **named)


def look_general_purpose(*columns: Any, **named: Any) -> Looked:
    return _look(batch.UnknownRate, *columns, **named)


def look_two_state(*columns: Any, **named: Any) -> Looked:
    return _look(batch.LeaveAndReturn, *columns, **named)


def follow_sites(p_here: Any, clique_of_site: Any, dynamics: Any, looks: Any, lines: Any, **named: Any) -> SiteBeliefs:
    """As `sites.follow_sites`, what the sensor does given by name."""
    sensor = {name: named.pop(name) for name in SiteSensor._fields[1:] if name in named}
    return sites.follow_sites(p_here, clique_of_site, dynamics, looks, SiteSensor(lines, **sensor), **named)
