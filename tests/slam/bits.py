"""All bits of a value, to compare what a trial must not change."""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.estimate.solver import Solver
from evermap.slam.preintegration import Preintegration
from evermap.slam.problem import Marginals


def bits(value: Any) -> Any:
    """All numbers in a value, and in what it holds; not what is kept only to be computed once."""
    if isinstance(value, Solver | Marginals | Preintegration):
        return None
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: bits(one) for key, one in value.items()}
    if isinstance(value, list | tuple | set):
        return [bits(one) for one in value]
    if hasattr(value, "__dict__") and type(value).__module__.startswith("evermap"):
        return bits(vars(value))
    if hasattr(value, "__slots__"):
        return {name: bits(getattr(value, name)) for name in value.__slots__}
    return None if callable(value) else repr(value)
