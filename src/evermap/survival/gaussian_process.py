"""A hazard that is a Gaussian process over age and covariates, from censored lifetimes (Fernandez et al. 2016).

    h(t | x) = h0(t) exp(f(t, x)),     f = level + time + class + class x time + sum of smooth covariates

`h0` is the Weibull model fitted to all samples, to which the hazard reverts where data are few; every term is a
Gaussian process with its own scale, the sum of two of them where smoothness is to be learned. From the paper come the
parametric baseline, the process with additive covariates and the likelihood of censored lifetimes; there every
covariate changes the curve over time, here classes do and numbers multiply the hazard. The computation differs: rates
are constant over stretches of log time, so that the likelihood is exact without thinning, the posterior is Laplace's
instead of Monte Carlo's, and the link is an exponential instead of a sigmoid, which the thinning needed as a bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import DataError, NumericalError
from evermap.show import Shown
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.hazard_regression import Exposures, HazardDraws, Posterior, Term, learn, stretches_for
from evermap.survival.parametric_fit import fit
from evermap.types import FloatArray, IntArray

LEVEL_SCALE = 1.0
"""Standard deviation of the log hazard's level around the fitted baseline."""
TREND_SCALE = 0.3
"""Standard deviation of its slope over log time: of a Weibull model's shape around the baseline's."""
LONG, SHORT = 3.0, 0.7
"""Lengths of the processes over time, in natural logarithms: a factor of 20, and of 2."""
DAY_S = 86400.0
_KNOTS = 10
_HOURS = 12
_NEGLECTED = 1e-4
"""Share of a process' variance that is dropped to have fewer directions."""


@dataclass(frozen=True, slots=True, eq=False)
class Covariates(Shown):
    """Covariates of N objects, each None if unknown.

    Attributes:
        class_id: (N,) whole numbers.
        place_m: (N, 2) in metres.
        size_m: (N,) in metres.
        speed_mps: (N,) in metres a second.
        time_of_day_s: (N,) seconds since midnight when each was first seen.

    Raises:
        DataError: columns of different lengths, or a value that is not finite.
    """

    class_id: IntArray | None = None
    place_m: FloatArray | None = None
    size_m: FloatArray | None = None
    speed_mps: FloatArray | None = None
    time_of_day_s: FloatArray | None = None

    def __post_init__(self) -> None:
        for name, values in self.columns().items():
            wanted = np.int64 if name == "class_id" else np.float64
            column = np.atleast_1d(np.asarray(values, dtype=wanted))
            object.__setattr__(self, name, column.reshape(-1, 2) if name == "place_m" else column)
        lengths = {name: len(values) for name, values in self.columns().items()}
        for name, values in self.columns().items():
            if lengths[name] != max(lengths.values()):
                raise DataError(f"has {lengths[name]} rows, others {max(lengths.values())}", field=name)
            if not np.isfinite(values).all():
                row = int(np.argwhere(~np.isfinite(values))[0][0])
                raise DataError(f"must be finite: row {row} is not", field=name)

    def columns(self) -> dict[str, Any]:
        """Return those that are known, by name."""
        return {item.name: value for item in fields(self) if (value := getattr(self, item.name)) is not None}


@dataclass(frozen=True, slots=True, eq=False)
class GpHazard(Shown):
    """Posterior of a hazard over age and covariates.

    Attributes:
        edges_s: (K,) starts of the stretches of constant hazard, in seconds.
        baseline: (K,) rates in 1/s, the mean of the process.
        class_ids: (G,) in the samples, increasing; empty where classes were not given.
        posterior: of the process, in the order of the terms.
        scales: standard deviation of the log hazard that each term contributes.
    """

    edges_s: FloatArray
    baseline: FloatArray
    class_ids: IntArray
    posterior: Posterior
    _terms: tuple[Term, ...]
    _names: tuple[str, ...]
    _smooth: tuple[_Smooth, ...]

    @property
    def scales(self) -> dict[str, float]:
        """Return the standard deviation of each term of the log hazard, by its name."""
        return dict(zip(self._names, self.posterior.scales.tolist(), strict=True))

    @property
    def log_evidence(self) -> float:
        """Return the log marginal likelihood (Laplace), to compare sets of covariates by."""
        return self.posterior.log_evidence

    def at(self, **covariates: Any) -> HazardDraws:
        """Return the hazard of one object by its covariates: `at(class_id=3)`.

        Raises:
            DataError: a missing or unknown covariate, or a class without samples.
        """
        row = Covariates(**covariates)
        wanted = {smooth.name for smooth in self._smooth} | ({"class_id"} if len(self.class_ids) else set())
        for name in sorted(wanted ^ row.columns().keys()):
            raise DataError("is needed" if name in wanted else "was not learned from", field=name)
        group = 0 if row.class_id is None else group_of(row.class_id, self.class_ids)[0]
        columns = np.zeros((len(self.edges_s), len(self.posterior.mean)))
        start, levels = 0, iter(self._smooth)
        for term in self._terms:
            here = columns[:, start : start + term.size]
            here += term.curves[group] if term.curves is not None else next(levels).features(row)
            start += term.size
        return HazardDraws(self.edges_s, self.baseline * np.exp(self.posterior.draws(columns)))


def gp_fit(data: CensoredLifetimes, covariates: Covariates | None = None) -> GpHazard:
    """Learn the hazard over age and covariates, with scales by marginal likelihood.

    One core learns 10,000 samples of some classes and places in seconds; time is linear in the samples.

    Raises:
        DataError: covariates of another length, or no lifetime has an end.
        NumericalError: no maximum is found.
    """
    known = covariates or Covariates()
    for name, values in known.columns().items():
        if len(values) != len(data.left_s):
            raise DataError(f"has {len(values)} rows for {len(data.left_s)} lifetimes", field=name)
    edges_s = stretches_for(data)
    baseline = weibull_baseline(data, edges_s)
    class_ids, group = np.zeros(0, dtype=np.int64), np.zeros(len(data.left_s), dtype=np.int64)
    if known.class_id is not None:
        class_ids = np.unique(known.class_id)
        group = group_of(known.class_id, class_ids)
    named = curve_terms(edges_s, max(len(class_ids), 1))
    smooth = tuple(_smooth_terms(known))
    for one in smooth:
        named[one.label] = Term(levels=one.features(known))
    posterior = learn(Exposures.of(data, edges_s, baseline, group), list(named.values()))
    return GpHazard(edges_s, baseline, class_ids, posterior, tuple(named.values()), tuple(named), smooth)


def weibull_baseline(data: CensoredLifetimes, edges_s: FloatArray) -> FloatArray:
    """Return rates (K,) of the Weibull, or else exponential, model of all samples, averaged over each stretch."""
    try:
        prior = fit("weibull", data).prior
    except NumericalError:
        prior = fit("exponential", data).prior
    ends = np.append(edges_s, 2.0 * edges_s[-1])
    return np.asarray(np.diff(prior.cumulative_hazard(ends)) / np.diff(ends))


def curve_terms(edges_s: FloatArray, groups: int) -> dict[str, Term]:
    """Return the terms of level and curve over time, and of each group's own level and curve, by name."""
    ends = np.append(edges_s[1:], 2.0 * edges_s[-1])
    log_age = np.log(np.sqrt(np.maximum(edges_s, 0.25 * edges_s[1]) * ends))[:, None]
    stretches = len(edges_s)
    long, short = (_directions(log_age, length) for length in (LONG, SHORT))

    def shared(columns: FloatArray) -> FloatArray:
        return np.broadcast_to(columns, (groups, *columns.shape))

    def own(columns: FloatArray) -> FloatArray:
        return np.stack([np.kron(row, columns) for row in np.eye(groups)[:, None, :]])

    level, trend = np.ones((stretches, 1)), log_age - log_age.mean()
    terms = {
        "level": Term(curves=shared(level), scale=LEVEL_SCALE),
        "trend": Term(curves=shared(trend), scale=TREND_SCALE),
        "time": Term(curves=shared(long)),
        "time, fast": Term(curves=shared(short)),
    }
    if groups > 1:
        terms |= {
            "class": Term(curves=own(level)),
            "class x trend": Term(curves=own(trend)),
            "class x time": Term(curves=own(long)),
        }
    return terms


@dataclass(frozen=True, slots=True, eq=False)
class _Smooth:
    """A Gaussian process over one covariate, by its values at M points.

    Attributes:
        name: of the covariate.
        label: of the term.
        middle, spread: of the covariate; spread 0 for times of day, which lie on a circle.
        points: (M, d) support points of the process, in spreads.
        root: (M, M) that makes its values independent.
        length: of the process, in spreads.
    """

    name: str
    label: str
    middle: FloatArray
    spread: float
    points: FloatArray
    root: FloatArray
    length: float

    def features(self, covariates: Covariates) -> FloatArray:
        """Return columns (N, M) whose coefficients are independent."""
        here = _coordinates(np.asarray(getattr(covariates, self.name)), self.middle, self.spread)
        return np.asarray(_kernel(here, self.points, self.length) @ self.root)


def _smooth_terms(known: Covariates) -> list[_Smooth]:
    terms = []
    for name, values in known.columns().items():
        if name == "class_id":
            continue
        table = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
        middle = 0.5 * (table.min(axis=0) + table.max(axis=0))
        spread = 0.0 if name == "time_of_day_s" else float(table.std(axis=0).max()) or 1.0
        here = _coordinates(values, middle, spread)
        lengths = {name: 1.0}
        if name == "time_of_day_s":
            points = _coordinates(np.arange(_HOURS) * DAY_S / _HOURS, middle, 0.0)
        elif name == "place_m":
            points, lengths = _points_near(here), {name: 1.0, f"{name}, fine": 0.35}
        else:
            points = np.unique(np.quantile(here, np.linspace(0.0, 1.0, _KNOTS)))[:, None]
        for label, length in lengths.items():
            size, vectors = np.linalg.eigh(_kernel(points, points, length))
            kept = size > 1e-6 * size[-1]
            root = vectors[:, kept] / np.sqrt(size[kept])
            terms.append(_Smooth(name, label, middle, spread, points, root, length))
    return terms


def _coordinates(values: ArrayLike, middle: FloatArray, spread: float) -> FloatArray:
    """Return coordinates (N, d) in units of the spread; times of day as points of the unit circle."""
    table = np.asarray(values, dtype=np.float64)
    table = table.reshape(len(table), -1)
    if spread > 0.0:
        return np.asarray((table - middle) / spread)
    angle = 2.0 * np.pi * table[:, 0] / DAY_S
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _points_near(here: FloatArray) -> FloatArray:
    """Return the points of a square grid of at most 10 x 10 that are next to data."""
    low, high = here.min(axis=0), here.max(axis=0)
    spacing = max(float((high - low).max()) / 9.0, 1e-9)
    cells = np.unique(np.rint((here - low) / spacing), axis=0)
    return np.asarray(low + spacing * cells)


def _directions(points: FloatArray, length: float) -> FloatArray:
    """Return columns (K, r) that span a process of variance 1 at K points, without the weakest directions."""
    size, vectors = np.linalg.eigh(_kernel(points, points, length))
    kept = size > _NEGLECTED * size[-1]
    return np.asarray(vectors[:, kept] * np.sqrt(size[kept]))


def _kernel(a: FloatArray, b: FloatArray, length: float) -> FloatArray:
    """Return the squared exponential kernel."""
    distance = np.square(a[:, None, :] - b[None, :, :]).sum(axis=-1)
    return np.asarray(np.exp(-0.5 * distance / length**2))


def group_of(class_id: IntArray, class_ids: IntArray) -> IntArray:
    """Return the rows (N,) of classes among those that were learned from; raise a DataError for any other."""
    rows = np.searchsorted(class_ids, class_id)
    wrong = (rows == len(class_ids)) | (class_ids[np.minimum(rows, len(class_ids) - 1)] != class_id)
    if wrong.any():
        seen: Sequence[int] = class_ids.tolist()
        raise DataError(
            f"class {int(class_id[wrong][0])} was never seen", field="class_id", hint=", ".join(map(str, seen))
        )
    return np.asarray(rows, dtype=np.int64)
