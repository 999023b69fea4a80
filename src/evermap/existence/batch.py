"""Batched looks at many features whose lifetimes have a closed form, compiled or on tensors.

Every row has its own clock, lifetime parameters, `P_M` and `P_F`. State and answers are arrays of the caller: the new
stamps are `sight.time_s` itself, and `out` may be reused from look to look (but must not overlap the inputs), so that
nothing is allocated at a million rows.

Columns are numpy arrays, or torch tensors of float32 or float64 on any one device; tensors give tensors, of the type of
`inverse_odds`, and stay on their device. Probabilities from float32 are within 1e-6 of those from the same numbers in
double precision. Mind that float32 keeps seven digits of a time: a week to a twentieth of a second.

Tensors go through the formulas of `recursion` too: each conditional expression `a if c else b` is read as a selection
between whole tensors, each name as torch's function. Exponential lifetimes are computed in the tensors' own type.
Lifetimes of unknown rate are computed in double precision whatever comes in, for their odds of dying are differences of
nearly equal numbers, of which single precision would leave three or four digits.
"""

from __future__ import annotations

import ast
import math
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evermap.errors import InputError, NumericalError
from evermap.existence import protocol as checks
from evermap.existence import recursion
from evermap.existence.recursion import RowLooks, RowState
from evermap.types import FloatArray

CHUNK_ROWS = 65536
"""Most rows that a thread takes at a time: much longer than handing them out, short enough for busy cores to help."""


class Looked(NamedTuple):
    """Answers of one look at N features.

    Attributes:
        inverse_odds: (N,) `(1 - p) / p` right after the look; with the time of the look the state for the next one.
        probability: (N,) that the feature exists `horizon_s` after the look.
    """

    inverse_odds: Any
    probability: Any


class ConstantRate(NamedTuple):
    """Exponential lifetimes (MATH.md section 2).

    Attributes:
        rate_hz: (N,) hazard of each feature in 1/s; 0 never leaves.
    """

    rate_hz: Any


class UnknownRate(NamedTuple):
    """Lifetimes of unknown rate between `low_hz` and `high_hz` (N,), in 1/s (Rosen 2016 eqs. 26-29)."""

    low_hz: Any
    high_hz: Any


class LeaveAndReturn(NamedTuple):
    """Exponential stays and absences of features that leave and return, rates (N,) in 1/s (MATH.md section 4).

    At birth the inverse odds are 0; of a feature that may have come and gone for long they are `leave_hz / return_hz`.
    With `return_hz = 0` this is `ConstantRate`.
    """

    leave_hz: Any
    return_hz: Any


Rates = ConstantRate | UnknownRate | LeaveAndReturn
_KINDS: dict[type, str] = {ConstantRate: "exponential", UnknownRate: "general_purpose", LeaveAndReturn: "two_state"}
"""Names of the formulas and kernels."""
Parts = tuple[RowState, Rates, RowLooks]
"""All columns of a look."""


def look(
    before: RowState,
    rates: Rates,
    sight: RowLooks,
    *,
    horizon_s: float = 0.0,
    out: Looked | None = None,
    threads: bool = False,
) -> Looked:
    """Predict to the look, take it in, predict `horizon_s` further.

    Args:
        before: the features before the look.
        rates: how they leave, and return.
        sight: the look.
        horizon_s: how far after the look the probability is wanted.
        out: arrays to fill; not for tensors.
        threads: spread the rows over all cores; tensors have their own threads.

    Raises:
        InputError: shapes, times running back, numbers out of range; the row is named.
        NumericalError: an observation that is impossible under both states.
    """
    if not 0.0 <= horizon_s < np.inf:
        raise InputError(f"{horizon_s} s is not a time after the look", field="horizon_s", hint="a finite number >= 0")
    given: Parts = (before, rates, sight)
    columns = {name: column for part in given for name, column in part._asdict().items()}
    torch = sys.modules.get("torch")  # tensors exist only where it is loaded
    if torch is not None and isinstance(before.inverse_odds, torch.Tensor):
        if out is not None:
            raise InputError("is for arrays only", field="out", hint="leave it out: torch keeps memory for reuse")
        _check_tensors(columns, torch)
        *found, refused = _look_at_tensors(given, float(horizon_s))
        if refused:
            _refuse({name: column.cpu().numpy() for name, column in columns.items()}, found[0].cpu().numpy())
        return Looked(*found)

    from evermap.existence import kernels

    columns = _contiguous(columns)
    answer = _space(columns, out)
    given = tuple(type(part)(*(columns[name] for name in part._fields)) for part in given)  # type: ignore[assignment]
    if _apply(getattr(kernels, _KINDS[type(rates)]), given, float(horizon_s), answer, threads):
        _refuse(columns, answer.inverse_odds)
    return answer


def _apply(kernel: Callable[..., bool], given: Parts, horizon_s: float, answer: Looked, threads: bool) -> bool:
    """Run a kernel over all rows, at once or chunk by chunk on all cores; True if it refused a row."""
    n = len(answer.probability)

    def chunk(rows: slice) -> bool:
        before, rates, sight, after = (type(part)(*(column[rows] for column in part)) for part in (*given, answer))
        return kernel(before, rates, sight, horizon_s, after)

    if not threads or n <= CHUNK_ROWS:
        return chunk(slice(None))
    cores, pool = _pool()
    count = cores * -(-n // (cores * CHUNK_ROWS))  # as many for each core
    edges = [n * k // count for k in range(count + 1)]
    return any(list(pool.map(chunk, map(slice, edges, edges[1:]))))  # a list: all of them, also after a refusal


@cache
def _pool() -> tuple[int, ThreadPoolExecutor]:
    """Return the number of usable cores, and a pool with a thread for each, started at the first call and kept."""
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive into a child
    cores = len(os.sched_getaffinity(0))
    return cores, ThreadPoolExecutor(cores)


def _contiguous(columns: dict[str, Any]) -> dict[str, Any]:
    """Columns as contiguous float64 of one length, the detections as booleans."""
    n = np.size(columns["inverse_odds"])
    arrays: dict[str, Any] = {}
    for name, column in columns.items():
        arrays[name] = np.ascontiguousarray(column, dtype=None if name == "detected" else np.float64)
        if arrays[name].shape != (n,):
            raise InputError(f"shape {arrays[name].shape} instead of ({n},)", field=name)
    if arrays["detected"].dtype != np.bool_:
        raise InputError(f"{arrays['detected'].dtype} instead of bool", field="detected")
    return arrays


def _space(columns: dict[str, Any], out: Looked | None) -> Looked:
    """The arrays to fill."""
    n = len(columns["time_s"])
    if out is None:
        return Looked(np.empty(n), np.empty(n))
    if any(a.shape != (n,) or a.dtype != np.float64 or not a.flags.c_contiguous for a in out):
        raise InputError(f"not contiguous float64 arrays of shape ({n},)", field="out")
    if any(np.may_share_memory(a, b) for a in out for b in columns.values()):
        raise InputError("shares memory with an input", field="out", hint="two sets of arrays, used in turn")
    return out


def _check_tensors(columns: dict[str, Any], torch: Any) -> None:
    """Raise `InputError` unless all are tensors of one length on one device, of types that can be computed with."""
    first = columns["inverse_odds"]
    for name, column in columns.items():
        if not isinstance(column, torch.Tensor) or column.device != first.device:
            raise InputError(f"is not a tensor on {first.device}", field=name, hint="all columns on one device")
        if column.ndim != 1 or column.shape != first.shape:
            raise InputError(f"shape {tuple(column.shape)} instead of ({first.numel()},)", field=name)
        if column.dtype not in ((torch.bool,) if name == "detected" else (torch.float32, torch.float64)):
            raise InputError(f"is of {column.dtype}", field=name, hint="float32 or float64, detections bool")


def _refuse(columns: dict[str, Any], after: FloatArray) -> None:
    """Find the row that was refused, and raise its error."""
    checks.check_times(columns["time_s"], columns["stamp_s"])
    checks.check_probability(columns["p_miss"], "p_miss")
    checks.check_probability(columns["p_false"], "p_false")
    for field in ("rate_hz", "leave_hz", "return_hz"):
        rate = columns.get(field, np.zeros(1))
        fine = (rate >= 0.0) & np.isfinite(rate)
        if not fine.all():
            raise InputError(f"row {int(np.argmin(fine))}: no rate: a finite number >= 0 is needed", field=field)
    if "low_hz" in columns:
        low, high = columns["low_hz"], columns["high_hz"]
        fine = (low > 0.0) & (high > low) & np.isfinite(high)
        if not fine.all():
            raise InputError(f"row {int(np.argmin(fine))}: rates are not 0 < low < high", field="low_hz")
    odds = columns["inverse_odds"]
    if not (odds >= 0.0).all():
        row = int(np.argmin(odds >= 0.0))
        raise InputError(f"row {row}: {odds[row]} are not inverse odds", field="inverse_odds", hint="a number >= 0")
    checks.check_possible(after)
    raise NumericalError("a row was refused for no reason that can be found")


Tensor = Any
"""A `torch.Tensor`; torch need not be installed where types are checked."""


def _look_at_tensors(given: Parts, horizon_s: float) -> tuple[Tensor, Tensor, bool]:
    """Inverse odds, probability, and whether a row was refused."""
    before, rates, sight = given
    kind, like = _KINDS[type(rates)], before.inverse_odds
    columns = [*before, *rates, *sight]
    if kind == "general_purpose":
        columns = [column if column.dtype == sight.detected.dtype else column.double() for column in columns]
    formulas = _formulas(columns[0].element_size() == 8)
    odds, start, *rest = columns
    own, (stop, *looked) = rest[: len(rates)], rest[len(rates) :]
    new, *middle, fine = formulas[f"look_{kind}"](odds, start, *own, stop, *looked)
    if kind == "general_purpose" and horizon_s > 0.0:
        probability = formulas[f"later_{kind}"](new, *own, stop, horizon_s, *middle)
    else:
        probability = 1.0 / (1.0 + new) if middle else formulas[f"later_{kind}"](new, *own, horizon_s)
    smallest, largest, _ = _bounds(like.element_size() == 8)
    kept = new.clamp(smallest, largest).where((new > 0.0) & new.isfinite(), new)
    return kept.to(like.dtype), probability.to(like.dtype), not bool(fine.all())


def _bounds(double: bool) -> tuple[float, float, float]:
    """Smallest and largest finite inverse odds of a type of tensors, and the logarithm of the largest."""
    return (recursion.SMALLEST, recursion.LARGEST, recursion.LOG_LARGEST) if double else (1e-37, 1e37, 85.0)


class _Selections(ast.NodeTransformer):
    """`a if c else b` becomes `where(c, a, b)`."""

    def visit_IfExp(self, node: ast.IfExp) -> ast.Call:
        self.generic_visit(node)
        return ast.Call(ast.Name("where", ast.Load()), [node.test, node.body, node.orelse], [])


@cache
def _formulas(double: bool) -> dict[str, Any]:
    """The formulas, compiled once for each type of tensors."""
    torch: Any = sys.modules["torch"]  # tensors exist only where it is loaded

    def where(condition: Any, a: Any, b: Any) -> Any:
        if not isinstance(condition, torch.Tensor):
            return a if condition else b
        sides = (x if isinstance(x, torch.Tensor) else condition.new_full((), x, dtype=torch.float64) for x in (a, b))
        return torch.where(condition, *sides)

    def pick(scalar: Any, tensor: Any) -> Any:
        """Return `min` or `max` of two, either of which may be a number."""

        def of(a: Any, b: Any) -> Any:
            if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
                return tensor(a, b)
            x, bound = (a, b) if isinstance(a, torch.Tensor) else (b, a)
            return x.clamp(**{scalar: bound})

        return of

    def split(x: Tensor) -> tuple[Tensor, Tensor]:
        fraction, exponent = torch.frexp(x)
        low = (fraction < math.sqrt(0.5)).to(x.dtype)
        return exponent - low, fraction * (1.0 + low) - 1.0

    tree = _Selections().visit(ast.parse(Path(recursion.__file__).read_text(encoding="utf-8")))
    space: dict[str, Any] = {"__name__": recursion.__name__}
    exec(compile(ast.fix_missing_locations(tree), recursion.__file__, "exec"), space)  # noqa: S102  (a module of ours)
    smallest, largest, log_largest = _bounds(double)
    space.update(
        SMALLEST=smallest, LARGEST=largest, LOG_LARGEST=log_largest, where=where, split=split,
        exp=lambda x: x.exp() if isinstance(x, torch.Tensor) else math.exp(x),
        expm1=lambda x: x.expm1() if isinstance(x, torch.Tensor) else math.expm1(x),
        log_of_split=lambda exponent, s: exponent * math.log(2.0) + 2.0 * s.atanh(),
        min=pick("max", torch.minimum), max=pick("min", torch.maximum),
    )  # fmt: skip
    return space
