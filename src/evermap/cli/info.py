"""`evermap info`: what a file or folder is, in one screen: recording, bag, living map, run, landmarks, table."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from evermap.cli.options import AsJson, Robot, argument
from evermap.cli.terminal import print_json, print_table, warn
from evermap.errors import ConfigError, EvermapError, InputError

if TYPE_CHECKING:
    from evermap.types import Landmarks

MOST_LETTERS = 150
"""Longest command line that is shown; `--json` has all of it."""
_TABLES = {
    ("feature_id", "detected"): "looks, as `evermap persist` reads them",
    ("left", "right"): "lifetimes, as `evermap survival fit` reads them",
    ("landmark_id", "nis"): "innovations of a run",
    ("track_id",): "tracks",
    ("stamp_s", "x_m", "y_m", "z_m"): "detections, as `evermap track` reads them",
}
"""Kinds of tables with their characteristic columns; the first match counts."""
_KNOWN = "a recording, ROS bag, living map, run folder, landmarks, trajectory (.tum), table or file of lifetimes"


class Described(NamedTuple):
    """Description of a path: its kind, all facts for programs, and lines for people."""

    kind: str
    facts: dict[str, Any]
    rows: list[tuple[str, str]]
    topics: Mapping[str, tuple[str, int]] = {}


def info(
    path: Annotated[Path, argument(f"Files that evermap reads or writes: {_KNOWN}.", metavar="PATH")],
    robot: Robot = None,
    as_json: AsJson = False,
) -> None:
    """Describe a file or folder.

    \b
    Examples:
      evermap info monday.mcap
      evermap info site.evermap --json
      evermap info out/monday
    """
    told = _ask(path, robot)
    if as_json:
        print_json({"path": str(path), "kind": told.kind, "bytes": _size(path), **told.facts})
        return
    print_table(f"{path}: {told.kind}, {_readable(_size(path))}", told.rows)
    if told.topics:
        rows = [[name, kind, f"{count:,}"] for name, (kind, count) in sorted(told.topics.items())]
        print_table("topics", rows, ("topic", "type", "messages"), numbers=(2,))
    for remark in told.facts.get("warnings", ()):
        warn(remark)


def _ask(path: Path, robot: int | None) -> Described:
    """Ask what understands the path; the cheapest question first.

    Raises:
        InputError: nothing is there, it is damaged, or of no known kind.
    """
    if not path.exists():
        raise InputError("no such file or folder", path=path, hint="check the path")
    summary = _summary(path)
    if summary is not None:
        return _run(path, summary)
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(16)
        name = path.name.lower().removesuffix(".gz")
        if head.startswith(b"SQLite format 3") and not name.endswith(".db3"):
            return _map(path)
        for ending, tell in _BY_ENDING.items():
            if name.endswith(ending):
                return tell(path)
    return _recording(path, robot)


def _summary(path: Path) -> dict[str, Any] | None:
    """The summary of a run, of its folder or by itself."""
    file = path / "summary.json" if path.is_dir() else path
    if file.name != "summary.json" or not file.is_file():
        return None
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"is not the summary of a run: {error}", path=file) from None
    if not isinstance(content, dict) or not {"evermap", "outputs"} <= content.keys():
        raise InputError("is not a summary written by evermap", path=file)
    return content


def _run(path: Path, summary: dict[str, Any]) -> Described:
    from evermap.cli.recordings import main_numbers

    folder = path if path.is_dir() else path.parent
    counts, timing = summary.get("counts") or {}, summary.get("timing") or {}
    numbers = {name: value for name, value in counts.items() if isinstance(value, int | float)}
    changes = Counter(change["kind"] for change in summary.get("changes") or ())
    files = {name: _size(folder / name) for name in summary["outputs"] if (folder / name).is_file()}
    missing = [name for name in summary["outputs"] if name not in files and not (folder / name).is_dir()]
    rows = [
        ("command", shorten(summary.get("command") or "-", MOST_LETTERS, placeholder=" ...")),
        ("input", summary.get("input") or "-"),
        ("written", f"{timing.get('written_at', '-')} by evermap {summary['evermap']}"),
        *((name.replace("_", " "), f"{value:,.10g}") for name, value in numbers.items()),
        *(main_numbers(summary) if "metrics" in summary and "recording" in summary else []),
        *([("verdict", _verdict(verdict))] if (verdict := summary.get("verdict")) else []),
        ("changes", ", ".join(f"{count} {kind}" for kind, count in changes.items()) or "none"),
        ("remarks", f"{len(summary.get('warnings') or ())}"),
        ("files", f"{len(files)}, {_readable(sum(files.values()))}" + (f"; {len(missing)} missing" if missing else "")),
    ]
    picked = (
        "command",
        "input",
        "evermap",
        "recording",
        "metrics",
        "counts",
        "changes",
        "accepted",
        "verdict",
        "timing",
    )
    facts = {name: summary[name] for name in picked if name in summary}
    return Described(
        "run", {**facts, "files": files, "missing": missing, "remarks": len(summary.get("warnings") or ())}, rows
    )


def _verdict(verdict: Mapping[str, Any]) -> str:
    return shorten(f"{verdict['kind']}: {verdict['message']}", MOST_LETTERS, placeholder=" ...")


def _recording(path: Path, robot: int | None) -> Described:
    from evermap.cli.check import content_rows
    from evermap.io import list_robots, read_recording, reader_for
    from evermap.slam.check import contents

    try:
        reader = reader_for(path)
    except InputError as error:
        if path.is_file():
            raise InputError("is not a file that evermap reads", path=path, hint=_KNOWN) from error
        raise
    topics = _topics(path) if reader.name == "bag" else {}
    robots = list_robots(path)
    facts: dict[str, Any] = {"format": reader.name, "robots": list(robots)}
    if topics:
        facts["topics"] = {name: {"type": kind, "messages": count} for name, (kind, count) in topics.items()}
    rows = [("format", reader.name + (f", robots {', '.join(map(str, robots))}" if robots else ""))]
    try:
        recording = read_recording(path, robot=robot)
    except EvermapError as error:
        if not topics:
            raise
        return Described("bag", {**facts, "warnings": [error.one_line()]}, rows, topics)
    found = contents(recording)
    truth = 0 if recording.truth is None else len(recording.truth)
    survey = 0 if recording.true_landmarks is None else len(recording.true_landmarks)
    sensors = [one.name for one in recording.sensors]
    facts |= {"name": recording.name, "clock": recording.clock.value, "classes": list(recording.class_names), **found}
    facts |= {"sensors": sensors, "truth_poses": truth, "true_landmarks": survey, "warnings": list(recording.warnings)}
    rows += [
        ("name", recording.name),
        *content_rows(found),
        ("classes", ", ".join(recording.class_names) or "-"),
        ("truth", f"{truth:,} poses, {survey:,} landmarks"),
        ("clock", recording.clock.value),
    ]
    return Described("bag" if topics else "recording", facts, rows, topics)


def _topics(path: Path) -> dict[str, tuple[str, int]]:
    """Type and number of messages of every topic; no message is read."""
    from evermap.io.rosbag import scan

    return {name: (one.text, one.messages) for name, one in scan(path, lambda _: {}).items()}


def _map(path: Path) -> Described:
    from evermap.cli.map import revision_row
    from evermap.maps.diff import read_log
    from evermap.maps.store import open_store
    from evermap.runs.map_dicts import life_dicts, revision_dict
    from evermap.types import json_number, stamp_text

    with open_store(path) as store:
        revisions, living = read_log(store), store.load()
    landmarks = living.landmarks(p_least=0.5)
    lives = life_dicts(living)
    sessions = sum(item.provenance.kind.value == "session" for item in revisions)
    head, lines = "number", ["-"]
    if revisions:
        head, lines = f"{revisions[-1].number}", revision_row(revisions[-1], living.clock)
    everywhere = [life for life in lives if life["chunk"] is None]
    rows = [
        ("revisions", f"{len(revisions)}, {sessions} of them sessions"),
        ("newest", f"{head}: {', '.join(lines[1:4])}" if revisions else "-"),
        ("seen until", stamp_text(living.stamp_s, living.clock)),
        ("landmarks", f"{len(living.members):,} known, {len(landmarks):,} believed to exist"),
        *_landmark_rows(landmarks),
        *((f"stay of {life['class'] or 'all'}", _half(life["half_gone_s"], life["stays"])) for life in everywhere),
        *(("hours", line) for line in living.lives.describe_hours(living.clock)),
    ]
    facts = {
        "revisions": len(revisions),
        "sessions": sessions,
        "newest": revision_dict(revisions[-1]) if revisions else None,
        "seen_until_s": json_number(living.stamp_s),
        "clock": living.clock.value,
        "known": len(living.members),
        **_landmark_facts(landmarks),
        "lifetimes": lives,
    }
    return Described("living map", facts, rows)


def _landmarks(path: Path) -> Described:
    from evermap.io import read_landmarks

    landmarks = read_landmarks(path)
    facts = {**_landmark_facts(landmarks), "frame": landmarks.frame, "clock": landmarks.clock.value}
    rows = [("landmarks", f"{len(landmarks):,}"), *_landmark_rows(landmarks), ("frame", landmarks.frame)]
    return Described("landmarks", facts, rows)


def _landmark_facts(landmarks: Landmarks) -> dict[str, Any]:
    """Number, classes and extent."""
    from evermap.io.landmarks import labels_of

    labels = Counter(labels_of(landmarks.class_id, landmarks.class_names))
    at = landmarks.position_m
    turned = 0 if landmarks.rotation is None else int((landmarks.rotation == landmarks.rotation).all(axis=1).sum())
    return {
        "landmarks": len(landmarks),
        "classes": dict(sorted(labels.items())),
        "dim": int(at.shape[1]),
        "oriented": turned,
        "from_m": at.min(axis=0).tolist() if len(at) else None,
        "to_m": at.max(axis=0).tolist() if len(at) else None,
    }


def _landmark_rows(landmarks: Landmarks) -> list[tuple[str, str]]:
    facts = _landmark_facts(landmarks)
    classes = ", ".join(f"{name or 'none'} {count:,}" for name, count in facts["classes"].items())
    low, high = facts["from_m"], facts["to_m"]
    size = " x ".join(f"{b - a:.1f}" for a, b in zip(low, high, strict=True)) + " m" if low else "-"
    turned = f", {facts['oriented']:,} with an orientation" if facts["oriented"] else ""
    return [("classes", classes or "-"), ("extent", f"{size}{turned}")]


def _trajectory(path: Path) -> Described:
    import numpy as np

    from evermap.io import read_tum

    found = read_tum(path, in_space=True)
    step = np.linalg.norm(np.diff(found.pose_world_robot[:, :3], axis=0), axis=1)
    first, last = float(found.stamp_s[0]), float(found.stamp_s[-1])
    facts = {"poses": len(found), "from_s": first, "to_s": last, "way_m": float(step.sum())}
    rows = [("poses", f"{len(found):,}"), ("lasts", f"{last - first:,.1f} s"), ("way", f"{step.sum():,.1f} m")]
    return Described("trajectory", facts, rows)


def _table(path: Path) -> Described:
    from evermap.io.columns import read_columns
    from evermap.valid import STAMP_S

    remarks: list[str] = []
    table = read_columns(path, remarks)
    kind = next((kind for columns, kind in _TABLES.items() if all(name in table for name in columns)), "")
    if not kind and all(name in table for name in ("x_m", "y_m")) and ("landmark_id" in table or "tag_id" in table):
        return _landmarks(path)
    facts: dict[str, Any] = {"table": kind, "rows": len(table), "columns": list(table.columns), "warnings": remarks}
    rows = [("holds", kind or "a table"), ("rows", f"{len(table):,}"), ("columns", ", ".join(table.columns))]
    if len(table) and "stamp_s" in table:
        stamp_s = table.numbers(STAMP_S)
        facts |= {"from_s": float(stamp_s.min()), "to_s": float(stamp_s.max())}
        rows.append(("lasts", f"{stamp_s.max() - stamp_s.min():,.1f} s"))
    for name in ("class_id", "feature_id", "track_id"):
        if name in table:
            labels = table.labels(name)[0]
            facts[name] = len(labels)
            rows.append((name.removesuffix("_id"), f"{len(labels):,} different"))
    return Described("table", facts, rows)


def _yaml(path: Path) -> Described:
    """A grid as ROS 2's map_server has it; else tags of TagSLAM."""
    from evermap.io.yaml import parse_yaml

    document = parse_yaml(path.read_bytes(), path)
    if not isinstance(document, dict) or "image" not in document:
        return _landmarks(path)
    image, cell_m = path.parent / str(document["image"]), document.get("resolution")
    try:
        kind, shape, *_ = image.read_bytes()[:64].split(b"\n")
        width, height = map(int, shape.split()) if kind == b"P5" else (0, 0)
        extent = f"{width * float(str(cell_m)):.1f} x {height * float(str(cell_m)):.1f} m"
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            "is a grid whose image cannot be read", path=image, hint="a PGM as evermap writes it"
        ) from error
    facts = {"image": str(image), "width": width, "height": height, "cell_m": cell_m, "mode": document.get("mode")}
    rows = [("cells", f"{width:,} x {height:,} of {cell_m} m"), ("extent", extent), ("mode", str(document.get("mode")))]
    return Described("grid", facts, rows)


def _json(path: Path) -> Described:
    """Lifetimes; else landmarks as GeoJSON or as WPILib has them."""
    from evermap.existence.models import load_models, read_model_file
    from evermap.survival.text import prior_text
    from evermap.types import json_number

    if "schema_version" not in _document(path):
        return _landmarks(path)
    kind, models = str(read_model_file(path).get("kind")), load_models(path)
    lives = models.lifetimes.items()
    half_s = {name: json_number(life.stay.quantile(0.5)) for name, life in lives}
    rows = [("model", kind), ("per", models.per)]
    rows += [(f"stay of {name or 'all'}", _half(found)) for name, found in half_s.items()]
    stays = {name: {"stay": prior_text(life.stay), "half_gone_s": half_s[name]} for name, life in lives}
    return Described("lifetimes", {"model": kind, "per": models.per, "stays": stays}, rows)


def _half(half_gone_s: float | None, stays: int | None = None) -> str:
    from evermap.survival.durations import duration_text

    told = "half never leave" if half_gone_s is None else f"half are gone after {duration_text(half_gone_s)}"
    return told if stays is None else f"{told}, by {stays:g} stays"


def _document(path: Path) -> dict[str, Any]:
    from evermap.io.files import unpacked

    try:
        document = json.loads(unpacked(path.read_bytes(), path))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"is not JSON: {' '.join(str(error).split())[:100]}", path=path) from None
    return document if isinstance(document, dict) else {}


_BY_ENDING: Mapping[str, Callable[[Path], Described]] = {
    ".tum": _trajectory, ".csv": _table, ".parquet": _table, ".pq": _table, ".geojson": _landmarks, ".json": _json,
    ".yaml": _yaml, ".yml": _yaml, "map.txt": _landmarks,
}  # fmt: skip


def _size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    if path.is_dir():
        return sum(one.stat().st_size for one in path.rglob("*") if one.is_file())
    try:
        return path.stat().st_size
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror or error}", path=path) from None


def _readable(size: int) -> str:
    """'4.2 MB'."""
    value, units = float(size), ["bytes", "kB", "MB", "GB", "TB"]
    while value >= 1000.0 and len(units) > 1:
        value, units = value / 1000.0, units[1:]
    return f"{value:.0f} {units[0]}" if units[0] == "bytes" else f"{value:.3g} {units[0]}"
