"""A figure, what is better, how far it may move by itself, and what a comparison of two files of figures says."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from evermap.errors import InputError
from evermap.io.files import write_atomic

SCHEMA_VERSION = 1
DONE, ABSENT, FAILED = "done", "absent", "failed"
"""What came of a part: all its figures; nothing, since its recording is not here; an error."""


class Kind(NamedTuple):
    """What figures of a kind have in common.

    Attributes:
        group: accuracy, consistency, changes, beliefs or cost.
        better: lower; higher; equal, where any change needs a reason; one, for ratios to what is expected, and
            at_most_one where only too large a ratio says anything.
        tolerance: relative, of the logarithm for the ratios.
        floor: absolute, in the unit of the figure.
    """

    group: str
    better: str
    tolerance: float = 0.03
    floor: float = 0.0


KINDS: dict[str, Kind] = {
    "position_m": Kind("accuracy", "lower", floor=0.0005),
    "turn_deg": Kind("accuracy", "lower", floor=0.01),
    "landmarks_m": Kind("accuracy", "lower", floor=0.0005),
    "association": Kind("accuracy", "higher", 0.01),
    "tracking": Kind("accuracy", "higher", 0.01, 0.002),
    "objective": Kind("accuracy", "lower", 1e-4),
    "nees": Kind("consistency", "one", 0.05),
    "mapped_nees": Kind("consistency", "at_most_one", 0.05),  # a map that is the truth is better than it states
    "nis": Kind("consistency", "one", 0.05),
    "correlation": Kind("consistency", "lower", 0.05, 0.02),
    "level": Kind("consistency", "equal", 0.03, 0.0005),
    "right": Kind("changes", "higher", 0.0),
    "false": Kind("changes", "lower", 0.0),
    "missed": Kind("changes", "lower", 0.0),
    "off_m": Kind("changes", "lower", 0.05, 0.002),
    "score": Kind("beliefs", "lower", floor=0.0003),
    "share": Kind("beliefs", "higher", 0.01, 0.003),
    "cpu_s": Kind("cost", "lower", 0.25, 0.3),
    "frame_ms": Kind("cost", "lower", 0.5, 5.0),
    "over_peer": Kind("cost", "lower", 0.25, 0.1),
    "over_iteration": Kind("cost", "lower", 0.25, 1.0),
    "factorisations": Kind("cost", "lower", 0.03),
    "count": Kind("cost", "lower", 0.03),
}  # fmt: skip
"""Kinds of figures; the last word of a figure's name is its kind. Costs have room for other work on the machine."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A number of a run.

    Attributes:
        name: `part/what/kind`, or `part/kind`.
        value: None where there is nothing to count, as the error of moves when none was reported.
        group, better, tolerance, floor: of its `Kind`.
    """

    name: str
    value: float | None
    group: str
    better: str
    tolerance: float
    floor: float

    @classmethod
    def of(cls, name: str, value: float | None) -> Figure:
        """Return a figure of the kind that its name ends with; values that are not finite are None.

        Raises:
            KeyError: there is no such kind.
        """
        kind = KINDS[name.rpartition("/")[2]]
        known = value is not None and math.isfinite(value)
        return cls(name, float(value) if known and value is not None else None, *kind)


@dataclass
class Figures:
    """Figures of one run.

    Attributes:
        figures: by name, in the order of computation.
        parts: of each part that was asked for: `state`, `line` (what is absent, or the error) and `cpu_s`.
        about: commit, versions, machine.
    """

    figures: dict[str, Figure]
    parts: dict[str, dict[str, Any]]
    about: dict[str, Any]

    def write(self, path: Path) -> None:
        """Write all as JSON, whole or not at all."""
        content = {
            "schema_version": SCHEMA_VERSION,
            "about": self.about,
            "parts": self.parts,
            "figures": [asdict(figure) for figure in self.figures.values()],
        }
        write_atomic(path, json.dumps(content, indent=1, allow_nan=False) + "\n")

    @classmethod
    def read(cls, path: Path) -> Figures:
        """Read what `write` wrote.

        Raises:
            InputError: it is missing or something else.
        """
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            figures = {row["name"]: Figure(**row) for row in content["figures"]}
            return cls(figures, dict(content["parts"]), dict(content["about"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                "is no file of goldens", path=path, hint="python -m benchmarks.goldens --out it"
            ) from error


class Row(NamedTuple):
    """A line of the comparison: `verdict` is worse, better, changed, missing, new or same."""

    name: str
    before: float | None
    after: float | None
    verdict: str
    note: str = ""


LEAST_RATIO = 1e-9
"""Ratios below are taken for this one."""
BAD = ("worse", "changed", "missing")
"""Verdicts for which a comparison fails."""


def judge(before: Figure, after: Figure) -> str:
    """Return the verdict on one figure: worse, better, changed or same, by the kind that it was."""
    old, new = before.value, after.value
    if old is None or new is None:
        return "same" if old is new else "worse" if new is None else "better"
    better = before.better
    if better in ("one", "at_most_one"):
        lowest = 1.0 if better == "at_most_one" else LEAST_RATIO
        far = [abs(math.log(max(value, lowest))) for value in (old, new)]
        step, allowed = far[1] - far[0], before.tolerance
    else:
        step, allowed = new - old, max(before.tolerance * abs(old), before.floor)
        step = -step if better == "higher" else abs(step) if better == "equal" else step
    if abs(step) <= allowed:
        return "same"
    return "changed" if better == "equal" else "worse" if step > 0.0 else "better"


def compare(before: Figures, after: Figures) -> list[Row]:
    """Return a row for every figure of the parts that both ran, and for every part that failed in the second.

    A part whose recording is absent in either, or that either was not asked for, is not compared.
    """
    rows = []
    for part, was in before.parts.items():
        now = after.parts.get(part)
        if now is None or ABSENT in (was["state"], now["state"]):
            continue
        if now["state"] == FAILED:
            verdict = "same" if was["state"] == FAILED else "worse"
            rows.append(Row(part, None, None, verdict, f"fails: {now['line']}"))
            continue
        if was["state"] == FAILED:
            rows.append(Row(part, None, None, "better", f"no longer fails: {was['line']}"))
        rows += _rows(_of(before, part), _of(after, part))
    return rows


def _of(figures: Figures, part: str) -> dict[str, Figure]:
    return {name: figure for name, figure in figures.figures.items() if name.partition("/")[0] == part}


def _rows(before: Mapping[str, Figure], after: Mapping[str, Figure]) -> Iterable[Row]:
    for name, old in before.items():
        note = {"equal": "", "one": "1 is best", "at_most_one": "1 or less"}.get(old.better, f"{old.better} is better")
        if name in after:
            yield Row(name, old.value, after[name].value, judge(old, after[name]), note)
        else:
            yield Row(name, old.value, None, "missing", note)
    yield from (Row(name, None, new.value, "new") for name, new in after.items() if name not in before)


def as_text(before: Figures, after: Figures, rows: Sequence[Row]) -> str:
    """Return what moved as aligned text, bad first, and a line that sums up."""
    order = ("worse", "missing", "changed", "better", "new", "same")
    moved = sorted((row for row in rows if row.verdict != "same"), key=lambda row: order.index(row.verdict))
    width = max((len(row.name) for row in moved), default=0)
    lines = [
        f"{row.verdict:<8} {row.name:<{width}} {_number(row.before):>10} {_number(row.after):>10}"
        f" {_change(row):>8}  {row.note}".rstrip()
        for row in moved
    ]
    count = {verdict: sum(row.verdict == verdict for row in rows) for verdict in order}
    skipped = sorted(part for part in before.parts.keys() | after.parts.keys() if not _compared(part, before, after))
    lines.append(
        f"{before.about.get('commit', '?')} -> {after.about.get('commit', '?')}: {len(rows)} figures, "
        + ", ".join(f"{n} {verdict}" for verdict, n in count.items())
        + (f"; not compared: {', '.join(skipped)}" if skipped else "")
    )
    return "\n".join(lines)


def _compared(part: str, before: Figures, after: Figures) -> bool:
    return all(part in each.parts and each.parts[part]["state"] != ABSENT for each in (before, after))


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _change(row: Row) -> str:
    if row.before is None or row.after is None or row.before == 0.0:
        return ""
    return f"{row.after / row.before - 1.0:+.1%}"
