"""What a person or a program wants to know of a lifetime prior, for the verbs that show one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from evermap.survival import LifetimePrior


def lifetime_numbers(prior: LifetimePrior) -> dict[str, float | None]:
    """Quartiles and mean in seconds, None for what never comes; and the share that never leaves."""
    quartiles = [float(prior.quantile(p)) for p in (0.25, 0.5, 0.75)]
    values = dict(zip(("quarter_gone_s", "half_gone_s", "three_quarters_gone_s"), quartiles, strict=True))
    values["mean_stay_s"] = prior.mean()
    return {k: v if math.isfinite(v) else None for k, v in values.items()} | {"p_never_leaves": prior.p_never_leaves}


def lifetime_lines(numbers: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The same in words."""
    from evermap.survival.durations import duration_text

    names = {
        "quarter_gone_s": "a quarter is gone after",
        "half_gone_s": "half are gone after",
        "three_quarters_gone_s": "three quarters after",
    }
    lines = [(title, duration_text(math.inf if numbers[key] is None else numbers[key])) for key, title in names.items()]
    if numbers["mean_stay_s"] is not None:
        lines.append(("mean stay", duration_text(numbers["mean_stay_s"])))
    if numbers["p_never_leaves"]:
        lines.append(("never leave", f"{100.0 * numbers['p_never_leaves']:.3g} %"))
    return lines
