"""All formats of landmark maps: recognised by what is in a file, read, corrected in place, and written.

`MAP_FORMATS` is the one registry. A format says how it is recognised, how its file becomes a table of a map, where in
the file the numbers of each entry are, and how a map is written. `correct_map` changes these numbers and nothing else,
so that a file of which nothing was wrong stays the same, byte by byte.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import DataError, InputError
from evermap.geometry import se3
from evermap.io.arrow import pa, parquet_bytes, pq
from evermap.io.file_kinds import kind_of_file
from evermap.io.files import content_of, write_atomic
from evermap.io.landmarks import (
    about_map,
    find_map_file,
    landmarks_from_table,
    map_columns,
    map_geojson,
    parquet_about,
    parse_geojson,
    up_of,
)
from evermap.io.map_entries import (
    VIEWED,
    Correction,
    FileEntry,
    Number,
    Units,
    angles_of,
    edit_text,
    number_json,
    values_of,
)
from evermap.io.map_tables import (
    WPILIB_CSV,
    WPILIB_CSV_UNITS,
    entries_of_csv,
    header_of,
    map_of_columns,
    native_columns,
    roles_of,
    wpilib_columns,
)
from evermap.io.spatial import AT, COVARIANCE, QUATERNION, TURN_COVARIANCE
from evermap.io.table import Table, csv_text, parse_csv, parse_parquet
from evermap.io.tag_maps import (
    DEGREES,
    TAGSLAM_UNITS,
    WPILIB_TAGS,
    WPILIB_UNITS,
    entries_of_fiducials,
    entries_of_rtabmap,
    entries_of_tagslam,
    entries_of_wpilib,
    fiducials_text,
    is_fiducials,
    is_rtabmap,
    is_tagslam,
    is_wpilib,
    map_of_survey,
    rtabmap_text,
    table_of_tags,
    tagslam_text,
    wpilib_2027_text,
    wpilib_text,
)
from evermap.io.text import decode_text
from evermap.types import Clock, Landmarks, identity_text, is_number

_Z_UP = {"up": {"direction": [0.0, 0.0, 1.0], "sigma_rad": 0.01, "source": "stated"}}
"""Of formats that say so."""
_ROLES = {**dict(zip(AT, "xyz", strict=True)), **{name: name for name in (*QUATERNION, *COVARIANCE, *TURN_COVARIANCE)},
          "sigma_m": "sigma", "sigma_rad": "sigma_turn", "cov_yy_m2": "cov_yy_m2"}  # fmt: skip
"""Roles of the columns of evermap's own maps, by their names."""

Read = Callable[[bytes, Path], tuple[Table, dict[str, Any]]]
Locate = Callable[[str, Path], tuple[Sequence[FileEntry], Units]]


@dataclass(frozen=True, slots=True)
class MapFormat:
    """A format of maps.

    Attributes:
        name: as `--format` has it.
        title: for messages.
        ending: of files that are written.
        is_one: whether bytes, and the same as text ('' where they are none), are of this format.
        read: returns a table with the columns of a map, and what the columns cannot say.
        locate: returns the entries of a text with where their numbers are; None where a file is no text.
        write: returns a file; None where none is written.
        has_poses: whether every landmark needs a pose in space, and a number as its id.
    """

    name: str
    title: str
    ending: str
    is_one: Callable[[bytes, str], bool]
    read: Read
    locate: Locate | None
    write: Callable[[Landmarks], str | bytes] | None
    has_poses: bool = False


@dataclass(frozen=True, slots=True)
class SurveyFile:
    """A map as a file has it.

    Attributes:
        path: of the file.
        format: what it is.
        data: its bytes, unpacked.
        landmarks: what it says.
    """

    path: Path
    format: MapFormat
    data: bytes
    landmarks: Landmarks


def read_prior_map(path: str | Path, sigma_m: float = 0.02, sigma_rad: float = 0.05) -> Landmarks:
    """Return landmark positions to start from, for `--prior-map FILE`. Their frame becomes 'prior_map'.

    Args:
        path: a map in any of `MAP_FORMATS`, whatever its name; or a run or recording folder that has one.
        sigma_m: standard deviation of positions for which the file gives none.
        sigma_rad: standard deviation of orientations in space for which the file gives none.

    Raises:
        InputError: the file is missing or malformed, or a standard deviation is not positive.
        DataError: it holds no landmark.
    """
    if not (np.isfinite(sigma_m) and sigma_m > 0):
        raise InputError(f"sigma of the prior map must be a positive number of metres, not {sigma_m}")
    if not (np.isfinite(sigma_rad) and sigma_rad > 0):
        raise InputError(f"sigma of its orientations must be a positive number of radians, not {sigma_rad}")
    return replace(read_map_file(path, sigma_m=sigma_m, sigma_rad=sigma_rad).landmarks, frame="prior_map")


def read_map_file(path: str | Path, *, sigma_m: float = 0.02, sigma_rad: float = 0.05) -> SurveyFile:
    """Return a map with its file, to correct it (`correct_map`). Arguments and errors are those of `read_prior_map`."""
    found = _read(path, sigma_m, sigma_rad)
    if len(found.landmarks) == 0:
        raise DataError("the map contains no landmark", path=found.path)
    return found


def read_landmarks(path: str | Path, *, sigma_m: float = 0.0, sigma_rad: float = 0.0) -> Landmarks:
    """Return a map in the frame that its file states ('truth' where it states none). Arguments as `read_prior_map`."""
    return _read(path, sigma_m, sigma_rad).landmarks


def _read(path: str | Path, sigma_m: float, sigma_rad: float) -> SurveyFile:
    path = find_map_file(Path(path))
    data = content_of(path)
    kind = format_of(data, path)
    table, about = kind.read(data, path)
    landmarks = landmarks_from_table(
        table,
        sigma_m=sigma_m,
        sigma_rad=sigma_rad,
        class_names=tuple(about["class_names"]) if "class_names" in about else None,
        frame=about.get("frame", "truth"),
        clock=Clock(about.get("clock", Clock.RECORDING)),
    )
    return SurveyFile(path, kind, data, replace(landmarks, up=up_of(about)))


def format_of(data: bytes, path: Path) -> MapFormat:
    """Return the format of a file by its content; by the ending of its name where the content is of none, to say what
    is wrong with it.

    Raises:
        InputError: it is of another kind; says which.
    """
    text = _text(data)
    for kind in MAP_FORMATS:
        if kind.is_one(data, text):
            return kind
    other = kind_of_file(path, data)
    if other is not None and other.map_hint is not None:
        raise InputError(f"is {other.what}, not a map of landmarks", path=path, hint=other.map_hint)
    ending = Path(path.name.lower().removesuffix(".gz")).suffix
    for kind in MAP_FORMATS:
        if ending in _ENDINGS.get(kind.name, ()):
            return kind
    hint = ".csv, .parquet, .geojson; of tags .yaml (TagSLAM), .json or .csv (WPILib), .txt (fiducial_slam, rtabmap)"
    raise InputError(f"unknown map format '{ending}'", path=path, hint=hint)


def _text(data: bytes) -> str:
    """Decode a file as UTF-8, with its line ends and byte order mark; '' for a binary file."""
    if b"\0" in data:
        return ""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return ""


def correct_map(file: SurveyFile, corrections: Iterable[Correction]) -> bytes:
    """Return the bytes of a map's file in which only what is corrected is changed; unpacked.

    Raises:
        InputError: a correction is of no landmark of the map, or turns one of which the file has no rotation.
    """
    wanted = list(corrections)
    if not wanted:
        return file.data
    known = set(file.landmarks.landmark_id.tolist())
    for one in wanted:
        if one.landmark_id not in known or (one.like_id is not None and one.like_id not in known):
            raise InputError(f"has no landmark {one.landmark_id}", path=file.path)
    if file.format.locate is None:
        return _correct_parquet(file, wanted)
    text = file.data.decode("utf-8")
    entries, units = file.format.locate(text, file.path)
    ids = _ids_of(entries, file.landmarks)
    return edit_text(text, entries, ids, wanted, units).encode("utf-8")


def write_corrected(file: SurveyFile, corrections: Iterable[Correction], path: str | Path) -> Path:
    """Write a map's file with corrections; one without any as it is, to the last byte. Returns the path.

    Errors are those of `correct_map`.
    """
    wanted = list(corrections)
    if not wanted and _is_named_packed(file.path) == _is_named_packed(Path(path)):  # to pack again gives other bytes
        return write_atomic(path, file.path.read_bytes())
    return write_map_bytes(correct_map(file, wanted), path)


def _ids_of(entries: Sequence[FileEntry], landmarks: Landmarks) -> list[int]:
    by_name = {name: identity for identity, name in landmarks.names.items()}
    return [by_name[one.label] if one.label in by_name else int(float(one.label)) for one in entries]


def write_map(landmarks: Landmarks, path: str | Path, kind: MapFormat) -> Path:
    """Write a map in a format; gzipped where the name ends so. Returns the path.

    Raises:
        InputError: the format needs poses in space, or numbers as ids, and the map has none.
    """
    if kind.write is None:
        raise InputError(f"no map is written as {kind.title}", path=path)
    if kind.has_poses:
        rotation = landmarks.rotation
        turned = rotation is not None and bool(np.isfinite(rotation).all())
        if landmarks.position_m.shape[1] != 3 or not turned:
            hint = "--format csv, which needs none"
            raise InputError(f"{kind.title} needs a pose in space of every landmark", path=path, hint=hint)
        every = zip(landmarks.labels, landmarks.landmark_id.tolist(), strict=True)
        named = [name for name, one in every if not is_number(one)]
        if named:
            hint = "--format csv, which has names"
            raise InputError(f"{kind.title} numbers its tags; this map has '{named[0]}'", path=path, hint=hint)
    content = kind.write(landmarks)
    return write_map_bytes(content.encode() if isinstance(content, str) else content, path)


def write_map_bytes(data: bytes, path: str | Path) -> Path:
    """Write the bytes of a map; gzipped where the name ends so. Returns the path."""
    return write_atomic(path, gzip.compress(data, mtime=0) if _is_named_packed(Path(path)) else data)


def _is_named_packed(path: Path) -> bool:
    return path.name.endswith(".gz")


def format_called(name: str | None, path: Path) -> MapFormat:
    """Return the format to write of a name, or of the ending of a file.

    Raises:
        InputError: there is none.
    """
    written = [kind for kind in MAP_FORMATS if kind.write is not None]
    ending = Path(path.name.lower().removesuffix(".gz")).suffix
    for kind in written:
        if kind.name == name or (name is None and ending in (kind.ending, *_WRITTEN_AS.get(kind.name, ()))):
            return kind
    hint = ", ".join(kind.name for kind in written)
    raise InputError(f"cannot write a '{name or path.suffix}' map", path=path, hint=hint)


_WRITTEN_AS = {"geojson": (".json",)}


def _read_csv(data: bytes, path: Path) -> Table:
    warnings: list[str] = []
    table = parse_csv(data, path, warnings)
    if warnings:
        # a session may do without its last reading, but a map without its last landmark is another map
        raise InputError("the last line is unfinished", path=path, hint="complete or remove it")
    return table


def _read_native(data: bytes, path: Path) -> tuple[Table, dict[str, Any]]:
    table = _read_csv(data, path)
    return (map_of_survey(table) if "tag_id" in table and "landmark_id" not in table else table), {}


def _read_columns(data: bytes, path: Path) -> tuple[Table, dict[str, Any]]:
    table = _read_csv(data, path)
    columns = roles_of(list(table.columns), path)
    assert columns is not None
    return map_of_columns(table, columns), {}


def _read_wpilib_csv(data: bytes, path: Path) -> tuple[Table, dict[str, Any]]:
    return map_of_columns(_read_csv(data, path), wpilib_columns()), _Z_UP


def _read_parquet(data: bytes, path: Path) -> tuple[Table, dict[str, Any]]:
    table = parse_parquet(data, path)
    if "landmark_id" in table:
        return table, parquet_about(data, path)
    if {"tag_id", "rx_rad"} <= table.columns.keys():
        return map_of_survey(table), {}
    columns = roles_of(list(table.columns), path)
    return (table, {}) if columns is None else (map_of_columns(table, columns), {})


def _is_native(_: bytes, text: str) -> bool:
    names = set(header_of(text))
    return {"landmark_id", "x_m", "y_m"} <= names or {"tag_id", "x_m", "rx_rad"} <= names


def _is_columns(_: bytes, text: str) -> bool:
    names = header_of(text)
    return len(names) > 2 and roles_of(names, Path()) is not None


def _is_geojson(_: bytes, text: str) -> bool:
    if text.removeprefix("\ufeff").lstrip()[:1] != "{" or '"features"' not in text:
        return False
    try:
        document = json.loads(text.removeprefix("\ufeff"))
    except (ValueError, RecursionError):
        return False
    return isinstance(document, dict) and isinstance(document.get("features"), list)


def _is_layout(key: str) -> Callable[[bytes, str], bool]:
    return lambda _, text: is_wpilib(text) and key in json.loads(text.removeprefix("\ufeff"))


def _of_tags(locate: Callable[[str, Path], list[FileEntry]], units: Units, about: dict[str, Any]) -> Read:
    def read(data: bytes, path: Path) -> tuple[Table, dict[str, Any]]:
        return table_of_tags(locate(decode_text(data, path), path), units, path), about

    return read


def _make_locate(locate: Callable[[str, Path], list[FileEntry]], units: Units) -> Locate:
    return lambda text, path: (locate(text, path), units)


def _locate_native(text: str, path: Path) -> tuple[Sequence[FileEntry], Units]:
    columns = native_columns(header_of(text))
    return entries_of_csv(text, columns, path), columns.units


def _locate_columns(text: str, path: Path) -> tuple[Sequence[FileEntry], Units]:
    columns = roles_of(header_of(text), path)
    assert columns is not None
    return entries_of_csv(text, columns, path), columns.units


def _locate_wpilib_csv(text: str, path: Path) -> tuple[Sequence[FileEntry], Units]:
    return entries_of_csv(text, wpilib_columns(), path), WPILIB_CSV_UNITS


def _locate_geojson(text: str, _: Path) -> tuple[Sequence[FileEntry], Units]:
    """Points; the numbers of an outline are where it is in the file, and move with the point."""
    mark = len(text) - len(text.removeprefix("\ufeff"))
    numbered, numbers = number_json(text[mark:])
    numbers = [Number(one.text, one.start + mark, one.end + mark) for one in numbers]
    points, outlines = dict[str, dict[str, Number]](), dict[str, dict[str, Number]]()
    for feature in json.loads(numbered)["features"]:
        properties, geometry = feature.get("properties") or {}, feature.get("geometry") or {}
        value = properties.get("landmark_id")
        label = value if isinstance(value, str) else numbers[value].text if isinstance(value, int) else ""
        if geometry.get("type") == "Point":
            own = {_ROLES[name]: numbers[k] for name, k in properties.items() if name in _ROLES and k is not None}
            of = {f"at_{axis}": numbers[k] for axis, k in zip("xyz", geometry["coordinates"], strict=False)}
            points[label] = {**of, **own}
        elif geometry.get("type") == "Polygon":
            ring = geometry["coordinates"][0]
            outlines[label] = {f"ring_{axis}{k}": numbers[at[c]] for k, at in enumerate(ring)
                               for c, axis in enumerate("xy")}  # fmt: skip
    return [
        FileEntry(label, k + 1, {**own, **outlines.get(label, {})}) for k, (label, own) in enumerate(points.items())
    ], Units()


def _correct_parquet(file: SurveyFile, corrections: Sequence[Correction]) -> bytes:
    """The table with other numbers in some cells; its types and metadata stay."""
    table = pq.read_table(pa.BufferReader(file.data))
    names = list(table.column_names)
    columns = native_columns(names) if {"landmark_id", "tag_id"} & set(names) else roles_of(names, file.path)
    assert columns is not None
    cells = {role: table.column(name).to_pylist() for role, name in columns.roles.items()}
    entries = [
        FileEntry(str(label), row + 1, {role: Number(repr(column[row]), 0, 0) for role, column in cells.items()
                                        if column[row] is not None})
        for row, label in enumerate(table.column(columns.identity).to_pylist())
    ]  # fmt: skip
    row_of = {identity: row for row, identity in enumerate(_ids_of(entries, file.landmarks))}
    for one in corrections:
        row = row_of[one.landmark_id]
        if one.like_id is None:
            values = values_of(entries[row], columns.units, one)
        else:
            values = {role: number.value for role, number in entries[row_of[one.like_id]].numbers.items()}
        for role, value in values.items():
            cells[role][row] = value
    for role, name in columns.roles.items():
        at = names.index(name)
        kind = table.schema.field(at)
        table = table.set_column(at, kind, pa.array(cells[role], type=kind.type))
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return bytes(sink.getvalue().to_pybytes())


def _csv_of(landmarks: Landmarks) -> str:
    return csv_text(map_columns(landmarks))


def _parquet_of(landmarks: Landmarks) -> bytes:
    return parquet_bytes(map_columns(landmarks), {"evermap": json.dumps(about_map(landmarks))})


def _columns_of(landmarks: Landmarks) -> str:
    """Ids as numbers or texts, coordinates, and quaternions where there are any."""
    ids = [identity_text(one, landmarks.names) for one in landmarks.landmark_id.tolist()]
    columns: dict[str, Any] = {"id": ids, **dict(zip("xyz", landmarks.position_m.T, strict=False))}
    if landmarks.rotation is not None:
        columns |= dict(zip(QUATERNION, landmarks.rotation.T, strict=True))
    return csv_text(columns)


def _wpilib_csv_of(landmarks: Landmarks) -> str:
    """Inches and degrees, rounded to a thousandth.

    Raises:
        InputError: a tag is turned about the direction in which it looks, for which there is no column.
    """
    assert landmarks.rotation is not None
    lines = [",".join(WPILIB_CSV)]
    pose = se3.compose(np.concatenate([landmarks.position_m, landmarks.rotation], axis=1), se3.inverse(VIEWED))
    for identity, one in zip(landmarks.landmark_id.tolist(), pose, strict=True):
        roll, tilt, facing = np.degrees(angles_of(one)).tolist()
        if abs(roll) > 2.0:
            problem = f"tag {identity} is turned by {roll:.1f} deg about its face, which WPILib's tables cannot say"
            raise InputError(problem, hint="--format wpilib")
        numbers = [*(one[:3] / WPILIB_CSV_UNITS.metre).tolist(), facing % 360.0, tilt]
        lines.append(",".join([str(identity), *(f"{number:.3f}".rstrip("0").rstrip(".") for number in numbers)]))
    return "\n".join(lines) + "\n"


MAP_FORMATS: tuple[MapFormat, ...] = (
    MapFormat("parquet", "Parquet", ".parquet", lambda data, _: data[:4] == b"PAR1", _read_parquet, None, _parquet_of),
    MapFormat(
        "wpilib", "a field layout of WPILib (2022 to 2026)", ".wpilib.json", _is_layout(WPILIB_TAGS[0]),
        _of_tags(entries_of_wpilib, WPILIB_UNITS, _Z_UP), _make_locate(entries_of_wpilib, WPILIB_UNITS),
        wpilib_text, True,
    ),
    MapFormat(
        "wpilib-2027", "a field layout of WPILib (from 2027)", ".wpilib.json", _is_layout(WPILIB_TAGS[1]),
        _of_tags(entries_of_wpilib, WPILIB_UNITS, _Z_UP), _make_locate(entries_of_wpilib, WPILIB_UNITS),
        wpilib_2027_text, True,
    ),
    MapFormat("geojson", "GeoJSON", ".geojson", _is_geojson, parse_geojson, _locate_geojson, map_geojson),
    MapFormat(
        "tagslam", "TagSLAM", ".tagslam.yaml", lambda _, text: is_tagslam(text),
        _of_tags(entries_of_tagslam, TAGSLAM_UNITS, {}), _make_locate(entries_of_tagslam, TAGSLAM_UNITS), tagslam_text,
        True,
    ),
    MapFormat("csv", "a table", ".csv", _is_native, _read_native, _locate_native, _csv_of),
    MapFormat(
        "wpilib-csv", "a table of WPILib", ".wpilib.csv", lambda _, text: tuple(header_of(text)) == WPILIB_CSV,
        _read_wpilib_csv, _locate_wpilib_csv, _wpilib_csv_of, True,
    ),
    MapFormat("columns", "a table with id, x, y", ".columns.csv", _is_columns, _read_columns, _locate_columns,
              _columns_of),
    MapFormat(
        "fiducials", "a map of fiducial_slam", ".txt", lambda _, text: is_fiducials(text),
        _of_tags(entries_of_fiducials, DEGREES, {}), _make_locate(entries_of_fiducials, DEGREES), fiducials_text, True,
    ),
    MapFormat(
        "rtabmap", "priors of rtabmap's markers", ".rtabmap.txt", lambda _, text: is_rtabmap(text),
        _of_tags(entries_of_rtabmap, Units(), {}), _make_locate(entries_of_rtabmap, Units()), rtabmap_text, True,
    ),
)  # fmt: skip
"""All formats of maps, in the order in which they are tried. Add a new one here and nowhere else."""

_ENDINGS = {"csv": (".csv",), "parquet": (".parquet", ".pq"), "geojson": (".geojson", ".json"),
            "tagslam": (".yaml", ".yml"), "fiducials": (".txt",)}  # fmt: skip
"""Endings of files whose content is of no format: by these a mistake is told as one of such a file."""
