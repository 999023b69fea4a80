"""The worlds of `evermap reproduce causes`, a line a run as it ends; and what has become better or worse since another.

python -m benchmarks.causes --quick                               # some forty worlds, two minutes of a core
python -m benchmarks.causes --part attacks --world laser --runs 1 # of each world that has this in its name
python -m benchmarks.causes --quick --rows after.jsonl            # keeps lines of JSON; goes on where it was stopped
python -m benchmarks.causes --compare before.jsonl after.jsonl    # exits with 1 if anything got worse
python -m benchmarks.causes --show after.jsonl
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from evermap_studies.causes import study
from evermap_studies.causes.catalogue import GROUPS
from evermap_studies.rows import read_rows

Row = dict[str, Any]
WORSE = 1.1
"""Factor of the error of poses from which a run is worse, beyond `WORSE_M`."""
WORSE_M = 0.003


def line_of(row: Row) -> str:
    """Return what a run said, in a line."""
    mark = "right" if row["right"] else "SILENT" if row["silent"] else "wrong"
    causes = ", ".join(f"{one['code']} {one['subject']} {one['value']}".replace(" None", "") for one in row["causes"])
    said = "; ".join(
        part
        for part in (
            row["verdict"] or "",
            f"causes: {causes}" if causes else "",
            f"check: {', '.join(row['findings'])}" if row["findings"] else "",
            f"changes: {' | '.join(row['changes'][:3])}" if row["changes"] else "",
            row["refusal"],
        )
        if part
    )
    errors = ", ".join(
        f"{name} {row[key]}" for name, key in (("bound", "bound_m"), ("odometry", "odometry_m"), ("nees", "nees"))
    )
    return (
        f"{mark:6s} {row['world']}, seed {row['seed']}: exit {row['exit']}, named by {row['named_by'] or 'nothing'}, "
        f"{row['false_changes']} false and {row['missed_changes']} missing changes, {row['error_m']} m ({errors}), "
        f"{row['cpu_s']} s; {said}"
    )


def compare(before: Sequence[Row], after: Sequence[Row]) -> tuple[list[str], list[str]]:
    """Return lines of the runs of both that are better, and of those that are worse."""
    old = {(row["world"], row["seed"]): row for row in before}
    better, worse = [], []
    for row in after:
        was = old.get((row["world"], row["seed"]))
        if was is None:
            continue
        level, former = (2 * one["right"] - one["silent"] for one in (row, was))
        error, earlier = (float("inf") if one["error_m"] is None else one["error_m"] for one in (row, was))
        less = error > WORSE * earlier + WORSE_M and row["exit"] == 0
        if level > former:
            better.append(line_of(row))
        elif level < former or less:
            worse.append(f"{line_of(row)}\n       was: {line_of(was)}")
    return better, worse


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line, with its arguments if none are given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", action="append", choices=GROUPS, help="repeatable")
    parser.add_argument("--world", action="append", default=[], help="part of a name; repeatable")
    parser.add_argument("--runs", type=int, default=20, help="seeds of a world, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--rows", type=Path, help="file of rows, which is continued")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"))
    parser.add_argument("--show", type=Path, metavar="ROWS")
    chosen = parser.parse_args(arguments)
    if chosen.compare:
        better, worse = compare(*(read_rows(path) for path in chosen.compare))
        print(*[f"better: {line}" for line in better], *[f"worse: {line}" for line in worse], sep="\n")
        return int(bool(worse))
    if chosen.show:
        rows = read_rows(chosen.show)
        print(*map(line_of, rows), sep="\n")
    else:
        groups = tuple(chosen.part) if chosen.part else GROUPS
        settings = study.Settings(groups, tuple(chosen.world), chosen.runs, chosen.seed, quick=chosen.quick)
        rows = []
        for row in study.run_all(study.planned(settings), chosen.rows):
            rows.append(row)
            print(line_of(row), flush=True)
    print("\n" + study.as_markdown({"runs": rows}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
