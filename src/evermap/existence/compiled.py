"""How the kernels of this package are compiled; they share the vectorised functions of the persistence filter."""

from evermap.compiled import drop_stale_code
from evermap.existence import elementary
from evermap.existence.elementary import exp, expm1, inlined, kernel, parallel_kernel

drop_stale_code(__file__, elementary.__file__)

__all__ = ["exp", "expm1", "inlined", "kernel", "parallel_kernel"]
