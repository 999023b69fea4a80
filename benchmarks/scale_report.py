"""What `scale` and `scale_maps` measured, as tables and as a figure."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CONTENDERS = {
    "evermap": "evermap",
    "mapped": "evermap, into a new map",
    "plain": "evermap, plain",
    "lm": "gtsam LM, from 0.5 m off",
    "lm_odometry": "gtsam LM, from odometry",
    "isam2": "gtsam iSAM2",
}
"""Columns of a row, as tables and figures call them."""
UNKNOWN = "–"
DENSE = Path(__file__).resolve().parent / "scale_dense.json"
"""What sessions cost with an estimator that was dense in the landmarks, to compare with."""
FRAMES = {"median_ms": "median", "p99_ms": "99 % below", "longest_ms": "longest"}


def as_markdown(shown: dict[str, Any]) -> str:
    """Return the tables: claims, sessions, objectives, exponents, frames, and what else was measured."""
    rows = shown["sessions"]
    tables = [
        claims(shown),
        _sessions(rows),
        _objectives(rows),
        _exponents(shown["exponents"]),
        _streams([shown["stream"], *rows]),
    ]
    if shown.get("dlr") is not None:
        tables.append(_dlr(shown["dlr"]))
    if "maps" in shown:
        tables += _maps(shown["maps"])
    return "\n\n".join(tables)


def claims(shown: dict[str, Any]) -> str:
    """Return a table of what is expected of sessions, frames, DLR and maps, and whether it is met."""
    rows = [row for row in shown["sessions"] if "evermap" in row]
    found = [_claim(f"{_TIME} {row['landmarks']:,} landmarks", 1.5, _ratio(row)) for row in rows]
    found += [
        _claim(f"{_MAPPED} {row['landmarks']:,} landmarks", 2.0, _ratio(row, "mapped"))
        for row in rows
        if "mapped" in row
    ]
    if "evermap" in shown["exponents"]:
        over = shown["exponents"]["evermap"]["landmarks"]
        span = f"{rows[0]['landmarks']:,} to {rows[-1]['landmarks']:,}"
        found.append(_claim(f"exponent of the CPU time of a session over landmarks, {span}", 1.15, over))
    for row in rows:
        if row["landmarks"] >= MANY and "evermap" in row.get("memory", {}):
            what = f"memory of a session of {row['landmarks']:,} landmarks"
            found.append(_claim(what, 1500.0, row["memory"]["evermap"]["peak_mb"], "MB"))
    if compared := [row for row in rows if "plain" in row]:
        worst = max(row["plain"]["objective"] / row["best"] - 1.0 for row in compared)
        found.append(_claim("objective of the plain problem above gtsam's best", 1e-6, worst))
    if "evermap" in shown["stream"]:
        stream = shown["stream"]
        seen = stream["sightings"] / stream["poses"]
        of = f"in a session of {stream['landmarks']:,} landmarks, {seen:.0f} in view"
        for name, limit in {"median_ms": 0.3, "p99_ms": 5.0, "longest_ms": 20.0}.items():
            found.append(_claim(f"frame {of}: {FRAMES[name]}", limit, shown["stream"]["evermap"][name], "ms"))
    if shown.get("dlr") is not None:
        found.append(_claim("DLR with identities", 1.5, shown["dlr"]["evermap"]["cpu_s"], "s"))
        above = shown["dlr"]["plain"]["objective"] / shown["dlr"]["best"] - 1.0
        found.append(_claim("DLR: objective of the plain problem above gtsam's best", 1e-6, above))
    if "maps" in shown:
        found += _claims_of_maps(shown["maps"])
    return _table(["", "expected", "measured", "met"], found, left=1)


YEAR = 10_000
"""Sessions of a building that are claimed: a year."""
MANY = 4_000
"""Landmarks from which a session's memory is claimed."""
_TIME = "CPU time of a session, over gtsam's LM alone:"
_MAPPED = "CPU time of a session into a new map, over gtsam's LM alone:"


def _claims_of_maps(shown: dict[str, Any]) -> list[list[str]]:
    into, localised, opened = (shown[name] for name in ("bring_in", "localise", "opened"))
    over = f"{into[-1]['places']:,} over {into[0]['places']:,} places"
    return [
        _claim(f"time of a session of 200 landmarks brought into a map, {over}", 1.2, _grows(into, "cpu_s")),
        _claim(f"memory of such a session, {over}", 1.2, _grows(into, "peak_mb")),
        _claim("a map's file grows in a session of 200 landmarks by, recording apart", 1.0, _growth_mb(into), "MB"),
        _claim("localisation: start from an unknown pose", 0.5, _worst(localised, "start_s"), "s"),
        _claim("localisation: 99 % of steps below", 3.0, _worst(localised, "p99_ms"), "ms"),
        _claim(f"localisation: median step, {over}", 1.3, _grows(localised, "median_ms")),
        _claim(f"opening a map of {opened[-1]['places']:,} places", 0.3, _worst(opened, "load_s"), "s"),
        _claim("memory of opening it", 300.0, _worst(opened, "grown_mb"), "MB"),
        *(
            _claim(f"{YEAR:,} sessions of a building, last over first: {label}", 1.2, _over(shown["building"], name))
            for name, label in _BUILDING.items()
        ),
    ]


def _over(building: dict[str, Any], name: str) -> float | str:
    """The ratio of a year of sessions; fewer of them show no growth, and are not taken for it."""
    if "not_run" in building:
        return f"not run: {building['not_run']}"
    ratio = float(building["ratio"][name])
    return ratio if building["sessions"] >= YEAR else f"not run; {ratio:.2f} in {building['sessions']} sessions"


def _grows(rows: Sequence[dict[str, Any]], name: str) -> float | str:
    """Largest value over the smallest, over all sizes; why not, where one was not run."""
    return _each(rows, name, lambda values: max(values) / min(values))


def _growth_mb(rows: Sequence[dict[str, Any]]) -> float | str:
    """Largest growth of a file, without the recording that is kept in it, which is that of the session alone."""
    without = [
        row | {"map_mb": row["file_grown_mb"] - row["recording_mb"]} if "not_run" not in row else row for row in rows
    ]
    return _worst(without, "map_mb")


def _worst(rows: Sequence[dict[str, Any]], name: str) -> float | str:
    return _each(rows, name, max)


def _each(rows: Sequence[dict[str, Any]], name: str, of: Callable[[list[float]], float]) -> float | str:
    missing = next((row for row in rows if "not_run" in row), None)
    if missing is not None:
        return f"not run: {missing['places']:,} places, {missing['not_run']}"
    return of([row[name] for row in rows])


def _claim(name: str, limit: float, value: float | str, unit: str = "") -> list[str]:
    """A row: what was measured may be at most `limit`; a text says why it was not."""
    most = f"≤ {limit:,g} {unit}".strip()
    if isinstance(value, str):
        return [name, most, value, "**no**"]
    return [name, most, f"{_number(value)} {unit}".strip(), "yes" if value <= limit else "**no**"]


def _ratio(row: dict[str, Any], ours: str = "evermap") -> float:
    """CPU time with all covariances over that of Levenberg-Marquardt, whose marginals are not counted."""
    return float(row[ours]["cpu_s"] / _alone_s(row))


def _alone_s(row: dict[str, Any], start: str = "lm") -> float:
    return float(row[start]["cpu_s"] - row[start]["marginals_cpu_s"])


def figure(shown: dict[str, Any], before: dict[str, Any] | None = None) -> Figure:
    """Draw CPU time and memory over landmarks, both logarithmic, peers beside.

    Args:
        shown: what `scale.run` returned.
        before: the same of an older estimator, drawn dashed.
    """
    from matplotlib.figure import Figure

    from evermap.viz import style

    looks = {
        "evermap": (style.ESTIMATE, "o", "-"),
        "lm": (style.ODOMETRY, "s", "-"),
        "isam2": (style.ONLINE, "D", "-"),
        "before": (style.MUTED, "o", "--"),
    }
    series: list[tuple[str, str, Sequence[dict[str, Any]]]] = [
        ("evermap", "evermap", shown["sessions"]),
        ("lm", "lm", shown["sessions"]),
        ("isam2", "isam2", shown["sessions"]),
        ("before", "evermap", [] if before is None else before["sessions"]),
    ]
    labels = {
        "evermap": "evermap: poses, map, calibration, noise",
        "lm": "gtsam LM: poses, map, marginals",
        "isam2": "gtsam iSAM2: poses, map",
        "before": "evermap, dense, of 2026-11-22",
    }
    drawn = Figure(figsize=(8.4, 4.4), layout="constrained")
    times, peaks = drawn.subplots(1, 2)
    for name, key, rows in series:
        timed = [row for row in rows if key in row]
        _line(times, timed, lambda row, key=key: row[key]["cpu_s"], looks[name], labels[name])
        who = {"evermap": "evermap", "lm": "gtsam"}.get(key, "")
        kept = [row for row in rows if who in row.get("memory", {})]
        _line(peaks, kept, lambda row, who=who: row["memory"][who]["grown_mb"], looks[name], labels[name])
    _as_log_log(times, "CPU time of a session [s]")
    _as_log_log(peaks, "memory that a session adds [MB]")
    handles, names = times.get_legend_handles_labels()
    drawn.legend(handles, names, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return drawn


def write(shown: dict[str, Any], folder: Path) -> None:
    """Write `table.md`, `cost.png` and `scale.json` into a folder, from which `docs/gen/results.py` takes them."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "table.md").write_text(as_markdown(shown) + "\n", encoding="utf-8")
    (folder / "scale.json").write_text(json.dumps(shown, indent=2) + "\n", encoding="utf-8")
    before = json.loads(DENSE.read_text(encoding="utf-8"))
    figure(shown, before).savefig(folder / "cost.png", dpi=150)


def is_stuck(row: dict[str, Any], key: str) -> bool:
    """Return whether a peer stayed in another optimum, so that its time compares with nothing."""
    return "objective" in row[key] and "best" in row and row[key]["objective"] > 1.01 * row["best"]


def _line(
    axes: Axes,
    rows: Sequence[dict[str, Any]],
    value: Callable[[dict[str, Any]], float],
    look: tuple[str, str, str],
    label: str,
) -> None:
    """One contender's values over landmarks."""
    if rows:
        colour, marker, line = look
        size = [row["landmarks"] for row in rows]
        axes.plot(size, [value(row) for row in rows], line, color=colour, marker=marker, markersize=5, label=label)


def _as_log_log(axes: Axes, what: str) -> None:
    """Logarithmic scales with plain numbers, and a line of slope one to compare with."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    from evermap.viz import style

    axes.set_xscale("log")
    axes.set_yscale("log")
    points = [(float(x), float(y)) for line in axes.lines for x, y in np.asarray(line.get_xydata())]
    if points:
        size = sorted({x for x, _ in points})
        ends = np.array([size[0], size[-1]])
        low = min(y for x, y in points if x == size[0])
        axes.plot(ends, 0.5 * low * ends / size[0], ":", color=style.MUTED, linewidth=1.2, label="in proportion")
        axes.set_xticks(size)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axes.set_xlabel("landmarks; the drive grows with them")
    axes.set_ylabel(what)
    axes.grid(color=style.GRID, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def _number(value: float) -> str:
    """Three digits, and thousands without an exponent."""
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 0) -> str:
    """A Markdown table, its first `left` columns aligned to the left."""
    lines = [head, ["---" if k < left else "---:" for k in range(len(head))], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _sessions(rows: Sequence[dict[str, Any]]) -> str:
    names = [key for key in CONTENDERS if any(key in row for row in rows)]
    head = ["landmarks", "drive", "poses", "sightings", *(f"{CONTENDERS[key]} [s]" for key in names)]
    head += ["gtsam LM, without marginals [s]", "evermap / it", "evermap [MB]", "gtsam [MB]"]
    table = []
    for row in rows:
        cells = [f"{row['landmarks']:,}", f"{row['minutes']:.0f} min", f"{row['poses']:,}", f"{row['sightings']:,}"]
        cells += [_seconds(row, key) for key in names]
        cells += [_number(_alone_s(row)), f"{_ratio(row):.2f}" if "evermap" in row else UNKNOWN]
        grown = [row.get("memory", {}).get(who) for who in ("evermap", "gtsam")]
        table.append([*cells, *(UNKNOWN if found is None else f"{found['grown_mb']:.0f}" for found in grown)])
    return _table(head, table)


def _seconds(row: dict[str, Any], key: str) -> str:
    if key not in row:
        return UNKNOWN
    return f"{_number(row[key]['cpu_s'])}{' (another optimum)' if is_stuck(row, key) else ''}"


def _objectives(rows: Sequence[dict[str, Any]]) -> str:
    head = ["landmarks", "objective above gtsam's best", *(f"landmarks off, {who} [cm]" for who in _ACCURATE.values())]
    table = []
    for row in rows:
        if "plain" in row:
            off = [f"{100 * row[key]['rmse_m']:.1f}" for key in _ACCURATE]
            table.append([f"{row['landmarks']:,}", f"{row['plain']['objective'] / row['best'] - 1.0:.1e}", *off])
    return _table(head, table)


_ACCURATE = {"evermap": "evermap", "plain": "plain", "lm": "gtsam"}


def _exponents(found: dict[str, dict[str, float]]) -> str:
    rows = [
        [CONTENDERS[key], f"{by['landmarks']:.2f}", f"{by['landmarks_times_time']:.2f}"] for key, by in found.items()
    ]
    return _table(["exponent of CPU time over", "landmarks", "landmarks x time driven"], rows, left=1)


def _streams(rows: Sequence[dict[str, Any]]) -> str:
    head = ["landmarks", "detected in a frame"]
    head += [f"{who} frame, {label} [ms]" for who in ("evermap", "iSAM2") for label in FRAMES.values()]
    table = []
    for row in rows:
        cells = [f"{row['landmarks']:,}", f"{row['sightings'] / row['poses']:.1f}"]
        for key in ("evermap", "isam2"):
            found = row.get(key, {})
            cells += [_number(found[name]) if name in found else UNKNOWN for name in FRAMES]
        if set(cells[2:]) != {UNKNOWN}:
            table.append(cells)
    return _table(head, table)


def _dlr(row: dict[str, Any]) -> str:
    head = ["DLR: landmarks", "poses", "sightings", "evermap [s]", "evermap, plain [s]", "gtsam LM, from odometry [s]"]
    head += ["gtsam LM, without marginals [s]", "objective above gtsam's best"]
    cells = [f"{row[name]:,}" for name in ("landmarks", "poses", "sightings")]
    cells += [_seconds(row, key) for key in ("evermap", "plain", "lm_odometry")]
    above = row["plain"]["objective"] / row["best"] - 1.0
    return _table(head, [[*cells, _number(_alone_s(row, "lm_odometry")), f"{above:.1e}"]])


_MAP_TABLES = {
    "bring_in": (
        "a session of 200 landmarks into a map of",
        {
            "CPU [s]": "cpu_s",
            "memory [MB]": "grown_mb",
            "file grows by [MB]": "file_grown_mb",
            "of it the recording": "recording_mb",
        },
    ),
    "localise": (
        "localisation in a map of",
        {"start [s]": "start_s", "step, median [ms]": "median_ms", "99 % below [ms]": "p99_ms", "off [m]": "off_m"},
    ),
    "opened": (
        "opening to localise a map of",
        {"load [s]": "load_s", "first 3 s located [s]": "cpu_s", "memory [MB]": "grown_mb", "file [MB]": "file_mb"},
    ),
}
_BUILDING = {
    "cpu_s_per_minute": "CPU seconds a minute driven",
    "file_mb": "file grows by [MB]",
    "resident_mb": "memory [MB]",
}


def _maps(shown: dict[str, Any]) -> list[str]:
    tables = []
    for key, (title, columns) in _MAP_TABLES.items():
        rows = []
        for row in shown[key]:
            found = [f"not run: {row['not_run']}", *[""] * (len(columns) - 1)] if "not_run" in row else None
            cells = found or [_number(row[name]) for name in columns.values()]
            rows.append([f"{row['places']:,} places", *cells])
        tables.append(_table([title, *columns], rows, left=1))
    done = shown["building"]
    if "not_run" not in done:
        count = done["compared"]
        rows = [
            [label, _number(done["first"][name]), _number(done["last"][name]), f"{done['ratio'][name]:.2f}"]
            for name, label in _BUILDING.items()
        ]
        head = [f"{done['sessions']:,} sessions of a building", f"first {count}", f"last {count}", "ratio"]
        tables.append(_table(head, rows, left=1))
    return tables
