"""Messages read by compiled decoders are those that `rosbags` reads, and what it refuses is refused with its words."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evermap.io.bag_messages import KINDS
from evermap.io.cdr import Cdr
from evermap.io.rosbag import ros2_types

TYPES = ros2_types()
READ = sorted(kind for kind in TYPES.fielddefs if kind.rsplit("/", 1)[-1] in KINDS)
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


def same(one: Any, other: Any) -> bool:
    if hasattr(one, "__dataclass_fields__"):
        return type(one) is type(other) and all(
            same(getattr(one, name), getattr(other, name)) for name in one.__dataclass_fields__ if name[0] != "_"
        )
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    return type(one) is type(other) and bool(one == other)


def test_every_type_that_is_read_is_tested() -> None:
    read = {kind.rsplit("/", 1)[-1] for kind in READ}
    assert {"Odometry", "TFMessage", "CameraInfo", "MarkerArray", "SceneUpdate", "AprilTagDetectionArray"} <= read
    assert {"Detection2DArray", "Detection3DArray", "PoseWithCovarianceStamped", "TwistStamped"} <= read


@pytest.mark.parametrize("kind", READ)
@pytest.mark.parametrize("lowest_first", [True, False])
def test_a_message_is_read_as_rosbags_reads_it(kind: str, lowest_first: bool) -> None:
    rng, reader = np.random.default_rng(7), Cdr(TYPES)
    for _ in range(20):
        raw = bytes(TYPES.serialize_cdr(drawn(kind, rng), kind, little_endian=lowest_first))
        assert same(TYPES.deserialize_cdr(raw, kind), reader.decode(raw, kind))


@pytest.mark.parametrize("kind", READ)
def test_a_damaged_message_is_refused_where_rosbags_refuses_it(kind: str) -> None:
    rng, reader = np.random.default_rng(8), Cdr(TYPES)

    def read(by: Any, raw: bytes) -> Any:
        try:
            return by(raw, kind)
        except Exception as error:
            return f"{type(error).__name__}: {error}"

    for _ in range(60):
        raw = bytearray(TYPES.serialize_cdr(drawn(kind, rng), kind))
        for _ in range(int(rng.integers(1, 4))):
            raw[int(rng.integers(len(raw)))] = int(rng.integers(256))
        some = bytes(raw[: int(rng.integers(len(raw) + 1))] if rng.random() < 0.5 else raw)
        one, other = read(TYPES.deserialize_cdr, some), read(reader.decode, some)
        assert repr(one) == repr(other)


def test_a_type_that_is_not_known_is_a_key_error() -> None:
    with pytest.raises(KeyError):
        Cdr(TYPES).decode(b"\0\1\0\0", "other_msgs/msg/Thing")
