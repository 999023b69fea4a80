"""The formulas of `recursion` on torch tensors, on whatever device they are.

Each conditional expression `a if c else b` is read as a selection between whole tensors, each name by torch's function.
Exponential lifetimes are computed in the tensors' own type. Lifetimes of unknown rate are computed in double precision
whatever comes in, for their odds of dying are differences of nearly equal numbers, of which single precision would
leave three or four digits.
"""

from __future__ import annotations

import ast
import math
import sys
from functools import cache
from pathlib import Path
from typing import Any

from evermap.existence import recursion

Tensor = Any
"""A `torch.Tensor`; torch need not be installed where types are checked."""


def look(kind: str, before: Any, rates: Any, sight: Any, horizon_s: float) -> tuple[Tensor, Tensor, bool]:
    """Return inverse odds, probability, and whether a row was refused; arguments as those of the kernels."""
    like = before.inverse_odds
    rates = list(rates)
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
    torch: Any = sys.modules["torch"]  # who has tensors has loaded it

    def where(condition: Any, a: Any, b: Any) -> Any:
        if not isinstance(condition, torch.Tensor):
            return a if condition else b
        sides = (x if isinstance(x, torch.Tensor) else condition.new_full((), x, dtype=torch.float64) for x in (a, b))
        return torch.where(condition, *sides)

    def pick(scalar: Any, tensor: Any) -> Any:
        """`min` or `max` of two, either of which may be a number."""

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
    exec(compile(ast.fix_missing_locations(tree), recursion.__file__, "exec"), space)
    smallest, largest, log_largest = _bounds(double)
    space.update(
        SMALLEST=smallest, LARGEST=largest, LOG_LARGEST=log_largest, where=where, split=split,
        exp=lambda x: x.exp() if isinstance(x, torch.Tensor) else math.exp(x),
        expm1=lambda x: x.expm1() if isinstance(x, torch.Tensor) else math.expm1(x),
        log_of_split=lambda exponent, s: exponent * math.log(2.0) + 2.0 * s.atanh(),
        min=pick("max", torch.minimum), max=pick("min", torch.maximum),
    )  # fmt: skip
    return space
