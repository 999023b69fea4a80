"""Tables of further kinds of measurements, one a kind: `gnss`, `closures` and whatever else `estimate` knows."""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.estimate.kind import MeasurementKind
from evermap.estimate.measurements import find_kinds
from evermap.io.table import Table
from evermap.types import UNKNOWN, FloatArray, Measurements
from evermap.valid import STAMP_S, Quantity


def measurement_names() -> tuple[str, ...]:
    """Return the names of the tables, without their endings."""
    return tuple(find_kinds())


def read_measurements(
    tables: Mapping[str, Table | None], names: dict[int, str], warnings: list[str]
) -> tuple[Measurements, ...]:
    """Return what such tables hold, sorted by time; `names` takes up ids of landmarks that are texts, and `warnings`
    counts bad rows.

    Raises:
        InputError: a column is missing or unknown, or a value is malformed, with its line.
    """
    found = []
    for name, kind in find_kinds().items():
        table = tables.get(name)
        if table is None or not len(table):
            continue
        of_place = ("landmark_id",) if kind.ties == "pose_place" else ()
        table.expect((STAMP_S.name, *of_place, *kind.columns), tuple(kind.optional))
        known = [*kind.columns, *kind.optional]
        table = table.screened((STAMP_S, *(_quantity(kind, column) for column in known)), warnings)
        stamp_s = table.numbers(STAMP_S)
        columns = {column: _read_column(table, kind, column) for column in (*kind.columns, *kind.optional)}
        place = table.ids("landmark_id", optional=False, names=names) if of_place else np.full(len(table), UNKNOWN)
        order = np.argsort(stamp_s, kind="stable")
        columns = {column: values[order] for column, values in columns.items()}
        found.append(Measurements(name, stamp_s[order], columns, place[order]))
    return tuple(found)


def _read_column(table: Table, kind: MeasurementKind, column: str) -> FloatArray:
    """Return a column, with what is meant where it is left out or, of an optional one, empty."""
    quantity = _quantity(kind, column)
    return table.filled(quantity, float(kind.optional[column])) if quantity.optional else table.numbers(quantity)


def _quantity(kind: MeasurementKind, column: str) -> Quantity:
    """Return what the numbers of a column may be."""
    if column == "to_stamp_s":
        return Quantity(column, STAMP_S.low, STAMP_S.high, hint=STAMP_S.hint, dates=True)
    limit, hint = (2.0 * pi, "radians, not degrees") if column.endswith("_rad") else (1e8, "SI units")
    positive, optional = column.startswith("sigma") or column == "range_m", column in kind.optional
    return Quantity(column, -limit, limit, positive=positive, optional=optional, hint=hint)


def measurement_columns(table: Measurements) -> dict[str, Any]:
    """Return the columns of a table as `read_measurements` reads them.

    Raises:
        InputError: nobody knows measurements of this kind.
    """
    kind = find_kinds().get(table.kind)
    if kind is None:
        raise InputError(f"there are no measurements called {table.kind!r}", hint=", ".join(find_kinds()))
    place = {"landmark_id": table.landmark_id} if kind.ties == "pose_place" else {}
    return {STAMP_S.name: table.stamp_s, **place, **table.columns}
