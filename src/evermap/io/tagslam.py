"""Recordings of TagSLAM (Pfrommer, Daniilidis, arXiv 1910.00679, 2019): square tags seen by calibrated cameras.

A folder holds `cameras.yaml`, `camera_poses.yaml` and `tagslam.yaml` as TagSLAM reads them, and what was seen: tables
(`detections`, `frames`, optionally `odometry`, `reference`, `survey`), or the ROS 1 bag itself. The robot's frame is
the rig, in which `camera_poses.yaml` gives the cameras. What the authors mended by hand, `tag_id_remap` and
`ignore_tags`, is not applied: which identities are wrong is for the estimate to find.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evermap.errors import DataError, InputError, MissingExtraError
from evermap.geometry import se3
from evermap.io.assemble import finish_recording, forward_stamps, looks_of
from evermap.io.files import FileSet, Reader, find_file_set
from evermap.io.landmarks import survey_of
from evermap.io.native_space import CORNERS
from evermap.io.rig_toml import Rig
from evermap.io.rosbag import BAG_ENDINGS, METADATA, MOST_HAMMING, TagSightings, read_tag_bag, topics_of
from evermap.io.spatial import of_rig, pose_odometry, sensor_rows, spatial_detections, true_poses, with_tag_poses
from evermap.io.table import ENDINGS, Table, parse_table
from evermap.io.tag_maps import map_of_survey, pose_of_tagslam
from evermap.io.text import counted, is_number
from evermap.io.yaml import parse_yaml
from evermap.types import (
    Clock,
    FloatArray,
    Frames,
    Landmarks,
    Recording,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
)
from evermap.valid import CAMERA_MODELS, STAMP_S, Quantity

_MOST_TAGS = 100_000
"""Maximum tags of a board: no tag family has more."""

CAMERAS, CAMERA_POSES, SETTINGS = "cameras.yaml", "camera_poses.yaml", "tagslam.yaml"
_VARIANCES = ("cxx", "cyy", "czz", "crr", "cpp", "cww")
_MODELS = {"equidistant": "equidistant", "radtan": "radtan", "plumb_bob": "radtan", "pinhole": "pinhole"}


class TagRig(NamedTuple):
    """The calibration files.

    Attributes:
        rig: the cameras, and the sizes of tags.
        tag_topics: on which each camera's tags come in a bag.
        odometry_topic: of the odometry in a bag; '' where there is none.
        mount_rig_odometry: (7,) pose of the odometry's body in the rig's frame.
    """

    rig: Rig
    tag_topics: tuple[str, ...]
    odometry_topic: str
    mount_rig_odometry: FloatArray


def read_tagslam(path: str | Path, robot: int | None = None) -> SpatialRecording:
    """Return a recording of TagSLAM from a folder of tables, or from a ROS 1 bag beside the calibration files.

    Args:
        path: folder with `cameras.yaml`, `camera_poses.yaml`, `tagslam.yaml` and tables; or a `.bag` or `.bag.bz2` in
            such a folder, whose tags and odometry are then taken instead of the tables'.
        robot: must be None.

    Raises:
        InputError: a file is missing or malformed, with its line.
        DataError: no tag was seen.
        MissingExtraError: a bag is asked for, and the package that reads bags is not installed.
    """
    path = Path(path)
    if robot is not None:
        raise InputError(f"there is no robot {robot}: the recording has one rig", path=path, hint="omit the robot")
    bag = path if path.is_file() and path.name.endswith(BAG_ENDINGS) else None
    files = find_file_set(path if bag is None else path.parent, is_tagslam if bag is None else _is_calibrated)
    if files is None:
        raise InputError("no TagSLAM recording here", path=path, hint=TAGSLAM.looks_for)
    bag = bag or _only_bag(files)
    warnings: list[str] = []
    setup = _setup(files)
    if bag is None:
        seen, odometry = _sightings(files, setup, warnings), None
    else:
        seen, odometry = read_tag_bag(bag, setup.tag_topics, setup.odometry_topic)
    odometry = odometry or _odometry(files, warnings)
    if odometry is not None:
        odometry = of_rig(odometry, setup.mount_rig_odometry)
    return _recording(files, path, setup, seen, odometry, warnings)


def is_tagslam(files: FileSet) -> bool:
    """Return whether files are a TagSLAM recording: its calibration beside tables of tags, or beside one of its bags.

    A calibration alone does not make other tables, or another bag, TagSLAM's.
    """
    if not _is_calibrated(files):
        return False
    if _has_detections(files):
        return _lists_tags(files)
    bags = [name for name in files.members if name.endswith(BAG_ENDINGS)]
    return METADATA not in files and any(files.zipped or _is_its_bag(files, files.path_of(name)) for name in bags)


def _lists_tags(files: FileSet) -> bool:
    """Return whether the table of detections is one of tags, by its columns."""
    try:
        table = _table(files, "detections", [])
    except InputError:  # reading it will tell
        return True
    return table is not None and "tag_id" in table and "landmark_id" not in table


def _is_its_bag(files: FileSet, bag: Path) -> bool:
    """Return whether a bag has a topic that `cameras.yaml` calls one of tags."""
    try:
        cameras = _yaml(files, CAMERAS).values()
        wanted = {str(camera.get("tagtopic", "")) for camera in cameras if isinstance(camera, dict)}
        return bool(wanted & topics_of(bag).keys())
    except MissingExtraError:  # reading it will tell
        return True
    except InputError:
        return False


def _is_beside_calibration(path: Path) -> bool:
    """Return whether a bag is one of TagSLAM, by the calibration beside it and the topics in it."""
    files = find_file_set(path.parent, _is_calibrated)
    return files is not None and _is_its_bag(files, path)


def _has_detections(files: FileSet) -> bool:
    return any(f"detections{ending}" in files for ending in ENDINGS)


def _only_bag(files: FileSet) -> Path | None:
    """The bag of a folder that has no tables."""
    bags = sorted(name for name in files.members if name.endswith(BAG_ENDINGS))
    if _has_detections(files) or not bags:
        return None
    if len(bags) > 1:
        raise InputError(f"contains {len(bags)} bags: {', '.join(bags)}", path=files.root, hint="name one of them")
    if files.zipped:
        raise InputError("a bag inside a zip is not read", path=files.path_of(bags[0]), hint="unpack the zip")
    return files.path_of(bags[0])


def _is_calibrated(files: FileSet) -> bool:
    return CAMERAS in files and CAMERA_POSES in files


TAGSLAM = Reader(
    "tagslam",
    "cameras.yaml and camera_poses.yaml beside detections.csv or a .bag of tags",
    is_tagslam,
    read_tagslam,
    endings=BAG_ENDINGS,
    accepts=_is_beside_calibration,
)


def _recording(
    files: FileSet,
    path: Path,
    setup: TagRig,
    seen: TagSightings,
    odometry: SpatialOdometry | None,
    warnings: list[str],
) -> SpatialRecording:
    doubtful = seen.hamming > MOST_HAMMING
    if doubtful.any():
        warnings.append(f"{counted(int(doubtful.sum()), 'tag')} with more than {MOST_HAMMING} wrong bits left out")
    order = np.flatnonzero(~doubtful)
    order = order[np.argsort(seen.stamp_s[order], kind="stable")]
    looked, frame = looks_of(np.concatenate([seen.looked_s, seen.stamp_s]), seen.stamp_s[order])
    detections = spatial_detections(
        frame,
        sensor=seen.camera[order],
        landmark_id=seen.tag_id[order],
        corner_px=seen.corner_px[order],
        tag_size_m=setup.rig.size_of(seen.tag_id[order]),
        source_line=seen.line[order],
    )
    recording = Recording(
        name=f"TagSLAM {files.title}",
        odometry=odometry,
        frames=Frames(looked, complete=seen.complete, clock=Clock.UNIX),
        detections=with_tag_poses(detections, setup.rig.sensors, warnings),
        sensors=setup.rig.sensors,
        truth=_reference(files, warnings),
        true_landmarks=_survey(files, warnings),
        source=str(path),
        clock=Clock.UNIX,
    )
    return finish_recording(recording, warnings=warnings)


def _setup(files: FileSet) -> TagRig:
    cameras = _yaml(files, CAMERAS)
    mounts = _yaml(files, CAMERA_POSES)
    content = _yaml(files, SETTINGS) if SETTINGS in files else {}
    sensors, topics = [], []
    for name, camera in cameras.items():
        model = _MODELS.get(str(_get(files, CAMERAS, camera, "distortion_model", name)))
        if model is None:
            hint = "one of " + ", ".join(_MODELS)
            field = f"{name}.distortion_model"
            raise InputError("unknown camera model", path=files.path_of(CAMERAS), field=field, hint=hint)
        distortion = _numbers(files, CAMERAS, camera, "distortion_coeffs", name, (0, *CAMERA_MODELS[model]))
        width, height = _numbers(files, CAMERAS, camera, "resolution", name, (2,))
        fx, fy, cx, cy = _numbers(files, CAMERAS, camera, "intrinsics", name, (4,))
        pose = _get(files, CAMERA_POSES, mounts, name, "")
        sensor = SpatialSensor(
            name=name,
            mount_robot_sensor=tuple(
                pose_of_tagslam(
                    _get(files, CAMERA_POSES, pose, "pose", name), files.path_of(CAMERA_POSES), name
                ).tolist()
            ),
            intrinsics=(fx, fy, cx, cy),
            distortion=distortion,
            distortion_model=model,
            resolution_px=(int(width), int(height)),
        )
        sensors.append(sensor)
        topics.append(str(camera.get("tagtopic", "")))
    if not sensors:
        raise InputError("lists no camera", path=files.path_of(CAMERAS))
    bodies = _bodies(files, content)
    mounted = next((body for body in bodies.values() if "T_body_odom" in body), {})
    stated = mounted.get("T_body_odom")
    odometry = pose_of_tagslam(stated, files.path_of(SETTINGS), "T_body_odom") if mounted else se3.identity()
    sizes, default = _sizes(files, bodies, content.get("default_body"))
    topic = next((str(body["odom_topic"]) for body in bodies.values() if "odom_topic" in body), "")
    rig = Rig(sensors=tuple(sensors), tag_size_m=default, tag_sizes=sizes)
    return TagRig(rig, tuple(topics), topic, odometry)


def _bodies(files: FileSet, content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    listed = content.get("bodies") or []
    if not isinstance(listed, list) or not all(isinstance(body, dict) for body in listed):
        raise InputError("must be a list of bodies", path=files.path_of(SETTINGS), field="bodies")
    bodies = {name: {} if body is None else body for entry in listed for name, body in entry.items()}
    odd = next((name for name, body in bodies.items() if not isinstance(body, dict)), None)
    if odd is not None:
        raise InputError("is not described", path=files.path_of(SETTINGS), field=odd)
    return bodies


def _sizes(files: FileSet, bodies: Mapping[str, dict[str, Any]], default_body: Any) -> tuple[dict[int, float], float]:
    """Edges of tags by id, and that of all others: the default body's, or that of all bodies if they agree."""
    sizes: dict[int, float] = {}
    defaults: dict[str, float] = {}
    for name, body in bodies.items():
        try:
            if board := body.get("board"):
                first, count = int(board["tag_start_id"]), int(board["tag_rows"]) * int(board["tag_columns"])
                sizes |= dict.fromkeys(range(first, first + min(count, _MOST_TAGS)), float(board["tag_size"]))
            if "default_tag_size" in body:
                defaults[name] = float(body["default_tag_size"])
            for tag in body.get("tags") or []:
                if (size := tag.get("size", defaults.get(name))) is not None:
                    sizes[int(tag["id"])] = float(size)
        except (KeyError, TypeError, ValueError, AttributeError):
            problem = "its tags or board are not described"
            hint = "tags with id and size, or a board with tag_start_id, tag_rows, tag_columns, tag_size"
            raise InputError(problem, path=files.path_of(SETTINGS), field=name, hint=hint) from None
    wrong = next((size for size in (*sizes.values(), *defaults.values()) if not 0.0 < size < 1e3), None)
    if wrong is not None:
        problem = f"{wrong:g} is not the edge length of a tag"
        raise InputError(problem, path=files.path_of(SETTINGS), field="size", hint="metres")
    if str(default_body) in defaults:
        return sizes, defaults[str(default_body)]
    common = set(defaults.values())
    return sizes, common.pop() if len(common) == 1 else float("nan")


def _sightings(files: FileSet, setup: TagRig, warnings: list[str]) -> TagSightings:
    table = _table(files, "detections", warnings)
    assert table is not None
    table.expect(("stamp_s", "camera", "tag_id", *CORNERS), tuple(table.columns))
    table = table.screened((STAMP_S, *(Quantity(name, -1e6, 1e6, hint="pixels") for name in CORNERS)), warnings)
    corner = np.stack([table.numbers(Quantity(name, -1e6, 1e6, hint="pixels")) for name in CORNERS], axis=1)
    stamp_s = forward_stamps(table)
    frames = _table(files, "frames", warnings)
    return TagSightings(
        looked_s=stamp_s if frames is None else forward_stamps(frames),
        stamp_s=stamp_s,
        camera=sensor_rows(table, "camera", setup.rig.sensors, CAMERAS),
        tag_id=table.ids("tag_id", optional=False),
        hamming=table.counts("hamming"),
        corner_px=corner.reshape(-1, 4, 2),
        line=np.asarray(table.line, dtype=np.int64),
        complete=frames is not None,
    )


def _odometry(files: FileSet, warnings: list[str]) -> SpatialOdometry | None:
    table = _table(files, "odometry", warnings)
    if table is None:
        return None
    if len(table) == 0:
        raise DataError("contains no odometry", path=table.path)
    return pose_odometry(table, _VARIANCES, Clock.UNIX, warnings)


def _reference(files: FileSet, warnings: list[str]) -> Trajectory | None:
    table = _table(files, "reference", warnings)
    return None if table is None or len(table) == 0 else true_poses(table, Clock.UNIX, warnings)


def _survey(files: FileSet, warnings: list[str]) -> Landmarks | None:
    table = _table(files, "survey", warnings)
    return survey_of(map_of_survey(table) if table is not None and len(table) else None, clock=Clock.UNIX)


def _table(files: FileSet, name: str, warnings: list[str]) -> Table | None:
    file = next((f"{name}{ending}" for ending in ENDINGS if f"{name}{ending}" in files), None)
    return None if file is None else parse_table(files.read(file), files.path_of(file), warnings)


def _yaml(files: FileSet, name: str) -> dict[str, Any]:
    content = parse_yaml(files.read(name), files.path_of(name))
    if not isinstance(content, dict):
        raise InputError("must be a map of names", path=files.path_of(name))
    return content


def _get(files: FileSet, name: str, content: Any, key: str, inside: str) -> Any:
    if not isinstance(content, dict) or key not in content:
        field = f"{inside}.{key}" if inside else key
        raise InputError("is missing", path=files.path_of(name), field=field)
    return content[key]


def _numbers(
    files: FileSet, name: str, content: Any, key: str, inside: str, counts: tuple[int, ...]
) -> tuple[float, ...]:
    values = _get(files, name, content, key, inside) or []
    if not isinstance(values, list) or len(values) not in counts or not all(map(is_number, values)):
        wanted = " or ".join(map(str, counts))
        field = f"{inside}.{key}"
        raise InputError(f"must be a list of {wanted} numbers", path=files.path_of(name), field=field)
    return tuple(map(float, values))
