"""What a file or folder is that is no recording, or no map, by its content, and what to do with it.

Asked only once no reader of recordings or maps has recognised it, so that the error says what was given instead of
what was not found.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import NamedTuple

from evermap.io.files import HEAD_BYTES, FileSet, head_of
from evermap.io.rosbag import BAG_ENDINGS
from evermap.io.text import parse_float

_TO_NATIVE = "`evermap init recording DIR` shows the tables of a recording"
_AS_MAP = "`evermap slam RECORDING --prior-map FILE`"
_MAKES_MAP = "`evermap slam`, which makes a map of a recording"
_ONLY_POSES = "evermap needs detections of landmarks, too; as odometry it goes into odometry.csv: " + _TO_NATIVE


_FOR_MAP = "a table with id, x, y"


class FileKind(NamedTuple):
    """What something is, in words that follow 'is' or 'holds', and what to try.

    `map_hint` is what to try where a map was wanted; None where it may be one.
    """

    what: str
    hint: str
    map_hint: str | None = _FOR_MAP


_MAGIC: tuple[tuple[bytes, int, str, str], ...] = (
    (b"\x89PNG", 0, "an image (PNG)", "detect"),
    (b"\xff\xd8\xff", 0, "an image (JPEG)", "detect"),
    (b"GIF8", 0, "an image (GIF)", "detect"),
    (b"BM", 0, "an image (BMP)", "detect"),
    (b"II*\0", 0, "an image (TIFF)", "detect"),
    (b"MM\0*", 0, "an image (TIFF)", "detect"),
    (b"ftyp", 4, "a video", "detect"),
    (b"RIFF", 0, "a video (AVI) or another RIFF file", "detect"),
    (b"\x1aE\xdf\xa3", 0, "a video (Matroska)", "detect"),
    (b"%PDF", 0, "a document (PDF)", _TO_NATIVE),
    (b"MATLAB ", 0, "a MATLAB file (.mat)", "matlab"),
    (b"\x89HDF\r\n\x1a\n", 0, "an HDF5 file, or one of MATLAB 7.3", "matlab"),
    (b"\x93NUMPY", 0, "an array of numpy (.npy)", "matlab"),
    (b"PK\x03\x04", 0, "a zip archive", "unpack"),
    (b"ustar", 257, "a tar archive", "unpack"),
    (b"7z\xbc\xaf'\x1c", 0, "an archive (7z)", "unpack"),
    (b"Rar!", 0, "an archive (RAR)", "unpack"),
    (b"BZh", 0, "a file packed by bzip2", "unpack it"),
    (b"\xfd7zXZ\0", 0, "a file packed by xz", "unpack it"),
    (b"(\xb5/\xfd", 0, "a file packed by zstd", "unpack it (`zstd -d`)"),
    (b"# .PCD", 0, "a cloud of points (PCD)", "cloud"),
    (b"ply\n", 0, "a cloud of points (PLY)", "cloud"),
    (b"LASF", 0, "a cloud of points (LAS)", "cloud"),
    (b"#ROSBAG V", 0, "a bag of ROS 1 under another name", "rename it to NAME.bag"),
    (b"\x89MCAP0\r\n", 0, "a bag (MCAP) under another name", "rename it to NAME.mcap"),
    (b"PAR1", 0, "a table (Parquet)", "table"),
)
_HINTS = {
    "unpack": "unpack it, and give the folder",
    "detect": "evermap takes detections of landmarks, not images: run a detector of tags or objects first; "
    + _TO_NATIVE,
    "matlab": "write its arrays as tables (CSV or Parquet); " + _TO_NATIVE,
    "cloud": "evermap takes detections of landmarks (poles, tags, objects), not points; " + _TO_NATIVE,
    "table": "its folder, if that is a recording; " + _TO_NATIVE,
}
_MAP_HINTS: dict[str, str | None] = {
    "unpack": "unpack it, and name the map in it",
    "unpack it": "unpack it, and name the map in it",
    "unpack it (`zstd -d`)": "unpack it, and name the map in it",
    "rename it to NAME.bag": _MAKES_MAP,
    "rename it to NAME.mcap": _MAKES_MAP,
    "table": None,
}
_TEXTS: tuple[tuple[str, str, str, str], ...] = (
    (r"\s*<(?:!doctype|html)", "a web page", "download the file itself", "download the file itself"),
    (r"\s*<\?xml|\s*<sdf|\s*<robot", "XML", _TO_NATIVE, _FOR_MAP),
    (r"(?:VERTEX|EDGE)_|(?:VERTEX|EDGE)[23]\s", "a pose graph (g2o, TORO or PyFG)", "name it NAME.g2o", _MAKES_MAP),
    (r"P[25]\s", "an image (PGM)", _HINTS["detect"], _FOR_MAP),
    (r"%YAML:1\.0", "a calibration of OpenCV", _TO_NATIVE, _FOR_MAP),
)
"""Beginnings of texts, what they are, and what to try for a recording and for a map."""
_TABLES = {"odometry", "detections", "frames", "truth", "landmarks", "robot_sightings", "objects"}


def kind_of_file(path: Path, content: bytes = b"") -> FileKind | None:
    """Return what a single file is; None where nothing is known about it.

    `content` is that of the file, unpacked, where it has been read; else its first bytes are.
    """
    head = content or head_of(path)
    if not head:
        return FileKind("an empty file", "was it copied or downloaded in full?", None) if _is_empty(path) else None
    for magic, at, what, hint in _MAGIC:
        if head[at : at + len(magic)] == magic:
            return FileKind(what, _HINTS.get(hint, hint), _MAP_HINTS.get(hint, _FOR_MAP))
    if head.startswith(b"SQLite format 3\0"):
        return _kind_of_database(path)
    return _kind_of_text(head, path.name)


def kind_of_folder(files: list[FileSet], path: Path) -> FileKind | None:
    """Return what a folder or archive is, whose files no reader has recognised; None where nothing is known."""
    names = {name for one in files for name in one.members}
    folders = {one.folder.rsplit("/", 1)[-1] for one in files}
    below = {child.name for child in path.iterdir() if child.is_dir()} if path.is_dir() else folders
    if {"cam0", "imu0", "mav0"} & below and not _TABLES & {name.split(".")[0] for name in names}:
        return FileKind("a sequence in the layout of EuRoC (images and IMU)", _HINTS["detect"])
    if {"rgb.txt", "depth.txt"} & names:
        return FileKind("a sequence in the layout of TUM RGB-D (images)", _HINTS["detect"])
    if "summary.json" in names and _is_run(files):
        hint = "`evermap view`, or its map as --prior-map; to run again, give the recording"
        return FileKind("the results of an evermap run", hint)
    bags = sorted(name for name in names if name.endswith(BAG_ENDINGS))
    if len(bags) > 1:
        return FileKind(f"{len(bags)} bags ({', '.join(bags[:3])})", "name one of them")
    if bags:
        return FileKind(f"a bag ({bags[0]}) inside an archive or beside other files", "unpack it, and name the bag")
    if not names:
        return None
    kinds = [_kind_of_member(one, name) for one in files[:3] for name in sorted(one.members)[:20]]
    known = [kind for kind in kinds if kind is not None]
    if known and len(known) == len(kinds) and len({kind.what for kind in known}) == 1:
        return FileKind(f"only files of one kind: each is {known[0].what}", known[0].hint)
    return None


def _kind_of_member(files: FileSet, name: str) -> FileKind | None:
    path = files.path_of(name)
    return None if files.zipped or _is_empty(path) else kind_of_file(path)


def _is_empty(path: Path) -> bool:
    try:
        return path.stat().st_size == 0
    except OSError:
        return False


def _is_run(files: list[FileSet]) -> bool:
    for one in files:
        if "summary.json" in one and not one.zipped:
            text = head_of(one.path_of("summary.json"))
            return b"schema_version" in text and b"evermap" in text
    return False


def _kind_of_database(path: Path) -> FileKind:
    import sqlite3

    try:
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        finally:
            connection.close()
    except sqlite3.Error:
        tables = set()
    export = f"`evermap map export {path.name} --out map.csv`"
    if {"revision", "store"} <= tables:
        hint = f"`evermap map enter {path.name} RECORDING` enters a recording; `evermap map show {path.name}`"
        return FileKind("a living map of evermap", hint, export)
    if {"topics", "messages"} <= tables:
        return FileKind("a bag of ROS 2 (SQLite) under another name", "rename it to NAME.db3", _MAKES_MAP)
    return FileKind("a database (SQLite), but no bag", _TO_NATIVE, f"if it is a living map, {export}")


# ---------------------------------------------------------------------------------------------------------------- text


def _kind_of_text(head: bytes, name: str) -> FileKind | None:
    text = head.decode("utf-8", "replace").removeprefix("\ufeff")
    if text.count("�") > 0.02 * len(text) + 1 or "\0" in text:
        return None
    if text.lstrip()[:1] in ("{", "["):
        return _kind_of_json(text)
    if name.lower().endswith((".kml", ".gpx")):
        return FileKind("a track of positions", _ONLY_POSES)
    for start, what, hint, map_hint in _TEXTS:
        if re.match(start, text, re.IGNORECASE):
            return FileKind(what, hint, map_hint)
    if re.search(r"(?m)^image\s*:", text) and re.search(r"(?m)^resolution\s*:", text):
        return FileKind("a map of cells (Nav2)", _HINTS["detect"])
    whole = text.rsplit("\n", 1)[0] if len(head) >= HEAD_BYTES and "\n" in text else text
    lines = [line for line in whole.splitlines() if line.strip() and line.lstrip()[0] not in "#%"]
    first, ending = (lines or [""])[0], name.lower().removesuffix(".gz").rpartition(".")[2]
    if "#timestamp" in text[:40].replace(" ", "") and "," in text[:200]:
        return FileKind("a table in the layout of EuRoC (nanoseconds)", _ONLY_POSES)
    if _has_numbers(lines, 8):
        return FileKind("a trajectory in the format of TUM (stamp x y z qx qy qz qw)", _ONLY_POSES)
    if _has_numbers(lines, 12):
        return FileKind("a trajectory in the format of KITTI (12 numbers of a matrix a line)", _ONLY_POSES)
    if re.match(r"(bodies|tags|cam\d+|camera\d*|default_body)\s*:", first):
        return FileKind(
            "a map of tags or a calibration (YAML)", "--prior-map FILE with a recording, if it is a map", None
        )
    if "rosbag2_bagfile_information" in text:
        return FileKind("the metadata of a bag", "its folder")
    if "," in first and name.split(".", maxsplit=1)[0] in _TABLES:
        return FileKind("one table of a recording", "its folder", None)
    if "landmark_id" in first and "stamp_s" not in first:
        return FileKind("a map of landmarks", _AS_MAP, None)
    if ending == "toml":
        return FileKind("settings (TOML)", "--config FILE with a recording", None)
    return FileKind("a table (CSV)", _TO_NATIVE, None) if "," in text and ending in ("csv", "tsv") else None


def _kind_of_json(text: str) -> FileKind:
    if '"FeatureCollection"' in text:
        return FileKind("a map (GeoJSON)", _AS_MAP, None)
    if '"tags"' in text and '"pose"' in text:
        return FileKind("a map of tags (WPILib)", _AS_MAP, None)
    layouts = "GeoJSON with features, or a field layout of WPILib with tags and field"
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return FileKind("a JSON document", _TO_NATIVE, None)
    if isinstance(document, dict) and "tags" not in document:
        return FileKind(f"JSON with {', '.join(list(document)[:5]) or 'nothing'}", _TO_NATIVE, layouts)
    return FileKind("a JSON document", _TO_NATIVE, None)


def _has_numbers(lines: list[str], count: int) -> bool:
    """Return whether all lines have so many numbers, between blanks."""
    try:
        return bool(lines) and all(len([parse_float(cell) for cell in line.split()]) == count for line in lines)
    except ValueError:
        return False
