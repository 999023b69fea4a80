"""What a kind of measurement is: the columns of its table, what messages say of them, and a residual, in one file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from evermap.types import FloatArray, SpatialOdometry

Columns = Mapping[str, FloatArray]
"""Numbers (K,) of a table by the names of its columns."""


class Linearised(NamedTuple):
    """Residuals of a kind of measurement, in the units of its columns.

    Attributes:
        residual: (K, r) measured less predicted.
        by_pose: (K, r, 6) derivatives by a twist of the pose in its own frame, translation first.
        by_other: (K, r, 6) those by the other pose, (K, r, 3) those by the position of a landmark in the world, or None
            where the measurement ties a pose alone.
    """

    residual: FloatArray
    by_pose: FloatArray
    by_other: FloatArray | None = None


class Messages(NamedTuple):
    """Messages of one topic of a bag, in the order of their stamps, and what is known of their sensor.

    Attributes:
        stamp_s: (K,).
        values: (K, n) numbers of each, as `MessageRows.read` returns them.
        mount: (7,) pose of their frame in the robot's; None where no fixed transform leads there.
        odometry: of the robot; None of one that has none.
    """

    stamp_s: FloatArray
    values: FloatArray
    mount: FloatArray | None
    odometry: SpatialOdometry | None


class TableRows(NamedTuple):
    """Rows of a table that messages are: stamps (K,), columns by name (those left out are not said), and a remark."""

    stamp_s: FloatArray
    columns: Columns
    remark: str = ""


@dataclass(frozen=True, slots=True)
class MessageRows:
    """How messages of ROS become rows of a kind of measurement.

    Attributes:
        types: names of the messages' types without their packages, such as 'NavSatFix'.
        read: numbers that a message says, as many in each; None where it measures nothing.
        rows: the rows of all messages of a topic; None where `read` returns the numbers of `columns` in their order.
        derived: words in the names of topics that hold no measurement of a sensor but what was made of several.
    """

    types: tuple[str, ...]
    read: Callable[[Any], tuple[float, ...] | None]
    rows: Callable[[Messages], TableRows] | None = None
    derived: tuple[str, ...] = ()


LEVEL_RAD = 0.1
"""Tilt of the first pose that a kind leaves open, beyond which it is the kind that says what is level."""


@dataclass(frozen=True, slots=True)
class MeasurementKind:
    """A kind of measurement.

    Attributes:
        name: of the table, without its ending.
        meaning: one line for the documentation.
        columns: that every row must have, beside `stamp_s`.
        optional: columns that may be left out, with what they are then; nan: not measured.
        sigma: for each number of the residual the column that has its standard deviation.
        ties: 'pose' alone, 'pose_pose' (columns `stamp_s` and `to_stamp_s`), or 'pose_place' (column `landmark_id`).
        linearise: residuals of poses (K, 7) and of other poses (K, 7) or places (K, 3), for the columns of a table.
        first_sigma: (6,) how firmly the first pose may be held beside it: along and about x, y, z [m, rad]. Small where
            the measurement does not say where that is, large where its frame is that of the measurement.
        place: of a kind that sees landmarks, where (3,) one of them may be, for poses (K, 7) and columns; None where
            these do not tell.
        frame: of a kind that has a frame of its own, the motion (7,) that brings poses (K, 7) into it, by its columns.
        messages: how it is read from bags; None of a kind for which ROS has no message.
    """

    name: str
    meaning: str
    columns: tuple[str, ...]
    sigma: tuple[str, ...]
    ties: str
    linearise: Callable[[FloatArray, FloatArray, Columns], Linearised]
    optional: Mapping[str, float] = field(default_factory=dict)
    first_sigma: tuple[float, ...] = (1e-4,) * 6
    place: Callable[[FloatArray, Columns], FloatArray | None] | None = None
    frame: Callable[[FloatArray, Columns], FloatArray] | None = None
    messages: MessageRows | None = None

    @property
    def is_upright(self) -> bool:
        """Whether it says where up is in a frame whose z axis is up, but not where that frame is."""
        return self.frame is None and max(self.first_sigma[3:5]) > LEVEL_RAD

    def fill_in(self, columns: Columns, count: int) -> dict[str, FloatArray]:
        """Return columns (count,) with those that were left out, at what they are then."""
        return {name: np.full(count, value, dtype=np.float64) for name, value in self.optional.items()} | dict(columns)


def stack_columns(columns: Columns, *names: str) -> FloatArray:
    """Return (K, n) some columns beside each other."""
    return np.column_stack([columns[name] for name in names])


def crossing(vector: FloatArray) -> FloatArray:
    """Return (K, 3, 3) the matrices by which vectors (K, 3) are multiplied from the left in a cross product."""
    x, y, z = np.moveaxis(vector, -1, 0)
    nothing = np.zeros_like(x)
    rows = [[nothing, -z, y], [z, nothing, -x], [-y, x, nothing]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
