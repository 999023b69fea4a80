"""The report of an audit, to hand on: JSON, Markdown, a page, the plan; and the corrected file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from evermap.io.map_formats import SurveyFile, write_corrected
from evermap.io.spatial import AT, QUATERNION
from evermap.runs.audit.entries import DECIDED, FEWEST
from evermap.runs.audit.result import ORDER, Audit, AuditDrive, AuditEntry, EntryState, count_states, format_percent
from evermap.runs.folder import RunFolder
from evermap.runs.summary import RunInfo, summary_head
from evermap.types import Clock, json_number, stamp_text

HEAD = ("entry", "what", "moved by", "turned by", "when", "probability", "seen", "remark")
_FEW = 12
"""Labels that are listed in a line."""


def audit_dict(audit: Audit, file: SurveyFile, written: Path | None = None) -> dict[str, Any]:
    """Return an audit as plain values under stable keys."""
    return {
        "map": str(file.path),
        "format": file.format.name,
        "clock": audit.clock.value,
        "verdict": conclude(audit)[0],
        "message": conclude(audit)[1],
        "counts": count_states(audit.entries),
        "written": None if written is None else str(written),
        "entries": [_entry_dict(entry) for entry in audit.entries],
        "drives": [
            {
                "name": drive.name,
                "source": drive.source,
                "from_s": json_number(drive.from_s),
                "to_s": json_number(drive.to_s),
                "detections": drive.n_detections,
                "counts": drive.is_heard,
                "reason": drive.reason,
                "of_map": drive.of_map,
                "sensor": list(drive.sensor),
                "warnings": list(drive.warnings),
            }
            for drive in audit.drives
        ],
    }


def _entry_dict(entry: AuditEntry) -> dict[str, Any]:
    at = dict(zip(AT, map(json_number, entry.position_m.tolist()), strict=False))
    turn = (
        dict.fromkeys(QUATERNION)
        if entry.rotation is None
        else dict(zip(QUATERNION, entry.rotation.tolist(), strict=True))
    )
    return {
        "landmark": entry.landmark_id,
        "label": entry.label,
        "state": entry.state.value,
        "probability": json_number(entry.probability),
        "displacement_m": [json_number(metres) for metres in entry.displacement_m.tolist()],
        "distance_m": json_number(entry.distance_m),
        "sigma_m": json_number(entry.sigma_m),
        "turn_rad": json_number(entry.turn_rad),
        "turn_sigma_rad": json_number(entry.turn_sigma_rad),
        "stamp_from_s": json_number(entry.from_s),
        "stamp_to_s": json_number(entry.to_s),
        **at,
        **turn,
        "hits": entry.n_hits,
        "misses": entry.n_misses,
        "drives": entry.n_drives,
        "exchanged_with": None if entry.like_id < 0 else entry.like_id,
        "corrected": [name for name, done in (("position", entry.moved), ("rotation", entry.turned)) if done]
        if entry.like_id < 0
        else ["position", "rotation"],
        "reason": entry.reason,
    }


def conclude(audit: Audit) -> tuple[str, str]:
    """Return the verdict on a map, 'right', 'wrong' or 'untested', and a sentence on it."""
    if not audit.is_heard:
        return "untested", f"nothing can be said of the map: {audit.drives[0].reason}"
    if audit.of_map:
        return "wrong", f"the map as a whole is wrong: {audit.of_map}; mend that first, entries were not judged"
    counts = count_states(audit.entries)
    faults = len(audit.faults)
    tested = counts["right"] + sum(entry.state is not EntryState.MISSING for entry in audit.faults)
    of = f"{tested} of {len(audit.given)} entries were tested"
    open_ones = [f"{counts[name]} {name}" for name in ("undecided", "unseen") if counts[name]]
    rest = f"; {' and '.join(open_ones)}" if open_ones else ""
    if not faults:
        return "right", f"no entry is wrong; {of}{rest}"
    said = ", ".join(
        f"{counts[state.value]} {state.value}" for state in ORDER if state.is_fault and counts[state.value]
    )
    return "wrong", f"{said}; {of}{rest}"


def _format_sigma(sigma_m: float) -> str:
    """Return a standard deviation in centimetres, in millimetres where it is below one: never as nothing."""
    return f"{sigma_m:.2f}" if not sigma_m < 0.01 else f"{max(sigma_m, 0.001):.3f}"


def entry_row(entry: AuditEntry, clock: Clock) -> tuple[str, ...]:
    """Return the cells of an entry, under `HEAD`."""
    moved = entry.state in (EntryState.WRONG, EntryState.STALE, EntryState.EXCHANGED, EntryState.UNDECIDED)
    known = moved and math.isfinite(entry.distance_m)
    way = ", ".join(f"{round(metres, 2) + 0.0:+.2f}" for metres in entry.displacement_m.tolist())
    far = f"{entry.distance_m:.2f} ± {_format_sigma(entry.sigma_m)} m ({way})" if known else "-"
    turned = known and math.isfinite(entry.turn_rad)
    turn = f"{math.degrees(entry.turn_rad):.1f} ± {math.degrees(entry.turn_sigma_rad):.1f}°" if turned else "-"
    if entry.state is EntryState.MISSING:
        far = f"at ({', '.join(f'{metres:.2f}' for metres in entry.position_m)}) ± {_format_sigma(entry.sigma_m)} m"
    seen = f"{entry.n_hits} ×" + (f", missed {entry.n_misses} ×" if entry.n_misses and not entry.n_hits else "")
    if entry.n_drives > 1:
        seen += f" in {entry.n_drives} drives"
    return (
        entry.label,
        entry.state.value,
        far,
        turn,
        when_text(entry, clock),
        _percent(entry),
        seen,
        entry.reason or "-",
    )


def when_text(entry: AuditEntry, clock: Clock) -> str:
    """Return since when an entry is not as the map has it."""
    if not entry.state.is_fault or entry.state is EntryState.MISSING or not math.isfinite(entry.to_s):
        return "-"
    if entry.state is EntryState.GONE and clock is Clock.RECORDING:
        return "before it was looked for"
    late = stamp_text(entry.to_s, clock)
    if not math.isfinite(entry.from_s):
        return f"before {late}" if clock is not Clock.RECORDING else "before it was first seen"
    return f"{stamp_text(entry.from_s, clock)} to {late}"


def _percent(entry: AuditEntry) -> str:
    p = entry.probability
    if not math.isfinite(p) or entry.state is EntryState.RIGHT:
        return "-"
    return format_percent(p)


def is_doubtful(entry: AuditEntry) -> bool:
    """Return whether an entry is undecided because it may be wrong, and not because it was seen too few times."""
    return entry.state is EntryState.UNDECIDED and not entry.probability <= 1.0 - DECIDED


def is_judged(audit: Audit) -> bool:
    """Return whether anything can be said of single entries."""
    return audit.is_heard and not audit.of_map


def list_rows(audit: Audit, *, everything: bool = False) -> list[tuple[str, ...]]:
    """Return the rows of what is to be known: faults and what cannot be decided; or of every entry."""
    doubtful = is_judged(audit)
    told = [entry for entry in audit.entries if everything or entry.state.is_fault or (doubtful and is_doubtful(entry))]
    return [entry_row(entry, audit.clock) for entry in told]


def quiet_lines(audit: Audit) -> list[str]:
    """Return one line each on entries that are right, and on those that were never seen; none where none was judged."""
    if not is_judged(audit):
        return []
    lines = []
    few = f"seen fewer than {FEWEST} times"
    for state, word in ((EntryState.RIGHT, "right"), (EntryState.UNDECIDED, few), (EntryState.UNSEEN, "never seen")):
        mine = [entry for entry in audit.entries if entry.state is state and not is_doubtful(entry)]
        if mine:
            some = ", ".join(entry.label for entry in mine[:_FEW])
            more = f" and {len(mine) - _FEW} more" if len(mine) > _FEW else ""
            lines.append(f"{word} ({len(mine)}): {some}{more}")
        if state is EntryState.RIGHT:
            lines += [f"{entry.label}: right, but {entry.reason}" for entry in mine if entry.reason]
    return lines


def markdown(audit: Audit, file: SurveyFile, written: Path | None) -> str:
    """Return the report as Markdown."""
    title, message = f"Audit of {file.path.name}", conclude(audit)[1]
    lines = [f"# {title}", "", f"**{message[0].upper()}{message[1:]}.**", "", "![plan](figures/audit.png)", ""]
    rows = list_rows(audit)
    if rows:
        lines += ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
        lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
        lines.append("")
    lines += [f"- {line}" for line in quiet_lines(audit)]
    lines += ["", "## Drives", ""]
    lines += [f"- {drive_line(drive, audit.clock)}" for drive in audit.drives]
    sensor = sensor_lines(audit)
    lines += ["", "## The sensor", "", *[f"- {line}" for line in sensor]] if sensor else []
    if written is not None:
        lines += ["", "## The corrected file", "", _of_file(audit, file, written)]
    return "\n".join(lines) + "\n"


def _of_file(audit: Audit, file: SurveyFile, written: Path) -> str:
    count = len(audit.corrections())
    kept = [entry.label for entry in audit.entries if entry.state in (EntryState.GONE, EntryState.MISSING)]
    text = f"{written.name}: {file.format.title}, {count} entries corrected, every other byte as it was."
    return text + (f" Not touched, for you to decide: {', '.join(kept)} (gone, or missing)." if kept else "")


def drive_line(drive: AuditDrive, clock: Clock) -> str:
    """Return a drive in one line: when it was, and whether it counts."""
    span = f"{stamp_text(drive.from_s, clock)}, {drive.to_s - drive.from_s:.0f} s, {drive.n_detections:,} detections"
    if not drive.is_heard:
        return f"{drive.name}: {span}; not counted: {drive.reason}"
    return f"{drive.name}: {span}" + (f"; {drive.reason}" if drive.reason else "")


def sensor_lines(audit: Audit) -> list[str]:
    """Return what the sensors are off by, drive by drive."""
    several = len(audit.drives) > 1
    return [f"{drive.name}: {line}" if several else line for drive in audit.drives for line in drive.sensor]


def write_audit(
    out: str | Path, audit: Audit, file: SurveyFile, info: RunInfo, *, force: bool = False, inputs: Sequence[Any] = ()
) -> dict[str, Any]:
    """Write the folder of an audit: report.html, report.md, the plan, summary.json and the corrected file.

    Returns the content of `summary.json`.

    Raises:
        ConfigError: `out` must not or cannot be written.
    """
    from evermap.viz.style import house_style, save_png, save_svg

    with RunFolder(out, force=force, inputs=inputs) as folder:
        written = write_corrected(file, audit.corrections(), folder.path(f"corrected/{file.path.name}"))
        figure = plan_of(audit, file)
        with house_style():
            save_png(figure.figure, folder.path("figures/audit.png"))
            save_svg(figure.figure, folder.path("figures/audit.svg"))
        folder.path("report.md").write_text(markdown(audit, file, written), encoding="utf-8")
        folder.path("report.html").write_text(_page(audit, file, figure, written), encoding="utf-8")
        told = audit_dict(audit, file, Path(out) / "corrected" / file.path.name)
        warnings = [text for drive in audit.drives for text in drive.warnings]
        head = summary_head(info, config={}, source=str(file.path), timing={"total_s": info.total_s}, warnings=warnings)
        return folder.finish({**head, **told})


def plan_of(audit: Audit, file: SurveyFile) -> Any:
    """Return the plan, as a named figure."""
    from evermap.viz.audit_figure import PlanEntry, draw_audit

    row_of = {name: row for row, name in enumerate(audit.given.landmark_id.tolist())}
    nothing = np.full(audit.given.position_m.shape[1], np.nan)
    drawn = []
    for entry in audit.entries:
        row = row_of.get(entry.landmark_id)
        before = nothing if row is None else audit.given.position_m[row]
        turn = None if row is None or audit.given.rotation is None else audit.given.rotation[row]
        turn = turn if turn is not None and np.isfinite(turn).all() else None
        text = f"{entry.label}: {entry.distance_m:.2f} m"
        if math.isfinite(entry.turn_rad):
            text += f", {math.degrees(entry.turn_rad):.1f}°"
        drawn.append(PlanEntry(entry.label, entry.state.value, before, entry.position_m, entry.covariance_m2, turn,
                               entry.rotation, text))  # fmt: skip
    paths = [drive.path_m for drive in audit.drives if drive.is_heard and len(drive.path_m)]
    return draw_audit(drawn, paths, f"Audit of {file.path.name}")


def _page(audit: Audit, file: SurveyFile, figure: Any, written: Path) -> str:
    """The report as a page."""
    from evermap import __version__
    from evermap.viz.page import PAGE, STYLE, card, cards_html, figure_html, table, warnings_note

    counts, (_, message) = count_states(audit.entries), conclude(audit)
    faults = len(audit.faults)
    cards = [
        card("Faults", float(faults), "{:.0f}", f"of {len(audit.given)}", _fault_words(counts)),
        card("Right", float(counts["right"]), "{:.0f}", "entries", "Where the map has them."),
        card("Open", float(counts["undecided"] + counts["unseen"]), "{:.0f}", "entries",
             f"{counts['undecided']} undecided, {counts['unseen']} never looked at."),
    ]  # fmt: skip
    rows = [tuple(map(escape, row)) for row in list_rows(audit)]
    every = [tuple(map(escape, row)) for row in list_rows(audit, everything=True)]
    parts = [
        cards_html(cards),
        figure_html(figure),
        f"<h2>What is wrong, and what is open</h2>{table(HEAD, rows)}" if rows else "",
        "".join(f"<p>{escape(line)}</p>" for line in quiet_lines(audit)),
        f"<h2>The corrected file</h2><p><code>{escape(str(Path('corrected') / file.path.name))}</code></p>",
        f"<p>{escape(_of_file(audit, file, written))}</p>",
        "<h2>Drives</h2><ul>"
        + "".join(f"<li>{escape(drive_line(d, audit.clock))}</li>" for d in audit.drives)
        + "</ul>",
        _list("The sensor", sensor_lines(audit)),
        warnings_note([text for drive in audit.drives for text in drive.warnings]),
        f"<details><summary>All {len(every)} entries</summary>{table(HEAD, every)}</details>",
    ]
    return PAGE.substitute(
        version=escape(__version__),
        title=escape(f"Audit of {file.path.name}"),
        style=STYLE,
        heading=escape(f"Audit of {file.path.name}"),
        lead=escape(f"{message[0].upper()}{message[1:]}."),
        body="\n".join(part for part in parts if part),
        footer=f"Made by evermap {escape(__version__)}. All numbers of this page are in <code>summary.json</code>.",
    )


def _fault_words(counts: Mapping[str, int]) -> str:
    said = [f"{counts[state.value]} {state.value}" for state in ORDER if state.is_fault and counts[state.value]]
    return f"{', '.join(said)}." if said else "None was found."


def _list(title: str, lines: Sequence[str]) -> str:
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f"<h2>{escape(title)}</h2><ul>{items}</ul>" if items else ""
