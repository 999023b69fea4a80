"""Columns of the parts of a message hold what `rosbags` reads."""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.io.bag_messages import OBJECT_FIELDS
from evermap.io.cdr import parts_of
from evermap.io.rosbag import ros2_types

TYPES = ros2_types()
NUMBERS = {"float32": np.float32, "float64": np.float64, "bool": np.bool_}


def drawn(kind: str, rng: np.random.Generator) -> Any:
    """A message with random contents: lists of up to three, texts of any length."""
    return TYPES.types[kind](*(_value(*how, rng) for _, how in TYPES.fielddefs[kind][1]))


def _value(how: int, what: Any, rng: np.random.Generator) -> Any:
    if how == 2:
        return drawn(what, rng)
    if how == 1:
        return _base(what[0], 1, rng)[0]
    (inner, of), count = what[0], int(what[1]) if how == 3 else int(rng.integers(4))
    return _base(of[0], count, rng) if inner == 1 else [_value(inner, of, rng) for _ in range(count)]


def _base(name: str, count: int, rng: np.random.Generator) -> Any:
    if name == "string":
        return ["käse"[: int(rng.integers(5))] * int(rng.integers(3)) for _ in range(count)]
    if name.startswith("float"):
        return rng.normal(size=count).astype(NUMBERS[name])
    return rng.integers(0, 2 if name == "bool" else 120, count).astype(NUMBERS.get(name, name.replace("byte", "uint8")))


OBJECTS = "vision_msgs/msg/Detection3DArray"


def at(part: Any, field: str) -> Any:
    for name in field.split("/"):
        part = getattr(part[0] if isinstance(part, list) else part, name)
    if isinstance(part, str | np.ndarray):
        return part
    if not hasattr(part, "__dataclass_fields__"):
        return np.array([part])
    return np.concatenate([at(part, name) for name in part.__dataclass_fields__ if name[0] != "_"])


def objects(rng: np.random.Generator, results: int = 1) -> Any:
    """Objects with so many hypotheses each."""
    message = drawn(OBJECTS, rng)
    result = [drawn("vision_msgs/msg/ObjectHypothesisWithPose", rng) for _ in range(results)]
    found = [drawn("vision_msgs/msg/Detection3D", rng) for _ in range(int(rng.integers(5)))]
    message.detections = [type(one)(one.header, result, one.bbox, one.id) for one in found]
    return message


def test_columns_of_parts_are_what_the_parts_hold() -> None:
    rng = np.random.default_rng(9)
    for _ in range(40):
        message = objects(rng)
        parts = parts_of(bytes(TYPES.serialize_cdr(message, OBJECTS)), OBJECTS, OBJECT_FIELDS)
        assert parts is not None
        stamp = message.header.stamp
        assert parts.stamp_s == stamp.sec + 1e-9 * stamp.nanosec
        assert parts.frame == message.header.frame_id
        assert {*parts.numbers, *parts.texts} == set(OBJECT_FIELDS)
        for field, column in (parts.numbers | parts.texts).items():
            assert len(column) == len(message.detections)
            for found, one in zip(column, message.detections, strict=True):
                np.testing.assert_array_equal(found, at(one, field))


def test_columns_are_none_where_a_message_has_to_be_decoded() -> None:
    rng = np.random.default_rng(10)
    whole = objects(rng)
    while len(whole.detections) < 2:
        whole = objects(rng)
    raw = bytes(TYPES.serialize_cdr(whole, OBJECTS))
    assert parts_of(raw, OBJECTS, OBJECT_FIELDS) is not None
    assert parts_of(raw + bytes(8), OBJECTS, OBJECT_FIELDS) is None
    assert all(parts_of(raw[:end], OBJECTS, OBJECT_FIELDS) is None for end in range(len(raw) - 4))
    assert parts_of(bytes(TYPES.serialize_cdr(whole, OBJECTS, little_endian=False)), OBJECTS, OBJECT_FIELDS) is None
    for results in (0, 2):
        whole.detections[1].results[:] = [drawn("vision_msgs/msg/ObjectHypothesisWithPose", rng)] * results
        assert parts_of(bytes(TYPES.serialize_cdr(whole, OBJECTS)), OBJECTS, OBJECT_FIELDS) is None
    assert parts_of(raw, OBJECTS, ("other",)) is None
    pose = bytes(TYPES.serialize_cdr(drawn("geometry_msgs/msg/PoseStamped", rng), "geometry_msgs/msg/PoseStamped"))
    assert parts_of(pose, "geometry_msgs/msg/PoseStamped", OBJECT_FIELDS) is None


def test_damaged_columns_are_none_or_those_of_the_damaged_message() -> None:
    rng = np.random.default_rng(11)
    for _ in range(300):
        raw = bytearray(TYPES.serialize_cdr(objects(rng), OBJECTS))
        for _ in range(int(rng.integers(1, 4))):
            raw[int(rng.integers(4, len(raw)))] = int(rng.integers(256))
        if (parts := parts_of(bytes(raw), OBJECTS, OBJECT_FIELDS)) is not None:
            message = TYPES.deserialize_cdr(bytes(raw), OBJECTS)
            for field, column in (parts.numbers | parts.texts).items():
                np.testing.assert_array_equal(list(column), [at(one, field) for one in message.detections])
