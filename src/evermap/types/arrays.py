"""Arrays, and dataclasses of arrays that are columns of a table."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypeVar

from evermap.errors import InputError
from evermap.show import ShownTable

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Progress = Callable[[float, float], None]
"""Called with what is done and the total: seconds of recordings, or steps."""

UNKNOWN: int = -1
"""Id of a landmark or class that is not known."""
DEFAULT_P_MISS, DEFAULT_P_FALSE = 0.1, 0.1
"""Error rates of a detector that states none."""
DEFAULT_PRIOR = "unknown:1min..10y"
"""Lifetime of what nothing is known of, from a cup that is put down to a wall: every order of magnitude of the mean
stay is equally likely."""


class Tabular(ShownTable):
    """Mixin of tables whose rows are taken and joined: all arrays have as many as the first; what is no array stays."""

    __slots__ = ()

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.__dataclass_fields__))))

    def __getitem__(self, rows: IntArray | BoolArray) -> Self:
        """Some of the rows, by number or by a mask."""
        return rows_of(self, rows)

    def joined(self, *others: Self) -> Self:
        """Return these rows, then those of others."""
        names = [name for name in self.__dataclass_fields__ if isinstance(getattr(self, name), np.ndarray)]
        every: dict[str, Any] = {name: [getattr(one, name) for one in (self, *others)] for name in names}
        return replace(self, **{name: np.concatenate(columns) for name, columns in every.items()})


class ArrayTable(Tabular):
    """Mixin of dataclasses whose arrays are columns of N rows each, N being those of the first one.

    Raises:
        InputError: no numbers, fractions where whole numbers are needed, or another length.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        first, count = "", -1
        for name, item in self.__dataclass_fields__.items():
            if item.type not in _KINDS:
                continue
            given, owner, kind = getattr(self, name), type(self).__name__, _KINDS[item.type]
            rest = _WIDE.get(name, ((),))
            array = given if isinstance(given, np.ndarray) else np.asarray(_numbers(given, owner, name))
            if array.dtype != kind:
                array = _as_kind(array, owner, name, whole=kind is np.int64)
            if not first:
                first, count = name, len(array) if array.ndim else -1
            if array.ndim == 0 or array.shape[0] != count or array.shape[1:] not in rest:
                more = " or ".join(f"({count}, {', '.join(map(str, shape))})" for shape in rest if shape)
                wanted = more or f"({max(count, 0)},), as {first}"
                raise InputError(f"{owner} of shape {array.shape} instead of {wanted}", field=name)
            if array is not given:
                object.__setattr__(self, name, array)


_KINDS: dict[Any, Any] = {"FloatArray": np.float64, "IntArray": np.int64}
_WIDE: dict[str, tuple[tuple[int, ...], ...]] = {
    "pose_world_robot": ((3,), (7,)),
    "covariance": ((3, 3), (6, 6)),
    "position_m": ((2,), (3,)),
    "covariance_m2": ((2, 2), (3, 3)),
    "position_sensor_m": ((3,),),
    "rotation": ((4,),),
    "covariance_sensor_m2": ((3, 3),),
    "corner_px": ((4, 2),),
    "size_m": ((3,),),
    "variance": ((6,),),
}
"""Columns that hold more than a number a row, and what of their shape may follow the first axis: in the plane, in
space."""


def _numbers(given: Any, owner: str, name: str) -> Any:
    try:
        return np.asarray(given) if len(given) else np.zeros(0)
    except (TypeError, ValueError):
        raise InputError(f"{owner}: {type(given).__name__} is not an array of numbers", field=name) from None


def _as_kind(array: Any, owner: str, name: str, *, whole: bool) -> Any:
    if array.dtype.kind not in "biuf":
        raise InputError(f"{owner}: an array of {array.dtype} holds no numbers", field=name)
    if whole and array.dtype.kind == "f" and not np.all(array == np.floor(array)):
        raise InputError(f"{owner}: fractions where whole numbers are needed", field=name, hint="-1 for unknown")
    return array.astype(np.int64 if whole else np.float64)


def json_number(value: Any) -> float | None:
    """Return a number as JSON has it: a finite float; None for nan, infinity and None."""
    number = or_nan(value)
    return number if math.isfinite(number) else None


def or_nan(value: Any) -> float:
    """Return a number from JSON; nan for null."""
    return math.nan if value is None else float(value)


_Table = TypeVar("_Table", bound="DataclassInstance")


def rows_of(table: _Table, rows: IntArray | BoolArray) -> _Table:
    """Return some rows of a table of columns, by number, in that order, or by a mask; other fields are kept."""
    columns = {item.name: getattr(table, item.name) for item in fields(table)}
    some: dict[str, Any] = {name: column[rows] for name, column in columns.items() if isinstance(column, np.ndarray)}
    return replace(table, **some)
