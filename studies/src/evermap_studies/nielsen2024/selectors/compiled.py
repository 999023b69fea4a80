"""How the kernels of this package are compiled, and the two-term sum in log space that they share."""

import math

from evermap.existence.elementary import kernel
from evermap.slam.kernels import detection_residual

__all__ = ["detection_residual", "kernel", "log_add"]


@kernel
def log_add(a: float, b: float) -> float:
    """`log(e^a + e^b)`; -inf for both -inf."""
    top = max(a, b)
    if top == -math.inf:
        return top
    return top + math.log1p(math.exp(-abs(a - b)))
