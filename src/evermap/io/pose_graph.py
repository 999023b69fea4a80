"""Pose graphs with landmarks as recordings: g2o, TORO and PyFG, in the plane and in space.

Edges between successive poses are the odometry, other edges between poses the measurement 'closures', edges to
landmarks the detections. Poses of g2o and TORO have no stamps: they are taken to be a second apart. What vertices say
of poses is an estimate, and not read, but in PyFG it is the truth.

- g2o (Kuemmerle et al., ICRA 2011) and TORO (Grisetti et al., RSS 2007): `VERTEX_SE2 id x y theta`,
  `EDGE_SE2 i j dx dy dtheta` and the upper triangle of the information; `EDGE_SE2_XY`, `EDGE_SE3:QUAT`,
  `EDGE_SE3_TRACKXYZ`, `VERTEX2`, `EDGE2`, `EDGE3`, ...; keys of gtsam such as x5 and l3 are taken apart.
- PyFG (MarineRoboticsGroup/PyFactorGraph): the same names with a stamp before the keys, keys such as A12 and L3, and
  covariances.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evermap.errors import DataError, InputError
from evermap.geometry import se2, se3
from evermap.geometry.group import accumulate
from evermap.io.assemble import finish_recording
from evermap.io.files import FileSet, Reader, content_of, find_file_set
from evermap.io.spatial import spatial_detections
from evermap.io.text import counted, decode_text, parse_float, quote
from evermap.types import (
    UNKNOWN,
    Clock,
    Detections,
    FloatArray,
    Frames,
    IntArray,
    Landmarks,
    Measurements,
    Odometry,
    Recording,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
    landmark_id_of,
)
from evermap.valid import SINCE_1970_S

Key = tuple[str, int]
"""A variable: letters and a number, as ('x', 5); ('', 5) where it is called by a number."""

ENDINGS = (".g2o", ".pyfg", ".toro", ".graph", ".g2o.gz")
_MOST_M, _LARGEST_ID = 1e8, 2**53
_NAME = re.compile(r"([A-Za-z_]*)(\d{1,20})")


class _Form(NamedTuple):
    """A kind of line: what it is, how many keys, numbers and entries of a covariance or information it has, and the
    dimension of the graph in which it is.
    """

    kind: str
    keys: int
    values: int
    noise: int
    dim: int


_FORMS = {
    "VERTEX_SE2": _Form("pose", 1, 3, 0, 2),
    "VERTEX2": _Form("pose", 1, 3, 0, 2),
    "VERTEX_SE3:QUAT": _Form("pose", 1, 7, 0, 3),
    "VERTEX3": _Form("pose", 1, 6, 0, 3),
    "VERTEX_XY": _Form("place", 1, 2, 0, 2),
    "VERTEX_TRACKXYZ": _Form("place", 1, 3, 0, 3),
    "VERTEX_XYZ": _Form("place", 1, 3, 0, 3),
    "EDGE_SE2": _Form("move", 2, 3, 6, 2),
    "EDGE2": _Form("move", 2, 3, 6, 2),
    "EDGE_SE3:QUAT": _Form("move", 2, 7, 21, 3),
    "EDGE3": _Form("move", 2, 6, 21, 3),
    "EDGE_SE2_XY": _Form("sighting", 2, 2, 3, 2),
    "LANDMARK": _Form("sighting", 2, 2, 3, 2),
    "EDGE_SE3_TRACKXYZ": _Form("sighting", 3, 3, 6, 3),
    "EDGE_SE3_XYZ": _Form("sighting", 2, 3, 6, 3),
    "BR": _Form("polar", 2, 2, 2, 2),
    "EDGE_BEARING_SE2_XY": _Form("bearing", 2, 1, 1, 2),
    "EDGE_RANGE_SE2_XY": _Form("range", 2, 1, 1, 2),
    "EDGE_RANGE": _Form("range", 2, 1, 1, 0),
    "PARAMS_SE3OFFSET": _Form("offset", 1, 7, 0, 3),
}
_IGNORED = ("FIX", "PARAMS_SE2OFFSET", "EQUIV")
_TRIANGLE = {1: (0,), 3: (0, 2), 6: (0, 3, 5), 21: (0, 6, 11, 15, 18, 20)}
"""Where the diagonal is in the upper triangle, row by row."""
_COLUMNS = {1: (0,), 3: (0, 2), 6: (0, 2, 5), 21: (0, 2, 5, 9, 14, 20)}
"""The same, column by column."""
_TORO = (0, 2, 3)
"""The same of an edge of TORO in the plane."""


class _Edge(NamedTuple):
    """A measurement between two variables, with the standard deviations (or nan) of its numbers."""

    first: Key
    second: Key
    values: FloatArray
    sigma: FloatArray
    noise: FloatArray
    line: int
    sensor: Key = ("", -1)


@dataclass(slots=True)
class _Graph:
    """What a file says."""

    path: Path
    is_pyfg: bool
    poses: dict[Key, FloatArray] = field(default_factory=dict)
    stamps: dict[Key, float] = field(default_factory=dict)
    places: dict[Key, FloatArray] = field(default_factory=dict)
    offsets: dict[Key, FloatArray] = field(default_factory=dict)
    edges: dict[str, list[_Edge]] = field(default_factory=dict)
    dims: set[int] = field(default_factory=set)

    def of(self, kind: str) -> list[_Edge]:
        """Return the edges of a kind."""
        return self.edges.get(kind, [])


def is_pose_graph(head: bytes) -> bool:
    """Return whether a file that begins so is a pose graph: by the first word of its first lines."""
    lines = [line.split() for line in head.decode("utf-8", "replace").splitlines()[:20]]
    words = [words[0] for words in lines if words and not words[0].startswith("#")]
    known = [word for word in words if word.removesuffix(":PRIOR") in _FORMS or word in _IGNORED]
    return bool(known) and known[0] == words[0] and words[0] != "LANDMARK"


def read_pose_graph(path: str | Path, robot: int | None = None) -> Recording | SpatialRecording:
    """Return the recording in a pose graph.

    Args:
        path: the file, or a folder or zip that holds one.
        robot: of PyFG files with several robots, from 1 in the order of their letters; None for the first.

    Raises:
        InputError: a line is malformed, or there is no such robot.
        DataError: it has no landmark, or no odometry.
    """
    path, warnings = Path(path), list[str]()
    graph = _parse_graph(*_content(path), warnings)
    chain = _chain(graph, robot, path)
    if not any(graph.of(kind) for kind in ("sighting", "polar", "bearing", "range")):
        edges = f"{counted(len(graph.poses) or len(chain), 'pose')} and {counted(len(graph.of('move')), 'edge')}"
        hint = "evermap maps landmarks: a graph with EDGE_SE2_XY, EDGE_SE3_TRACKXYZ or ranges to them"
        raise DataError(f"is a graph of poses only ({edges}), without any landmark", path=path, hint=hint)
    stamp_s = _stamps(graph, chain, warnings)
    row = {key: number for number, key in enumerate(chain)}
    steps, closures = _steps(graph, chain, row, warnings)
    build = _in_plane if graph.dims <= {0, 2} else _in_space
    names: dict[int, str] = {}
    recording = build(graph, stamp_s, row, steps, names)
    tied = [_closures(closures, row, stamp_s, recording.dim), *recording.measurements]
    recording = replace(
        recording,
        name=path.name.split(".")[0],
        source=str(path),
        landmark_names=names,
        measurements=tuple(table for table in tied if table is not None),
    )
    return finish_recording(recording, warnings=warnings)  # type: ignore[type-var]


def _content(path: Path) -> tuple[bytes, Path]:
    """Return the bytes of the file, and where it is."""
    if path.is_file() and not path.name.endswith(".zip"):
        return content_of(path), path
    files = find_file_set(path, _holds_graph)
    if files is None:
        raise InputError("no pose graph here", path=path, hint=POSE_GRAPH.looks_for)
    name = _graphs(files)[0]
    return files.read(name), files.path_of(name)


def _graphs(files: FileSet) -> list[str]:
    return sorted(name for name in files.members if name.endswith(ENDINGS))


def _holds_graph(files: FileSet) -> bool:
    names = _graphs(files)
    return len(names) == 1 and is_pose_graph(files.read(names[0])[:4096])


POSE_GRAPH = Reader(
    "pose_graph",
    "g2o, TORO or PyFG",
    _holds_graph,
    read_pose_graph,
    head=is_pose_graph,
)


# ------------------------------------------------------------------------------------------------- what the lines say


def _parse_graph(data: bytes, path: Path, warnings: list[str]) -> _Graph:
    lines = decode_text(data, path).split("\n")
    rows = [(number, line.split()) for number, line in enumerate(lines, 1) if line.strip() and line.lstrip()[0] != "#"]
    graph, unknown = _Graph(path, _has_stamps(rows)), Counter[str]()
    for number, words in rows:
        try:
            if not _take(graph, words, number):
                unknown[words[0][:40]] += 1
        except InputError:
            if number != rows[-1][0] or len(rows) < 2:
                raise
            warnings.append(f"{path.name}: 1 unfinished last line ({number}) left out")
    if unknown:
        kinds = ", ".join(f"{quote(kind)} ({count})" for kind, count in unknown.most_common(5))
        warnings.append(f"{path.name}: {counted(sum(unknown.values()), 'line')} of other kinds not read: {kinds}")
    if len(graph.dims - {0}) > 1:
        raise InputError("mixes the plane with space", path=path, hint="poses and edges of one kind")
    return graph


def _has_stamps(rows: Sequence[tuple[int, list[str]]]) -> bool:
    """Return whether a file is of PyFG: its poses and edges have a stamp before the key, which begins with a letter."""
    for _, words in rows:
        form = _FORMS.get(words[0])
        if form is not None and form.kind in ("pose", "move", "sighting", "range") and len(words) > 2:
            return words[2][:1].isalpha()
    return False


def _take(graph: _Graph, words: list[str], line: int) -> bool:
    """Add a line to the graph; False if its kind is not read."""
    form = _FORMS.get(words[0])
    if form is None:
        return words[0] in _IGNORED
    stamped = graph.is_pyfg and form.kind != "place"
    first = 2 if stamped else 1
    least = first + form.keys + form.values
    given = len(words) - least
    if given not in (0, form.noise):
        wanted = f"{least + form.noise - 1}"
        raise InputError(f"{len(words) - 1} numbers after {words[0]} instead of {wanted}", path=graph.path, line=line)
    keys = [_key(word, graph, line) for word in words[first : first + form.keys]]
    numbers = [_number(word, graph, line) for word in words[first + form.keys :]]
    values, noise = np.array(numbers[: form.values]), np.array(numbers[form.values :])
    if form.values in (6, 7) and form.dim == 3:
        values = _pose(values, graph, line)
    graph.dims.add(form.dim)
    match form.kind:
        case "pose":
            graph.poses[keys[0]] = values
            if stamped:
                graph.stamps[keys[0]] = _number(words[1], graph, line)
        case "place":
            graph.places[keys[0]] = values
        case "offset":
            graph.offsets[keys[0]] = values
        case _:
            sensor = keys[2] if form.keys == 3 else ("", -1)
            sigma = _sigmas(words[0], noise, form, of_covariance=graph.is_pyfg)
            graph.edges.setdefault(form.kind, []).append(_Edge(keys[0], keys[1], values, sigma, noise, line, sensor))
    return True


def _key(word: str, graph: _Graph, line: int) -> Key:
    match = _NAME.fullmatch(word)
    if match is None:
        raise InputError(f"{quote(word)} is not a name of a variable", path=graph.path, line=line, hint="7, x7 or L7")
    letters, number = match[1], int(match[2])
    if not letters and 2**56 <= number < 2**63:  # a gtsam::Symbol: a letter in the highest byte
        letters, number = chr(number >> 56), number & (2**56 - 1)
    if number >= _LARGEST_ID or not letters.isprintable():
        raise InputError(f"{quote(word)} is not a name of a variable", path=graph.path, line=line, hint="7, x7 or L7")
    return letters, number


def _number(word: str, graph: _Graph, line: int) -> float:
    try:
        value = parse_float(word)
    except ValueError:
        raise InputError(f"{quote(word)} is not a number", path=graph.path, line=line) from None
    if not np.isfinite(value):
        raise InputError(f"{quote(word)} where a finite number is needed", path=graph.path, line=line)
    return value


def _pose(values: FloatArray, graph: _Graph, line: int) -> FloatArray:
    """Return a pose (7,) of position and quaternion, or of position and roll, pitch, yaw."""
    if len(values) == 6:
        pose = se3.from_angles(values[3:])
        pose[:3] = values[:3]
        return pose
    if not np.linalg.norm(values[3:]) > 0.1:
        raise InputError("is not a quaternion", path=graph.path, line=line, hint="x y z qx qy qz qw")
    return np.asarray(se3.normalise_poses(values))


def _sigmas(name: str, noise: FloatArray, form: _Form, *, of_covariance: bool) -> FloatArray:
    """Return the standard deviations of what an edge measures; nan where it does not say."""
    if form.kind == "polar":
        return noise if len(noise) else np.full(2, np.nan)
    count = len(_TRIANGLE[form.noise])
    if not len(noise):
        return np.full(count, np.nan)
    diagonal = noise[list(_TORO if name == "EDGE2" else _TRIANGLE[form.noise])]
    if not (diagonal > 0.0).all():
        diagonal = noise[list(_COLUMNS[form.noise])]
    known = np.where(diagonal > 0.0, diagonal, np.nan)
    return np.asarray(np.sqrt(known if of_covariance else 1.0 / known))


# ----------------------------------------------------------------------------------------------- poses and their order


def _chain(graph: _Graph, robot: int | None, path: Path) -> list[Key]:
    """Return the poses of a robot, in the order of their stamps and numbers.

    Raises:
        InputError: there is no such robot.
        DataError: less than two poses.
    """
    poses = set(graph.poses) | {key for edge in graph.of("move") for key in (edge.first, edge.second)}
    poses -= {key for key in poses if key in graph.places or key[0].lower() == "l"}
    letters = sorted({key[0] for key in poses})
    if not poses:
        raise DataError("contains no pose", path=path)
    if robot is not None and not (1 <= robot <= len(letters) > 1):
        which = f"robots 1 to {len(letters)}" if len(letters) > 1 else "omit the robot"
        raise InputError(f"there is no robot {robot}", path=path, hint=which)
    mine = [key for key in poses if key[0] == letters[(robot or 1) - 1]]
    if len(mine) < 2:
        raise DataError("contains less than two poses", path=path)
    return sorted(mine, key=lambda key: (graph.stamps.get(key, 0.0), key[1]))


def _stamps(graph: _Graph, chain: list[Key], warnings: list[str]) -> FloatArray:
    """Return stamps (N,) of the poses."""
    stamp_s = np.array([graph.stamps.get(key, np.nan) for key in chain])
    if np.isfinite(stamp_s).all() and (np.diff(stamp_s) > 0.0).all() and np.abs(stamp_s).max() < 9.2e9:
        return stamp_s
    warnings.append(f"{graph.path.name}: its poses have no stamps of their own, and are taken to be one second apart")
    return np.arange(len(chain), dtype=np.float64)


def _steps(graph: _Graph, chain: list[Key], row: dict[Key, int], warnings: list[str]) -> tuple[FloatArray, list[_Edge]]:
    """Return the motion (N - 1, 3) or (N - 1, 7) between successive poses, and the other edges between poses.

    Raises:
        DataError: there is neither an edge between two of them, nor do both say where they are.
    """
    space = not graph.dims <= {0, 2}
    inverse, between = (se3.inverse, se3.between) if space else (se2.inverse, se2.between)
    found: dict[int, FloatArray] = {}
    others = []
    for edge in graph.of("move"):
        a, b = row.get(edge.first), row.get(edge.second)
        if a is None or b is None:
            continue
        if abs(a - b) == 1 and min(a, b) not in found:
            found[min(a, b)] = edge.values if b > a else np.asarray(inverse(edge.values))
        elif a != b:
            swapped = edge._replace(first=edge.second, second=edge.first, values=np.asarray(inverse(edge.values)))
            others.append(edge if b > a else swapped)
    lost = [k for k in range(len(chain) - 1) if k not in found]
    for k in lost:
        if chain[k] not in graph.poses or chain[k + 1] not in graph.poses:
            ends = " and ".join(f"{letters}{number}" for letters, number in chain[k : k + 2])
            raise DataError(
                f"has no edge between the successive poses {ends}", path=graph.path, hint="odometry as edges"
            )
        found[k] = np.asarray(between(graph.poses[chain[k]], graph.poses[chain[k + 1]]))
    if lost:
        remark = f"{counted(len(lost), 'step')} without an edge of odometry taken from what the vertices say"
        warnings.append(f"{graph.path.name}: {remark}")
    steps = np.array([found[k] for k in range(len(chain) - 1)])
    far = np.flatnonzero(np.abs(steps[:, :2]).max(axis=1) > _MOST_M)
    if len(far):
        raise DataError(f"a step of {np.abs(steps[far[0], :2]).max():g} m", path=graph.path, hint="metres")
    return steps, others


def _closures(edges: list[_Edge], row: dict[Key, int], stamp_s: FloatArray, dim: int) -> Measurements | None:
    """Return edges between poses that do not follow each other, as a table; None if there are none."""
    if not edges:
        return None
    edges = sorted(edges, key=lambda edge: row[edge.first])
    pose = np.array([edge.values for edge in edges])
    at, to = (stamp_s[[row[key] for key in keys]] for keys in zip(*((e.first, e.second) for e in edges), strict=True))
    sigma = np.array([edge.sigma for edge in edges])
    split = 2 if dim == 2 else 3
    nothing = np.full(len(edges), np.nan)
    roll, pitch, yaw = (nothing, nothing, se2.wrap(pose[:, 2])) if dim == 2 else _angles(pose)
    columns = {
        "to_stamp_s": to,
        "x_m": pose[:, 0].copy(),
        "y_m": pose[:, 1].copy(),
        "yaw_rad": yaw,
        "z_m": nothing if dim == 2 else pose[:, 2].copy(),
        "roll_rad": roll,
        "pitch_rad": pitch,
        "sigma_m": _typical(sigma[:, :split], 0.1),
        "sigma_rad": _typical(sigma[:, split:], 0.03),
    }
    return Measurements("closures", at, columns, np.full(len(edges), UNKNOWN))


def _typical(sigma: FloatArray, default: float) -> FloatArray:
    """Return one standard deviation (K,) for several axes (K, n); `default` where none is known."""
    known = np.isfinite(sigma)
    mean = np.where(known, sigma, 0.0) ** 2 @ np.ones(sigma.shape[1]) / np.maximum(known.sum(axis=1), 1)
    return np.where(known.any(axis=1), np.sqrt(mean), default)


def _angles(pose: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return roll, pitch and yaw (K,) of poses (K, 7), as `se3.from_angles` takes them."""
    turn = se3.rotation_of(pose)
    pitch = -np.arcsin(np.clip(turn[:, 2, 0], -1.0, 1.0))
    return np.arctan2(turn[:, 2, 1], turn[:, 2, 2]), pitch, np.arctan2(turn[:, 1, 0], turn[:, 0, 0])


# ------------------------------------------------------------------------------------------------------------ landmarks


def _landmark_ids(edges: Sequence[_Edge], names: dict[int, str]) -> IntArray:
    """Return ids (M,) of landmarks; `names` takes up those that have letters."""
    return np.array([_landmark_id(edge.second, names) for edge in edges], dtype=np.int64)


def _landmark_id(key: Key, names: dict[int, str]) -> int:
    if not key[0]:
        return key[1]
    text = f"{key[0]}{key[1]}"
    names[landmark_id_of(text)] = text
    return landmark_id_of(text)


def _list_sightings(graph: _Graph, kind: str, row: dict[Key, int]) -> list[_Edge]:
    """Return the edges of a kind from a pose of this robot to a landmark, in the order of the poses."""
    edges = [edge for edge in graph.of(kind) if edge.first in row and edge.second not in row]
    edges = [edge for edge in edges if edge.second not in graph.poses or edge.second[0].lower() == "l"]
    return sorted(edges, key=lambda edge: row[edge.first])


def _in_plane(
    graph: _Graph, stamp_s: FloatArray, row: dict[Key, int], steps: FloatArray, names: dict[int, str]
) -> Recording:
    twist = se2.log(steps) / np.diff(stamp_s)[:, None]
    forward, lateral, angular = np.ascontiguousarray(np.vstack([twist, twist[-1:]]).T)
    clock = _clock(stamp_s)
    seen, polar, aimed, ranged = (
        _list_sightings(graph, kind, row) for kind in ("sighting", "polar", "bearing", "range")
    )
    at = np.array([edge.values for edge in seen]).reshape(-1, 2)
    reading = np.vstack(
        [
            np.column_stack([np.hypot(*at.T), np.arctan2(at[:, 1], at[:, 0]), _polar_sigmas(seen, graph.is_pyfg)]),
            np.array([(edge.values[1], edge.values[0], *edge.sigma[::-1]) for edge in polar]).reshape(-1, 4),
        ]
    )
    edges = [*seen, *polar]
    if not edges:  # a sensor of ranges alone
        edges, ranged = ranged, []
        reading = np.array([(edge.values[0], np.nan, edge.sigma[0], np.nan) for edge in edges]).reshape(-1, 4)
    order = np.argsort([row[edge.first] for edge in edges], kind="stable")
    edges, reading = [edges[k] for k in order], reading[order]
    reading[:, 1] = np.where(np.isnan(reading[:, 1]), np.nan, se2.wrap(np.nan_to_num(reading[:, 1])))
    detections = Detections(
        frame=np.array([row[edge.first] for edge in edges], dtype=np.int64),
        landmark_id=_landmark_ids(edges, names),
        range_m=reading[:, 0].copy(),
        bearing_rad=reading[:, 1].copy(),
        class_id=np.full(len(edges), UNKNOWN),
        sigma_range_m=reading[:, 2].copy(),
        sigma_bearing_rad=reading[:, 3].copy(),
        source_line=np.array([edge.line for edge in edges], dtype=np.int64),
    )
    truth = None
    if graph.is_pyfg and all(key in graph.poses for key in row):
        pose = np.array([graph.poses[key] for key in row])
        pose[:, 2] = se2.wrap(pose[:, 2])
        truth = Trajectory(stamp_s, pose, np.zeros((len(pose), 3, 3)), frame="truth", clock=clock)
    return Recording(
        name="",
        odometry=Odometry(stamp_s, forward, lateral, angular, clock=clock, is_measured=True),
        frames=Frames(stamp_s, complete=False, clock=clock),
        detections=detections,
        truth=truth,
        true_landmarks=_survey(graph, names, clock),
        clock=clock,
        measurements=_make_measurements(aimed, ranged, row, stamp_s, names),
    )


def _polar_sigmas(edges: Sequence[_Edge], of_covariance: bool) -> FloatArray:
    """Return the standard deviations of range and bearing (M, 2) of positions of landmarks; nan where not known."""
    found = np.full((len(edges), 2), np.nan)
    for k, edge in enumerate(edges):
        far = float(np.hypot(*edge.values))
        if len(edge.noise) != 3 or not far > 0.0:
            continue
        matrix = np.array([edge.noise[:2], edge.noise[1:]])
        if not np.linalg.det(matrix) > 0.0 or not matrix[0, 0] > 0.0:
            continue
        covariance = matrix if of_covariance else np.linalg.inv(matrix)
        along = edge.values / far
        across = np.array([-along[1], along[0]])
        found[k] = np.sqrt(along @ covariance @ along), np.sqrt(across @ covariance @ across) / far
    return found


def _in_space(
    graph: _Graph, stamp_s: FloatArray, row: dict[Key, int], steps: FloatArray, names: dict[int, str]
) -> SpatialRecording:
    clock = _clock(stamp_s)
    pose = accumulate(steps)
    # tags with an orientation are poses of gtsam that are called l7
    tags = [edge for edge in _list_sightings(graph, "move", row) if edge.second[0].lower() == "l"]
    edges = sorted([*_list_sightings(graph, "sighting", row), *tags], key=lambda edge: row[edge.first])
    used = sorted({edge.sensor for edge in edges if edge.sensor in graph.offsets})
    sensors = tuple(
        SpatialSensor(name=f"sensor{key[1]}", mount_robot_sensor=tuple(graph.offsets[key].tolist())) for key in used
    ) or (SpatialSensor(),)
    rotation = np.full((len(edges), 4), np.nan)
    for k, edge in enumerate(edges):
        if len(edge.values) == 7:
            rotation[k] = edge.values[3:]
    detections = spatial_detections(
        np.array([row[edge.first] for edge in edges], dtype=np.int64),
        sensor=np.array([used.index(edge.sensor) if edge.sensor in used else 0 for edge in edges], dtype=np.int64),
        landmark_id=_landmark_ids(edges, names),
        position_sensor_m=np.array([edge.values[:3] for edge in edges]).reshape(-1, 3),
        rotation=rotation,
        covariance_sensor_m2=_covariances(edges, graph.is_pyfg),
        source_line=np.array([edge.line for edge in edges], dtype=np.int64),
    )
    truth = None
    if graph.is_pyfg and all(key in graph.poses for key in row):
        true = np.array([graph.poses[key] for key in row])
        truth = Trajectory(stamp_s, true, np.zeros((len(true), 6, 6)), frame="truth", clock=clock)
    return Recording(
        name="",
        odometry=SpatialOdometry(stamp_s, pose, np.full((len(pose), 6), np.nan), clock=clock),
        frames=Frames(stamp_s, complete=False, clock=clock),
        detections=detections,
        sensors=sensors,
        truth=truth,
        true_landmarks=_survey(graph, names, clock),
        clock=clock,
        measurements=_make_measurements([], _list_sightings(graph, "range", row), row, stamp_s, names),
    )


def _covariances(edges: Sequence[_Edge], of_covariance: bool) -> FloatArray:
    """Return covariances (M, 3, 3) of positions; nan where the edge has none, or none that can be."""
    found = np.full((len(edges), 3, 3), np.nan)
    for k, edge in enumerate(edges):
        if len(edge.noise) != 6:
            continue
        matrix = np.zeros((3, 3))
        upper, right = np.triu_indices(3)
        matrix[upper, right] = matrix[right, upper] = edge.noise
        least = float(np.linalg.eigvalsh(matrix)[0])
        if least > 0.0 and np.linalg.cond(matrix) < 1e9:
            found[k] = matrix if of_covariance else np.linalg.inv(matrix)
            found[k] = (found[k] + found[k].T) / 2.0
    return found


def _make_measurements(
    aimed: Sequence[_Edge], ranged: Sequence[_Edge], row: dict[Key, int], stamp_s: FloatArray, names: dict[int, str]
) -> tuple[Measurements, ...]:
    """Return bearings and ranges that come beside other detections."""
    found = []
    nothing = {
        "bearings": {"elevation_rad": np.nan},
        "ranges": dict.fromkeys(("lever_x_m", "lever_y_m", "lever_z_m"), 0.0),
    }
    for kind, edges, name, sigma, usual in (
        ("bearings", aimed, "azimuth_rad", "sigma_rad", 0.02),
        ("ranges", [edge for edge in ranged if edge.values[0] > 0.0], "range_m", "sigma_m", 0.1),
    ):
        if edges:
            at = stamp_s[[row[edge.first] for edge in edges]]
            columns = {
                name: np.array([edge.values[0] for edge in edges]),
                sigma: _typical(np.array([edge.sigma for edge in edges]), usual),
                **{key: np.full(len(edges), value) for key, value in nothing[kind].items()},
            }
            found.append(Measurements(kind, at, columns, _landmark_ids(edges, names)))
    return tuple(found)


def _survey(graph: _Graph, names: dict[int, str], clock: Clock) -> Landmarks | None:
    """Return where the landmarks of PyFG truly are."""
    if not graph.is_pyfg or not graph.places:
        return None
    ids = [_landmark_id(key, names) for key in graph.places]
    at = np.array(list(graph.places.values()))
    if at.shape[1] == 2:
        return replace(Landmarks.at(ids, at), names=names, clock=clock)
    return Landmarks.in_space(ids, at, names=names, clock=clock)


def _clock(stamp_s: FloatArray) -> Clock:
    return Clock.UNIX if stamp_s[0] > SINCE_1970_S else Clock.RECORDING
