"""Messages of ROS 2 read from CDR by functions that are compiled for their types.

What `rosbags` generates calls a function for every part of every message. Here a message is one function: the parts are
written out in it, and numbers that follow each other, of whatever part, are unpacked at once. A message of a hundred
detections is read in a third of the time.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

_FORMATS = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_BASE, _NAME, _ARRAY = 1, 2, 3
"""Kinds of fields, as `rosbags.interfaces.Nodetype` numbers them; the fourth is a sequence."""

Decoder = Callable[[bytes], tuple[Any, int]]


class Cdr:
    """Decoders of the types of a store, each compiled when the first message of its type comes."""

    def __init__(self, types: Any) -> None:
        self._types, self._decoders = types, dict[str, Decoder]()

    def decode(self, raw: bytes, kind: str) -> Any:
        """Return a message as `types.deserialize_cdr` does, with the errors of that.

        Args:
            raw: CDR, its first four bytes included.
            kind: type, such as 'nav_msgs/msg/Odometry'.

        Raises:
            KeyError: the type is not known.
            SerdeError: of `rosbags`: it is no such message.
        """
        if (decoder := self._decoders.get(kind)) is None:
            decoder = self._decoders[kind] = _Source(self._types, kind).compiled()
        if raw[:2] == b"\x00\x01":  # lowest byte first
            try:
                message, end = decoder(raw[4:])
            except (struct.error, UnicodeDecodeError, ValueError, IndexError):
                pass  # said below
            else:
                if end + 7 >= len(raw):
                    return message
        return self._types.deserialize_cdr(raw, kind)


class _Source:
    """Source of a decoder: `raw` is the message, `at` how far it is read; `v0`, `v1`, ... are what was read.

    A run is a number of values at known distances from its begin, which is at a multiple of `_start`.
    """

    def __init__(self, types: Any, kind: str) -> None:
        self._types, self._known = types, dict[str, Any](np=np)
        self._lines = ["def decode(raw):", " at = 0"]
        self._indent, self._n, self._run, self._format, self._start = " ", 0, list[str](), "<", 1
        self._kind = kind

    def compiled(self) -> Decoder:
        """Return the decoder, which returns the message and where it ends."""
        whole = self._message(self._kind)
        self._flush()
        self._add(f"return {whole}, at")
        exec("\n".join(self._lines), self._known)  # nosec  # B102: of the lines above and numbers alone
        decoder: Decoder = self._known["decode"]
        return decoder

    def _message(self, kind: str) -> str:
        """Read a message, and return the expression that makes it."""
        parts = [self._field(*description) for _, description in self._types.fielddefs[kind][1]]
        name = f"t_{len(self._known)}"  # no name from a wire or file gets into the source
        self._known[name] = self._types.types[kind]
        return f"{name}({', '.join(parts)})"

    def _field(self, how: int, what: Any) -> str:
        if how == _BASE:
            return self._string() if what[0] == "string" else self._number(_FORMATS[what[0]])
        if how == _NAME:
            return self._message(what)
        (inner, of), count = what[0], str(what[1])
        if how != _ARRAY:
            count = self._number("I")
        self._flush()
        if inner == _BASE and of[0] != "string":
            return self._numbers(np.dtype(_FORMATS[of[0]]), count)
        found = self._name()
        self._add(f"{found} = []")
        self._add(f"for _ in range({count}):")
        self._indent += " "
        one = self._field(inner, of)
        self._flush()
        self._add(f"{found}.append({one})")
        self._indent = self._indent[:-1]
        return found

    def _number(self, code: str) -> str:
        size = struct.calcsize(f"<{code}")
        length = struct.calcsize(self._format)
        if not self._run or size > self._start:
            self._flush()
            self._align(size)
            self._start, length = size, 0
        self._format += "x" * (-length % size) + code
        self._run.append(self._name())
        return self._run[-1]

    def _string(self) -> str:
        length, text = self._number("I"), self._name()
        self._flush()
        self._add(f"at += {length}")
        self._add(f"if {length} == 0 or raw[at - 1]: raise ValueError")
        self._add(f"{text} = str(raw[at - {length}:at - 1], 'utf-8')")
        return text

    def _numbers(self, dtype: np.dtype[Any], count: str) -> str:
        if dtype.itemsize > 1:
            self._add(f"if {count}: at = at + {dtype.itemsize - 1} & {-dtype.itemsize}")
        found, kind = self._name(), f"d_{dtype.char}" if dtype.char != "?" else "d_bool"
        self._known[kind] = dtype.newbyteorder("<")
        self._add(f"{found} = np.frombuffer(raw, {kind}, {count}, at)")
        self._add(f"at += {count} * {dtype.itemsize}")
        return found

    def _flush(self) -> None:
        """Unpack the run."""
        if self._run:
            unpack = f"u_{len(self._known)}"
            self._known[unpack] = struct.Struct(self._format).unpack_from
            self._add(f"{', '.join(self._run)}, = {unpack}(raw, at)")
            self._add(f"at += {struct.calcsize(self._format)}")
        self._run, self._format, self._start = [], "<", 1

    def _align(self, size: int) -> None:
        if size > 1:
            self._add(f"at = at + {size - 1} & {-size}")

    def _name(self) -> str:
        self._n += 1
        return f"v{self._n}"

    def _add(self, line: str) -> None:
        self._lines.append(self._indent + line)
