"""Long lists in messages of ROS 2, read from CDR as columns by one compiled function, without an object for each part.

What `rosbags` reads has an object for every part of every part; a hundred detections take it several times as long.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from evermap.compiled import kept
from evermap.io.rosbag import ros2_types
from evermap.types import FloatArray, IntArray

_DTYPES = {
    "bool": "u1", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
    "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_BASE, _NAME, _ARRAY = 1, 2, 3
"""Kinds of fields, as `rosbags.interfaces.Nodetype` numbers them; the fourth is a sequence."""

_TEXT, _LIST, _END = 3, 4, 5
"""Codes of what is no number, in the steps of `_read`; before them integers, signed ones, and floats."""
_DEPTH = 8
"""Lists within lists, at most."""


class Parts(NamedTuple):
    """Parts of one kind that a message lists, by columns.

    Attributes:
        stamp_s: of the message's header.
        frame: of it.
        numbers: (n, k) of n parts, by the name of their field and what it is in, such as `bbox/size`.
        texts: n by the name of their field.
    """

    stamp_s: float
    frame: str
    numbers: dict[str, FloatArray]
    texts: dict[str, list[str]]


def parts_of(raw: bytes, kind: str, fields: tuple[str, ...]) -> Parts | None:
    """Return fields of the parts that a message lists after its header; None where `rosbags` has to read it.

    That is where it is damaged, a field is missing, or a part has a list within it that is not of one element.

    Args:
        raw: CDR, its first four bytes included.
        kind: type, such as 'vision_msgs/msg/Detection3DArray'.
        fields: names, with what they are in: `results/hypothesis/score`.
    """
    layout = _layout(kind, fields)
    return layout.read(raw) if layout is not None and raw[:2] == b"\x00\x01" and len(raw) >= 4 else None


@cache
def _layout(kind: str, fields: tuple[str, ...]) -> _Layout | None:
    """Return where the fields are; None where the message, or a part, is of another form."""
    try:
        return _Layout(ros2_types(), kind, fields)
    except (KeyError, ValueError, TypeError):
        return None


class _Layout:
    """Positions of the fields of a message that is a header and a list of parts.

    Attributes:
        steps: K of `_read`.
        names: of the numbers of a part in their order, with what they are in.
        texts: of its texts.
        ones: which of the numbers are lengths of lists.
    """

    def __init__(self, types: Any, kind: str, fields: tuple[str, ...]) -> None:
        self._types, self.steps = types, list[tuple[int, int, int]]()
        self.names, self.texts, self.ones = list[str](), list[str](), list[int]()
        (_, header), (_, (_, listed)) = types.fielddefs[kind][1]
        self._field("", *header)
        self._begin = len(self.names) + 1, len(self.texts)
        self.names, self.texts, self.ones = [], [], []
        self._list("", *listed[0])
        self._steps = np.array(self.steps, dtype=np.int64)
        self._columns: dict[str, IntArray] = {}
        for field in fields:
            inside = [row for row, name in enumerate(self.names) if f"{name}/".startswith(f"{field}/")]
            if not inside and field not in self.texts:
                raise KeyError(field)
            self._columns[field] = np.array(inside, dtype=np.int64)

    def read(self, raw: bytes) -> Parts | None:
        body = np.frombuffer(raw, np.uint8, offset=4)
        numbers, spans = np.empty(len(raw) // 4 + len(self._steps)), np.empty((len(raw) // 4 + 2, 2), dtype=np.int64)
        n_numbers, n_texts, end = _read(body, self._steps, numbers, spans)
        (first, first_text), width, wide = self._begin, len(self.names), len(self.texts)
        count = int(numbers[first - 1]) if end >= 0 else -1
        if (
            count < 0
            or end + 7 < len(raw)
            or n_numbers != first + count * width
            or n_texts != first_text + count * wide
        ):
            return None
        table = numbers[first:n_numbers].reshape(count, width)
        if not (table[:, self.ones] == 1.0).all():
            return None
        try:
            texts = [str(raw[4 + at : 4 + to], "utf-8") for at, to in spans[:n_texts].tolist()]
        except UnicodeDecodeError:
            return None
        return Parts(
            numbers[0] + 1e-9 * numbers[1],
            texts[0],
            {name: table[:, rows] for name, rows in self._columns.items() if len(rows)},
            {name: texts[first_text + row :: wide] for row, name in enumerate(self.texts) if name in self._columns},
        )

    def _field(self, name: str, how: int, what: Any) -> None:
        if how == _NAME:
            for inner, description in self._types.fielddefs[what][1]:
                self._field(f"{name}/{inner}" if name else inner, *description)
        elif how == _BASE and what[0] == "string":
            self.steps.append((_TEXT, 4, 1))
            self.texts.append(name)
        elif how == _BASE:
            self._numbers(name, what[0], 1)
        elif how == _ARRAY and what[0][0] == _BASE and what[0][1][0] != "string":
            self._numbers(name, what[0][1][0], int(what[1]))
        else:
            inner, of = what[0]
            if inner != _NAME or how == _ARRAY:
                raise ValueError(name)
            self.ones.append(len(self.names))
            self.names.append("")
            self._list(name, inner, of)

    def _list(self, name: str, how: int, what: Any) -> None:
        at = len(self.steps)
        self.steps.append((_LIST, 4, 0))
        self._field(name, how, what)
        self.steps.append((_END, 1, at + 1))
        self.steps[at] = _LIST, 4, len(self.steps)

    def _numbers(self, name: str, base: str, count: int) -> None:
        dtype = np.dtype(_DTYPES[base])
        self.steps.append(("uif".index(dtype.kind), dtype.itemsize, count))
        self.names += [name] if count == 1 else [f"{name}/{row}" for row in range(count)]


@kept()
def _read(raw: Any, steps: IntArray, numbers: FloatArray, spans: IntArray) -> tuple[int, int, int]:
    """Read numbers and texts of a message by the steps of its type.

    Args:
        raw: (B,) bytes, without the first four.
        steps: (K, 3): code; size of one; how many follow each other, or to which step a list leads from its end, or to
            which from where it is empty.
        numbers: gets the numbers in their order, and lengths of lists before what is in them.
        spans: gets where texts begin and end.

    Returns:
        Numbers of both, and where the message ends; -1 where it is damaged.
    """
    bits, single, left = np.empty(1, np.uint64), np.empty(1, np.uint32), np.zeros(_DEPTH, np.int64)
    real, small, at, n, t, depth, k = bits.view(np.float64), single.view(np.float32), 0, 0, 0, 0, 0
    while k < len(steps):
        code, size, more = steps[k, 0], steps[k, 1], steps[k, 2]
        k += 1
        if code == _END:
            left[depth - 1] -= 1
            if left[depth - 1] > 0:
                k = more
            else:
                depth -= 1
            continue
        at = (at + size - 1) & -size
        count = 1 if code >= _TEXT else more
        if at + size * count > len(raw) or n + count > len(numbers):
            return n, t, -1
        for _ in range(count):
            bits[0] = 0
            for byte in range(size):
                bits[0] |= np.uint64(raw[at + byte]) << np.uint64(8 * byte)
            at += size
            if code == 2 and size == 8:
                numbers[n] = real[0]
            elif code == 2:
                single[0] = bits[0]
                numbers[n] = small[0]
            elif code == 1 and bits[0] >> np.uint64(8 * size - 1):
                numbers[n] = float(bits[0]) - 2.0 ** (8 * size)
            else:
                numbers[n] = float(bits[0])
            n += 1
        if code == _TEXT:
            n -= 1
            length = int(bits[0])
            if length == 0 or at + length > len(raw) or raw[at + length - 1] != 0 or t == len(spans):
                return n, t, -1
            spans[t, 0], spans[t, 1] = at, at + length - 1
            at += length
            t += 1
        elif code == _LIST:
            if bits[0] == 0:
                k = more
            elif depth == _DEPTH:
                return n, t, -1
            else:
                left[depth] = int(bits[0])
                depth += 1
    return n, t, at
