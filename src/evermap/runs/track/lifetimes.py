"""The table of lifetimes that `evermap track` writes and `evermap survival fit` reads, and estimates from it.

Lifetimes are grouped by class or place; every estimator also gives a prior that filters take.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import ConfigError, EvermapError, InputError
from evermap.io.columns import Columns, csv_bytes, named, read_columns
from evermap.survival.base import LifetimePrior
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.text import prior_text
from evermap.types import UNKNOWN, BoolArray, Clock, FloatArray, IntArray, json_number
from evermap.valid import LATEST_S, X_M, Y_M, Quantity

if TYPE_CHECKING:
    from evermap.existence.hours import DatedStays, HourFit
    from evermap.survival.hazard_posterior import HazardPosterior
    from evermap.survival.hazard_regression import HazardDraws
    from evermap.survival.nonparametric import KaplanMeier, Npmle
    from evermap.survival.parametric_fit import ParametricFit

    Fitted = Npmle | KaplanMeier | ParametricFit | HazardDraws | HazardPosterior

_LATEST_S = 1e13
LEFT = Quantity("left", 0.0, _LATEST_S, hint="seconds; 0 where it was gone at the first look")
RIGHT = Quantity(
    "right", 0.0, _LATEST_S, positive=True, optional=True, hint="seconds; empty where it was never seen gone"
)
ENTRY = Quantity("entry", 0.0, _LATEST_S, optional=True, hint="seconds; empty or 0 where nothing is truncated")
WEIGHT = Quantity("weight", 0.0, 1e15, optional=True, hint="how many lifetimes the row stands for; 1 where empty")
BEGAN = Quantity("began", -LATEST_S, LATEST_S, optional=True, hint="a date, or seconds since 1970", dates=True)
_REQUIRED = ("left", "right")
_OPTIONAL = ("entry", "weight", "class_id", "x_m", "y_m")
LIFETIME_COLUMNS = (*_REQUIRED, *_OPTIONAL)
BY_CLASS, BY_CHUNK = "class", "chunk"
NO_CLASS = ""


@dataclass(frozen=True, slots=True)
class LifetimeTable:
    """N rows of a table, in its order.

    Attributes:
        data: the censored lifetimes.
        class_names: classes in use, in natural order.
        class_of_row: (N,) index into them, `UNKNOWN` where the table names none.
        position_m: (N, 2) where on the ground, nan where the table does not say.
        has_classes, has_places: whether it has the columns at all.
        source: file it came from, '' if none.
        line: (N,) line of each row in that file.
        warnings: remarks of the reader.
        began_s: (N,) when each began, in seconds since 1970; nan where the table does not say.
        clock: of these; that on the wall where they are dates without a zone.
    """

    data: CensoredLifetimes
    class_names: tuple[str, ...]
    class_of_row: IntArray
    position_m: FloatArray
    has_classes: bool
    has_places: bool
    source: str
    line: IntArray
    warnings: tuple[str, ...] = ()
    began_s: FloatArray | None = None
    clock: Clock = Clock.UNIX

    def __len__(self) -> int:
        return len(self.line)


@dataclass(frozen=True, slots=True)
class LifetimeGroup:
    """Rows of a table that belong together.

    Attributes:
        rows: their indices.
        class_id: the class, '' for rows that name none; None where classes are not separated.
        chunk: (column, row) of the square on the ground; None where places are not separated.
    """

    rows: IntArray
    class_id: str | None = None
    chunk: tuple[int, int] | None = None

    @property
    def label(self) -> str:
        """For people: `car in chunk (0, -3)`; 'all' where nothing is separated."""
        what = None if self.class_id is None else self.class_id or "of no class"
        where = None if self.chunk is None else f"chunk ({self.chunk[0]}, {self.chunk[1]})"
        return " in ".join(part for part in (what, where) if part) or "all"


def read_lifetimes(path: str | Path) -> LifetimeTable:
    """Return a CSV (also gzipped) or Parquet table with `left, right` and perhaps `entry, weight, class_id, x_m, y_m`
    and `began`.

    Raises:
        InputError: anything wrong in the file, by line and column.
    """
    warnings: list[str] = []
    table = read_columns(path, warnings)
    table.expect(_REQUIRED, (*_OPTIONAL, BEGAN.name))
    if len(table) == 0:
        raise InputError("has no rows below its header", path=path, hint="one row per lifetime")
    left = table.numbers(LEFT)
    right = table.filled(RIGHT, np.inf)
    entry = table.filled(ENTRY, 0.0)
    weight = table.filled(WEIGHT, 1.0)
    _refuse(
        table, right < left, "right", lambda row: f"ends at {right[row]:g} s, before its left at {left[row]:g} s",
        "left <= right; equal if the end was observed",
    )  # fmt: skip
    _refuse(
        table, entry >= right, "entry",
        lambda row: f"first observed at age {entry[row]:g} s, but gone by {right[row]:g} s",
        "entry below right: it must exist when it is first observed",
    )  # fmt: skip
    if not weight.any():
        raise InputError("all weights are 0", path=path, field="weight", hint="1 for a lifetime seen once")
    class_names, class_of_row = table.labels("class_id") if "class_id" in table else ([], np.full(len(table), UNKNOWN))
    return LifetimeTable(
        data=CensoredLifetimes(left, right, entry, weight),
        class_names=tuple(class_names),
        class_of_row=class_of_row,
        position_m=_positions(table),
        has_classes="class_id" in table,
        has_places="x_m" in table,
        source=str(path),
        line=table.line,
        warnings=tuple(warnings),
        began_s=table.numbers(BEGAN) if BEGAN.name in table else None,
        clock=(BEGAN.name in table and table.clock(BEGAN.name)) or Clock.UNIX,
    )


def lifetimes_csv(
    data: CensoredLifetimes,
    class_names: Sequence[str],
    class_of_row: IntArray,
    xy_m: FloatArray,
    began_s: FloatArray | None = None,
    clock: Clock = Clock.UNIX,
) -> bytes:
    """Return a table that `read_lifetimes` reads, of N lifetimes, their classes (N,) and places on the ground (N, 2).

    Columns `entry` and `weight` are written where they say something, `began` where it is known (N,): dates on a clock.
    """
    right = np.where(np.isinf(data.right_s), np.nan, data.right_s)
    columns = {"left": data.left_s, "right": right}
    if data.entry_s.any():
        columns["entry"] = data.entry_s
    if (data.weight != 1.0).any():
        columns["weight"] = data.weight
    columns |= {"class_id": named(class_names, class_of_row), "x_m": xy_m[:, 0], "y_m": xy_m[:, 1]}
    if began_s is not None:
        zone = "Z" if clock is Clock.UNIX else ""
        dates = np.datetime_as_string(np.rint(1e3 * began_s).astype("datetime64[ms]"))
        columns["began"] = named([f"{date}{zone}" for date in dates], np.arange(len(dates)))
    return csv_bytes(columns)


def parse_by(text: str) -> tuple[str, ...]:
    """Return `class,chunk` as words.

    Raises:
        ConfigError: another word.
    """
    words = tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    for word in words:
        if word not in {BY_CLASS, BY_CHUNK}:
            raise ConfigError(f"unknown grouping '{word}'", field="by", hint="class, chunk, or class,chunk")
    return words


def groups_of(table: LifetimeTable, by: Sequence[str], chunk_m: float) -> list[LifetimeGroup]:
    """Return the rows grouped by class, by square chunk of the ground, by both or not at all; in natural order.

    Args:
        table: the lifetimes.
        by: some of 'class' and 'chunk'.
        chunk_m: side of a chunk.

    Raises:
        ConfigError: a column that this needs is not in the table, or `chunk_m` cannot be.
        InputError: a row without a position where places are separated.
    """
    if not (np.isfinite(chunk_m) and chunk_m > 0.0):
        raise ConfigError(f"must be positive and finite, not {chunk_m:g}", field="chunk_m", hint="10")
    keys = np.zeros((len(table), 3), dtype=np.int64)  # class, chunk's column and row
    if BY_CLASS in by:
        if not table.has_classes:
            raise ConfigError("the table names no classes", field="by", hint="a column class_id in the table")
        keys[:, 0] = np.where(table.class_of_row == UNKNOWN, len(table.class_names), table.class_of_row)
    if BY_CHUNK in by:
        if not table.has_places:
            raise ConfigError("the table has no places", field="by", hint="columns x_m and y_m in the table")
        nowhere = np.flatnonzero(np.isnan(table.position_m).any(axis=1))
        if nowhere.size:
            line = int(table.line[nowhere[0]])
            raise InputError("is empty", path=table.source, line=line, field="x_m", hint="a place in every row")
        keys[:, 1:] = np.floor(table.position_m / chunk_m)
    different, group = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(group.ravel(), kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(group.ravel()))[:-1])
    names = (*table.class_names, NO_CLASS)
    return [
        LifetimeGroup(
            rows=rows,
            class_id=names[key[0]] if BY_CLASS in by else None,
            chunk=(int(key[1]), int(key[2])) if BY_CHUNK in by else None,
        )
        for key, rows in zip(different, parts, strict=True)
    ]


def _refuse(table: Columns, bad: BoolArray, field: str, problem: Callable[[int], str], hint: str) -> None:
    if bad.any():
        row = int(np.argmax(bad))
        raise table.error(problem(row), row=row, field=field, hint=hint)


def _positions(table: Columns) -> FloatArray:
    """(N, 2), nan where there are none."""
    if not table.has_all(("x_m", "y_m"), "both x_m and y_m, or neither"):
        return np.full((len(table), 2), np.nan)
    return np.stack([table.numbers(replace(axis, optional=True)) for axis in (X_M, Y_M)], axis=1)


NPMLE, KAPLAN_MEIER, BEST, GP, POOLED = "npmle", "kaplan-meier", "best", "gp", "pooled"


@dataclass(frozen=True, slots=True)
class LifetimeEstimate:
    """Estimate from N lifetimes.

    Attributes:
        estimator: its name; of 'best', the family that was chosen.
        fitted: what the estimator returned.
        prior: the same as a lifetime prior.
        text: the prior as `survival.text` reads it.
        numbers: by name, for JSON; no nan and no infinity.
    """

    estimator: str
    fitted: Fitted
    prior: LifetimePrior
    text: str
    numbers: dict[str, Any]


def estimators() -> tuple[str, ...]:
    """Return all names that `estimate` takes."""
    from evermap.survival.parametric_fit import KINDS

    return (NPMLE, KAPLAN_MEIER, *KINDS, BEST, GP, POOLED)


def check_estimator(name: str) -> None:
    """Raise ConfigError for a name that `estimate` does not take."""
    if name not in estimators():
        raise ConfigError(f"unknown estimator '{name}'", field="estimator", hint=", ".join(estimators()))


def estimates(name: str, table: LifetimeTable, groups: Sequence[LifetimeGroup]) -> Iterator[LifetimeEstimate]:
    """Yield the estimate of each group by one of `estimators()`, one after the other, for a progress bar.

    The Gaussian process and pooled hazards learn from all groups what they share; the others see one group at a time.

    Raises:
        ConfigError: an unknown name.
        DataError: lifetimes from which this estimator can learn nothing, or of a sort that it does not take.
        NumericalError: there is no most probable distribution.
    """
    check_estimator(name)
    if name == GP:
        yield from _gaussian_process(table, groups)
        return
    if name == POOLED:
        yield from _fit_pooled(table, groups)
        return
    for group in groups:
        try:
            yield estimate(name, table.data[group.rows])
        except EvermapError as error:
            whose = f"{group.label}: " if len(groups) > 1 else ""
            raise type(error)(whose + error.problem, path=table.source, field=error.field, hint=error.hint) from error


def estimate(name: str, data: CensoredLifetimes) -> LifetimeEstimate:
    """Fit N lifetimes by themselves, by one of `estimators()` but for the Gaussian process and pooled hazards.

    Raises:
        DataError, NumericalError: as `estimates`.
    """
    if name == NPMLE:
        return _npmle(data)
    if name == KAPLAN_MEIER:
        return _kaplan_meier(data)
    return _parametric(name, data)


def _npmle(data: CensoredLifetimes) -> LifetimeEstimate:
    from evermap.survival.nonparametric import npmle

    fitted = npmle(data)
    numbers = {
        "loglik": fitted.loglik,
        "kkt_violation": fitted.kkt_violation,
        "iterations": fitted.iterations,
        "support_left": fitted.support_left.tolist(),
        "support_right": [*map(json_number, fitted.support_right)],
        "mass": fitted.mass.tolist(),
    }
    return _with_prior(NPMLE, fitted, fitted.prior(), numbers)


def _kaplan_meier(data: CensoredLifetimes) -> LifetimeEstimate:
    from evermap.survival.nonparametric import kaplan_meier

    fitted = kaplan_meier(data)
    lower, upper = fitted.band(fitted.time_s) if fitted.time_s.size else (fitted.time_s, fitted.time_s)
    numbers = {
        "time": fitted.time_s.tolist(),
        "survives": fitted.survives.tolist(),
        "lower_95": np.atleast_1d(lower).tolist(),
        "upper_95": np.atleast_1d(upper).tolist(),
        "at_risk": fitted.at_risk.tolist(),
        "deaths": fitted.deaths.tolist(),
    }
    return _with_prior(KAPLAN_MEIER, fitted, fitted.prior(), numbers)


def _parametric(name: str, data: CensoredLifetimes) -> LifetimeEstimate:
    from evermap.survival.parametric_fit import fit, fit_best

    fitted = fit_best(data) if name == BEST else fit(name, data)
    numbers = {
        "loglik": fitted.loglik,
        "aic": fitted.aic,
        "bic": fitted.bic,
        "parameters": dict(zip(fitted.names, fitted.parameters.tolist(), strict=True)),
        "standard_errors": dict(zip(fitted.names, map(json_number, fitted.standard_errors), strict=True)),
    }
    return _with_prior(fitted.kind, fitted, fitted.prior, numbers)


def _gaussian_process(table: LifetimeTable, groups: Sequence[LifetimeGroup]) -> Iterator[LifetimeEstimate]:
    """One process over all groups, with class and place as covariates where they tell groups apart."""
    from evermap.survival.gaussian_process import Covariates, gp_fit

    known: dict[str, Any] = {}
    if groups[0].class_id is not None:
        known["class_id"] = table.class_of_row
    if groups[0].chunk is not None:
        known["place_m"] = table.position_m
    hazard = gp_fit(table.data, Covariates(**known))
    for group in groups:
        mean = {"class_id": table.class_of_row[group.rows[0]], "place_m": table.position_m[group.rows].mean(axis=0)}
        draws = hazard.at(**{name: mean[name] for name in known})
        expected, lower, upper = draws.survival(draws.edges_s)
        numbers = {
            "log_evidence": hazard.log_evidence,
            "scales": hazard.scales,
            "time": draws.edges_s.tolist(),
            "survives": expected.tolist(),
            "lower_95": lower.tolist(),
            "upper_95": upper.tolist(),
        }
        yield _with_prior(GP, draws, draws.prior(), numbers)


def _fit_pooled(table: LifetimeTable, groups: Sequence[LifetimeGroup]) -> Iterator[LifetimeEstimate]:
    """Hazards by age of which groups have a part in common, and hours of the week where rows say when they began."""
    from evermap.existence.hours import learn_hours_and_hazards
    from evermap.maps.lives import general_purpose
    from evermap.survival.pooled_hazards import learn_hazards
    from evermap.survival.stay_likelihood import StayAges

    group = np.zeros(len(table), dtype=np.int64)
    for number, one in enumerate(groups):
        group[one.rows] = number

    def learn(hours: HourFit | None = None) -> list[HazardPosterior]:
        data = table.data if hours is None or table.began_s is None else _count(table.data, table.began_s, group, hours)
        return learn_hazards(StayAges.of_samples(data, group), [None] * len(groups), general_purpose())

    hours: HourFit | None = None
    found: Sequence[HazardPosterior] = learn()
    if table.began_s is not None and np.isfinite(table.began_s).all():
        dated, stated = _date(table.data, table.began_s, group), np.zeros(len(groups), dtype=np.bool_)
        hours, found = learn_hours_and_hazards(dated, found, stated, learn)
    for number, posterior in enumerate(found[:-1]):
        expected, lower, upper = posterior.survival(posterior.edges_s)
        seen_s = posterior.seen_s
        numbers = {
            "time": posterior.edges_s.tolist(),
            "survives": expected.tolist(),
            "lower_95": lower.tolist(),
            "upper_95": upper.tolist(),
            "seen_from_s": json_number(seen_s[0]),
            "seen_to_s": json_number(seen_s[1]),
            **({} if hours is None else {"hours": _describe_hours(hours, number, table.clock)}),
        }
        yield _with_prior(POOLED, posterior, posterior.prior(), numbers)


def _date(data: CensoredLifetimes, began_s: FloatArray, group: IntArray) -> DatedStays:
    """Return lifetimes (N,) by their stamps; an end that was observed lies within a second."""
    from evermap.existence.hours import DatedStays

    gone_s = began_s + np.where(data.exact, data.right_s + 1.0, data.right_s)
    first_s, last_s = began_s + data.entry_s, began_s + np.maximum(data.left_s, data.entry_s)
    return DatedStays(began_s[:, None], first_s, last_s, gone_s, np.ones(len(group)), data.weight, group)


def _count(data: CensoredLifetimes, began_s: FloatArray, group: IntArray, hours: HourFit) -> CensoredLifetimes:
    """Return lifetimes on the clock of the hours of the week."""
    begin = hours.count_s(group, began_s)
    left, right, entry = (
        hours.count_s(group, began_s + age) - begin for age in (data.left_s, data.right_s, data.entry_s)
    )
    return CensoredLifetimes(left, np.maximum(right, 1e-3), np.minimum(entry, 0.999 * right), data.weight)


def _describe_hours(hours: HourFit, group: int, clock: Clock) -> dict[str, Any]:
    """Return what is known of the hours of the week of a group, for JSON, with a line for people."""
    from evermap.existence.hours import describe_hours

    rhythm, follows = hours.rhythm, bool(hours.follows[group])
    by_hour = rhythm.hourly_factor.round(4).tolist() if rhythm is not None and follows else None
    line = "; ".join(describe_hours(hours.n_dated, hours.log_evidence, rhythm, clock, follows=follows))
    return {
        "ends_dated": hours.n_dated,
        "evidence_nats": json_number(hours.log_evidence),
        "factor": by_hour,
        "line": line,
    }


def _with_prior(name: str, fitted: Fitted, prior: LifetimePrior, numbers: dict[str, Any]) -> LifetimeEstimate:
    return LifetimeEstimate(name, fitted, prior, prior_text(prior), numbers)
