"""Lifetimes of places by partial pooling: a chunk shrinks to its neighbours and its class as its data are few.

    log h(t | class, chunk) = curve of the class(t) + place(chunk) + own(chunk) + own(class, chunk)

`place` is a Gaussian Markov random field over chunks that touch (Besag 1974; Rue and Held 2005), so neighbours are
alike; `own` levels are independent, so a chunk may differ from all of them. The scale of each term is learned by
marginal likelihood, as in `hazard_regression`: many samples of a chunk decide alone, a chunk without any follows its
neighbours and its class, with the uncertainty that this has.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import DataError
from evermap.show import Shown
from evermap.survival.base import check_positive
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.gaussian_process import curve_terms, group_of, weibull_baseline
from evermap.survival.hazard_regression import (
    Exposures,
    HazardDraws,
    Posterior,
    Term,
    learn,
    stretches_for,
)
from evermap.types import FloatArray, IntArray

Chunk = tuple[int, int]
"""Column and row of a square of the ground plane; `(0, 0)` begins at the origin."""
REACH = 0.1
"""Precision of a chunk's own level relative to that of its difference from a neighbour: a range of three chunks."""
MOST = 1500
"""Largest number of chunks, with those beside them, that are learned together."""
_CURVES = "curves"
_PLACE, _OWN, _CLASS = "place", "own", "class x own"


@dataclass(frozen=True, slots=True, eq=False)
class PooledHazard(Shown):
    """Posterior of a hazard by class and chunk.

    Attributes:
        size_m: side of a chunk.
        chunks: those that held samples.
        edges_s: (K,) starts of the stretches of constant hazard, in seconds.
        baseline: (K,) rates in 1/s around which the terms move.
        class_ids: (G,) in the samples, increasing.
        posterior: of the terms.
        scales: standard deviation of the log hazard that each term contributes, by name.
    """

    size_m: float
    chunks: tuple[Chunk, ...]
    edges_s: FloatArray
    baseline: FloatArray
    class_ids: IntArray
    posterior: Posterior
    scales: Mapping[str, float]
    _curves: FloatArray
    _columns: Mapping[str, Mapping[tuple[int, ...], int]]

    def at(self, place_m: ArrayLike, class_id: int = 0) -> HazardDraws:
        """Return the hazard at one place (2,) in metres for one class (0 where classes were not given).

        Raises:
            DataError: a class without samples, or an invalid place.
        """
        group = int(group_of(np.array([class_id]), self.class_ids)[0])
        x, y = chunks_of(np.asarray(place_m)[None, :], self.size_m)[0].tolist()
        columns = np.zeros((len(self.edges_s), len(self.posterior.mean)))
        columns[:, : self._curves.shape[2]] = self._curves[group]
        unknown = 0.0
        for name, key in ((_PLACE, (x, y)), (_OWN, (x, y)), (_CLASS, (group, x, y))):
            if name not in self._columns:
                continue
            column = self._columns[name].get(key)
            if column is None:
                unknown += self.scales[name] ** 2
            else:
                columns[:, column] = 1.0
        return HazardDraws(self.edges_s, self.baseline * np.exp(self.posterior.draws(columns, unknown)))


def chunks_of(place_m: ArrayLike, size_m: float) -> IntArray:
    """Return columns and rows (N, 2) of the chunks of (N, 2) places.

    Raises:
        ConfigError: a size that is not positive.
        DataError: a place that is not finite, or not two numbers.
    """
    check_positive(size_m, "size_m")
    places = np.asarray(place_m, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != 2:
        raise DataError(f"must be x and y of each thing, not of shape {places.shape}", field="place_m")
    if not np.isfinite(places).all():
        raise DataError(f"must be finite: row {int(np.argwhere(~np.isfinite(places))[0][0])} is not", field="place_m")
    return np.asarray(np.floor(places / size_m), dtype=np.int64)


def pooled_fit(
    data: CensoredLifetimes, place_m: ArrayLike, size_m: float, class_id: IntArray | None = None
) -> PooledHazard:
    """Learn the hazard by class and chunk.

    Args:
        data: N samples.
        place_m: (N, 2) in metres.
        size_m: side of the square chunks.
        class_id: (N,) class of each; None for one class.

    Raises:
        ConfigError: a size that is not positive.
        DataError: columns of different lengths, too many chunks, or no lifetime has an end.
        NumericalError: no maximum is found.
    """
    n = len(data.left_s)
    chunk_of_row = chunks_of(place_m, size_m)
    classes = np.zeros(n, dtype=np.int64) if class_id is None else np.asarray(class_id, dtype=np.int64)
    for name, length in (("place_m", len(chunk_of_row)), ("class_id", len(classes))):
        if length != n:
            raise DataError(f"has {length} rows for {n} lifetimes", field=name)
    edges_s = stretches_for(data)
    baseline = weibull_baseline(data, edges_s)
    class_ids, group = np.unique(classes, return_inverse=True)
    chunks: list[Chunk] = [(x, y) for x, y in np.unique(chunk_of_row, axis=0).tolist()]
    around = _with_neighbours(chunks)
    if len(around) > MOST:
        raise DataError(f"are {len(around)} chunks, more than {MOST}", field="place_m", hint="larger chunks")

    terms = list(curve_terms(edges_s, len(class_ids)).values())
    names = [_CURVES] * len(terms)
    start = sum(term.size for term in terms)
    columns: dict[str, dict[tuple[int, ...], int]] = {}
    keys: dict[str, tuple[Sequence[tuple[int, ...]], IntArray, FloatArray | None]] = {
        _PLACE: (around, chunk_of_row, _field_precision(around)),
        _OWN: (chunks, chunk_of_row, None),
    }
    if len(class_ids) > 1:
        pairs = np.column_stack([group, chunk_of_row])
        keys[_CLASS] = ([tuple(pair) for pair in np.unique(pairs, axis=0).tolist()], pairs, None)
    for name, (levels, key_of_row, precision) in keys.items():
        place_in_term = {key: j for j, key in enumerate(levels)}
        rows = np.array([place_in_term[tuple(key)] for key in key_of_row.tolist()])
        terms.append(Term(levels=_one_hot(rows, len(levels)), precision=precision))
        names.append(name)
        columns[name] = {key: start + j for key, j in place_in_term.items()}
        start += len(levels)
    posterior = learn(Exposures.of(data, edges_s, baseline, group.astype(np.int64)), terms)
    scales = {name: scale for name, scale in zip(names, posterior.scales.tolist(), strict=True) if name != _CURVES}
    curves = np.concatenate([term.curves for term in terms if term.curves is not None], axis=2)
    return PooledHazard(size_m, tuple(chunks), edges_s, baseline, class_ids, posterior, scales, curves, columns)


def _one_hot(column: IntArray, count: int) -> object:
    from scipy import sparse

    n = len(column)
    return sparse.csr_matrix((np.ones(n), column, np.arange(n + 1)), shape=(n, count))


def _with_neighbours(chunks: Iterable[Chunk]) -> list[Chunk]:
    """Return the chunks and the eight around each, sorted."""
    near = range(-1, 2)
    return sorted({(x + i, y + j) for x, y in chunks for i in near for j in near})


def _field_precision(chunks: Sequence[Chunk]) -> FloatArray:
    """Return the precision of a Gaussian Markov random field over touching chunks, of variance 1 on average."""
    number = {chunk: j for j, chunk in enumerate(chunks)}
    precision = REACH * np.eye(len(chunks))
    for (x, y), j in number.items():
        for beside in ((x + 1, y), (x, y + 1)):
            if (k := number.get(beside)) is not None:
                precision[[j, k], [j, k]] += 1.0
                precision[[j, k], [k, j]] -= 1.0
    variance = float(np.diag(np.linalg.inv(precision)).mean())
    return precision * variance
