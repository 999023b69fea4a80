"""The reference numbers of Rosen 2016, and how far ours are from them in standard errors."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evermap.errors import InputError

FILE = "rosen2016.json"
_ESTIMATORS = {
    "uniform": "uniform",
    "gp": "general_purpose",
    "empirical_fixed": "empirical",
    "empirical_as_coded": "empirical_as_coded",
}
_BASE = {"P_M": 0.1, "P_F": 0.1, "lambda_R": 0.02}
"""What the figures hold constant unless their rows say otherwise."""
_FIG4_SEQUENCES = 6000
"""How many sequences the reference drew for figure 4; its rows tell how many of them had a precision or a recall."""

Key = tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Reference:
    """A number to agree with: mean over `n` sequences; `se` is None where the reference does not tell it."""

    value: float
    se: float | None
    n: int


def key_of(value: Mapping[str, Any]) -> Key:
    """What tells one value from another; settings rounded, since 1/50 and 0.02 may differ in the last digit."""
    settings = (value[name] for name in ("p_miss", "p_false", "revisit_rate_hz", "threshold"))
    rounded = (None if setting is None else round(setting, 9) for setting in settings)
    return (value["figure"], value["metric"], value["estimator"], *rounded)


def read_reference(folder: Path) -> dict[Key, Reference]:
    """All numbers of `rosen2016.json`.

    Raises:
        InputError: no such file, or not what is expected in it.
    """
    path = folder / FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return dict(_entries(content))
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise InputError(problem, path=path, hint=f"--data FOLDER with {FILE}") from error
    except (ValueError, TypeError) as error:
        raise InputError(f"is not what is expected: {error}", path=path) from error
    except KeyError as error:
        raise InputError("a row lacks a field", path=path, field=str(error.args[0])) from error


def _entries(content: Mapping[str, Any]) -> Iterator[tuple[Key, Reference]]:
    for figure, rows in (("3abc", content["fig3_grid"]), ("3d", content["fig3d"])):
        for row in rows:
            for short, name in _ESTIMATORS.items():
                yield _key(figure, "l1_error", name, row), Reference(row[short], row[f"{short}_se"], int(row["n"]))
            yield _key(figure, "looks", None, row), Reference(row["mean_num_obs"], None, int(row["n"]))
    for row in content["fig4"]:
        name = _ESTIMATORS[row["estimator"]]
        threshold = None if row["P_V"] == "None" else float(row["P_V"])
        for metric in ("precision", "recall"):
            count = int(row[f"n_{metric}"])
            mean = Reference(row[metric], row[f"{metric}_se"], count)
            share = Reference(count / _FIG4_SEQUENCES, None, _FIG4_SEQUENCES)
            yield _key("4", metric, name, row, threshold), mean
            yield _key("4", f"{metric}_known", name, row, threshold), share


def _key(
    figure: str, metric: str, estimator: str | None, row: Mapping[str, Any], threshold: float | None = None
) -> Key:
    where = {**_BASE, **row}
    return key_of(
        {
            "figure": figure,
            "metric": metric,
            "estimator": estimator,
            "p_miss": where["P_M"],
            "p_false": where["P_F"],
            "revisit_rate_hz": where["lambda_R"],
            "threshold": threshold,
        }
    )


def compare(values: Sequence[dict[str, Any]], reference: Mapping[Key, Reference]) -> None:
    """Add `reference`, `reference_se`, `reference_n` and `z` to every value that has a reference.

    `z` is the difference over its own standard error. Where the reference tells no standard error, the spread of our
    sequences stands for it; shares of sequences have the pooled one.
    """
    for value in values:
        known = reference.get(key_of(value))
        if known is None:
            continue
        value["reference"], value["reference_n"] = known.value, known.n
        value["reference_se"] = _standard_error(value, known)
        value["z"] = _z(value, known)


def _standard_error(value: Mapping[str, Any], known: Reference) -> float | None:
    if known.se is not None or value["se"] is None:
        return known.se
    return float(value["se"]) * math.sqrt(value["n"] / known.n)


def _z(value: Mapping[str, Any], known: Reference) -> float | None:
    if value["value"] is None:
        return None
    difference = value["value"] - known.value
    if value["metric"].endswith("_known"):
        pooled = (value["value"] * value["n"] + known.value * known.n) / (value["n"] + known.n)
        variance = pooled * (1.0 - pooled) * (1.0 / value["n"] + 1.0 / known.n)
    else:
        variance = (value["se"] or 0.0) ** 2 + (value["reference_se"] or 0.0) ** 2
    if difference == 0.0:
        return 0.0
    return float(difference / math.sqrt(variance)) if variance > 0.0 else None
