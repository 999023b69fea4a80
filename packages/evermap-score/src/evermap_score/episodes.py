"""The table of episodes: a landmark at one place for one interval; reading and writing it.

| column | | what |
|---|---|---|
| `landmark_id` | needed | text or number, the same for all episodes of a landmark |
| `t_from_s`, `t_to_s` | needed | it is there from `t_from_s` on and before `t_to_s`; empty: since ever, still there |
| `x_m`, `y_m` | needed | its place |
| `z_m` | optional | its height; without it the table is in the plane |
| `class_id` | optional | text; empty: unknown |
| `qw`, `qx`, `qy`, `qz` | optional | its orientation |
| `length_m`, `width_m`, `height_m` | optional | the size of a box |
| `cov_xx_m2`, `cov_xy_m2`, `cov_xz_m2`, `cov_yy_m2`, `cov_yz_m2`, `cov_zz_m2` | optional | covariance of the place |
| `p` | optional | probability that it is there during the interval; 1 if empty |
| `n_looks` | optional, of the truth | how often the sensor had an opportunity to see the landmark |
| `robot_time_s` | optional, of an estimate | rows of one value are the map as it was then; else there is one map |
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evermap_score.errors import ScoreError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
TextArray = NDArray[np.str_]

NEEDED = ("landmark_id", "t_from_s", "t_to_s", "x_m", "y_m")
COVARIANCE = ("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2")
QUATERNION = ("qw", "qx", "qy", "qz")
SIZE = ("length_m", "width_m", "height_m")
NUMBERS = ("t_from_s", "t_to_s", "x_m", "y_m", "z_m", *QUATERNION, *SIZE, *COVARIANCE, "p", "n_looks", "robot_time_s")
COLUMNS = ("landmark_id", "class_id", *NUMBERS)
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True)
class Episodes:
    """Episodes of landmarks, a row each.

    Attributes:
        landmark_id: text (n,).
        class_id: text (n,), empty if unknown.
        t_from_s: seconds (n,), -inf if it was always there.
        t_to_s: seconds (n,), inf if it is still there; the end is excluded.
        position_m: metres (n, 3); z is NaN in the plane.
        quaternion: (n, 4) as w, x, y, z; NaN if unknown.
        size_m: metres (n, 3) of a box; NaN if unknown.
        covariance_m2: square metres (n, 3, 3) of the position; NaN if unknown.
        p: probability (n,) that it is there during the interval.
        n_looks: opportunities to see the landmark (n,); NaN if unknown.
        robot_time_s: seconds (n,) of the map that has this row; NaN if there is one map only.
    """

    landmark_id: TextArray
    class_id: TextArray
    t_from_s: FloatArray
    t_to_s: FloatArray
    position_m: FloatArray
    quaternion: FloatArray
    size_m: FloatArray
    covariance_m2: FloatArray
    p: FloatArray
    n_looks: FloatArray
    robot_time_s: FloatArray

    def __len__(self) -> int:
        return len(self.landmark_id)

    def __getitem__(self, rows: BoolArray | IntArray) -> Episodes:
        return Episodes(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    @property
    def in_space(self) -> bool:
        """Whether every row has a height."""
        return len(self) > 0 and bool(np.isfinite(self.position_m[:, 2]).all())

    def is_present(self, stamp_s: float) -> BoolArray:
        """Say of each row whether its interval holds an instant."""
        return (self.t_from_s <= stamp_s) & (stamp_s < self.t_to_s)

    def state_at(self, stamp_s: float, least_p: float = 0.0) -> Episodes:
        """Return the rows that hold an instant, with at least a probability; of a landmark the most probable one."""
        rows = np.flatnonzero(self.is_present(stamp_s) & (self.p >= least_p))
        rows = rows[np.argsort(-self.p[rows], kind="stable")]
        first = np.unique(self.landmark_id[rows], return_index=True)[1]
        return self[np.sort(rows[first])]

    def robot_times_s(self) -> FloatArray:
        """Return the robot times of its maps, sorted; none if there is one map only."""
        return np.unique(self.robot_time_s[np.isfinite(self.robot_time_s)])

    def select_map(self, stamp_s: float) -> Episodes:
        """Return the last map that is not younger than a robot time; all rows if there is one map only."""
        times = self.robot_times_s()
        if len(times) == 0:
            return self
        earlier = times[times <= stamp_s]
        return self[self.robot_time_s == earlier[-1]] if len(earlier) else self[np.zeros(len(self), bool)]

    def latest(self) -> Episodes:
        """Return the last of its maps."""
        return self.select_map(np.inf)

    def move(self, rotation: FloatArray, translation_m: FloatArray) -> Episodes:
        """Return the places after a rigid motion, `rotation` (3, 3) first, then `translation_m` (3,)."""
        in_plane = np.isnan(self.position_m[:, 2])
        position_m = np.nan_to_num(self.position_m) @ rotation.T + translation_m
        position_m[in_plane, 2] = np.nan
        covariance = self.covariance_m2
        known = np.isfinite(covariance[:, 0, 0])
        turned = rotation @ np.nan_to_num(covariance) @ rotation.T
        flat = np.isnan(covariance[:, 2, 2])
        turned[flat, 2, :] = turned[flat, :, 2] = np.nan
        turned[~known] = np.nan
        return replace(self, position_m=position_m, covariance_m2=turned)


def episodes_from_rows(rows: Iterable[Mapping[str, Any]], path: str | Path | None = None) -> Episodes:
    """Return a table from rows with the columns above; missing, None and empty values are unknown.

    Args:
        rows: of the table.
        path: the file they are from, for messages.

    Raises:
        ScoreError: a needed column is missing, or a value is not a number or out of its range.
    """
    listed = list(rows)
    columns: dict[str, Any] = {name: [] for name in COLUMNS}
    for number, row in enumerate(listed, start=2):
        missing = [name for name in NEEDED if name not in row]
        if missing:
            raise ScoreError(f"no column {', '.join(missing)}", path=path, hint=f"needed are {', '.join(NEEDED)}")
        for name in ("landmark_id", "class_id"):
            value = row.get(name)
            columns[name].append("" if value is None else str(value).strip())
        if not columns["landmark_id"][-1]:
            raise ScoreError("no landmark_id", path=path, line=number)
        for name in NUMBERS:
            columns[name].append(_number(row.get(name), name, path, number))
    values = {name: np.array(columns[name], dtype=np.float64) for name in NUMBERS}
    n = len(listed)
    covariance = np.full((n, 3, 3), np.nan)
    for name, (i, j) in zip(COVARIANCE, _UPPER, strict=True):
        covariance[:, i, j] = covariance[:, j, i] = values[name]
    table = Episodes(
        landmark_id=np.array(columns["landmark_id"], dtype=np.str_),
        class_id=np.array(columns["class_id"], dtype=np.str_),
        t_from_s=np.where(np.isnan(values["t_from_s"]), -np.inf, values["t_from_s"]),
        t_to_s=np.where(np.isnan(values["t_to_s"]), np.inf, values["t_to_s"]),
        position_m=np.stack([values["x_m"], values["y_m"], values["z_m"]], axis=1).reshape(n, 3),
        quaternion=np.stack([values[name] for name in QUATERNION], axis=1).reshape(n, 4),
        size_m=np.stack([values[name] for name in SIZE], axis=1).reshape(n, 3),
        covariance_m2=covariance,
        p=np.where(np.isnan(values["p"]), 1.0, values["p"]),
        n_looks=values["n_looks"],
        robot_time_s=values["robot_time_s"],
    )
    _check(table, path)
    return table


def _number(value: Any, name: str, path: str | Path | None, line: int) -> float:
    if value is None or (isinstance(value, str) and not value.strip()):
        return float("nan")
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ScoreError(f"{name} is not a number: {value!r}", path=path, line=line) from None


def _check(table: Episodes, path: str | Path | None) -> None:
    for wrong, problem in (
        (~np.isfinite(table.position_m[:, :2]).all(axis=1), "x_m and y_m must be finite"),
        (~(table.t_to_s > table.t_from_s), "t_to_s must be after t_from_s"),
        ((table.p < 0.0) | (table.p > 1.0), "p must be between 0 and 1"),
    ):
        if wrong.any():
            raise ScoreError(problem, path=path, line=int(np.argmax(wrong)) + 2)


def read_episodes(path: str | Path) -> Episodes:
    """Read a table of episodes, CSV or Parquet.

    Raises:
        ScoreError: the file is missing or is not such a table.
    """
    return episodes_from_rows(read_rows(path), path)


def read_rows(path: str | Path) -> list[dict[str, Any]]:
    """Return the rows of a CSV or Parquet file, by the names of their columns.

    Raises:
        ScoreError: the file cannot be read.
    """
    path = Path(path)
    try:
        if path.suffix == ".parquet":
            from pyarrow import ArrowInvalid
            from pyarrow.parquet import read_table

            try:
                rows: list[dict[str, Any]] = read_table(path).to_pylist()
            except ArrowInvalid as error:
                raise ScoreError(f"not a Parquet file: {error}", path=path) from None
            return rows
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            return [{(name or "").strip(): value for name, value in row.items()} for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ScoreError(f"cannot be read: {getattr(error, 'strerror', None) or error}", path=path) from None


def rows_of(table: Episodes) -> list[dict[str, Any]]:
    """Return the rows of a table; unknown values are None."""
    values: dict[str, Any] = {
        "t_from_s": table.t_from_s,
        "t_to_s": table.t_to_s,
        **dict(zip(("x_m", "y_m", "z_m"), table.position_m.T, strict=True)),
        **dict(zip(QUATERNION, table.quaternion.T, strict=True)),
        **dict(zip(SIZE, table.size_m.T, strict=True)),
        **{name: table.covariance_m2[:, i, j] for name, (i, j) in zip(COVARIANCE, _UPPER, strict=True)},
        "p": table.p,
        "n_looks": table.n_looks,
        "robot_time_s": table.robot_time_s,
    }
    return [
        {"landmark_id": identity, "class_id": label}
        | {name: float(values[name][row]) if np.isfinite(values[name][row]) else None for name in NUMBERS}
        for row, (identity, label) in enumerate(zip(table.landmark_id.tolist(), table.class_id.tolist(), strict=True))
    ]


def write_episodes(table: Episodes, path: str | Path) -> None:
    """Write a table as CSV or, if the name ends so, Parquet; columns of which nothing is known are left out."""
    rows = rows_of(table)
    names = [name for name in COLUMNS if name in NEEDED or any(row[name] not in (None, "") for row in rows)]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".parquet":
        import pyarrow as pa
        from pyarrow.parquet import write_table

        write_table(pa.table({name: [row[name] for row in rows] for name in names}), path)
        return
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


@dataclass(frozen=True)
class LookTable:
    """Opportunities to see a landmark, whether or not it was seen.

    Attributes:
        stamp_s: seconds (n,).
        landmark_id: text (n,), as in the truth.
        session_id: text (n,), empty if there is no such column.
    """

    stamp_s: FloatArray
    landmark_id: TextArray
    session_id: TextArray

    def count(self, landmark_id: str, from_s: float, to_s: float) -> int:
        """Count the looks at a landmark after `from_s` and until `to_s`."""
        at = self._stamps_of.get(landmark_id)
        return 0 if at is None else int(np.diff(np.searchsorted(at, [from_s, to_s], side="right"))[0])

    @cached_property
    def _stamps_of(self) -> dict[str, FloatArray]:
        """Sorted stamps by landmark: a table may have a million looks, and is asked for each landmark and instant."""
        order = np.lexsort((self.stamp_s, self.landmark_id))
        names, starts = np.unique(self.landmark_id[order], return_index=True)
        return dict(zip(names.tolist(), np.split(self.stamp_s[order], starts[1:]), strict=True)) if len(names) else {}

    def session_ends_s(self) -> FloatArray:
        """Return the last stamp of each session, sorted; none without the column `session_id`."""
        names = np.unique(self.session_id[self.session_id != ""])
        return np.sort(np.array([self.stamp_s[self.session_id == name].max() for name in names], dtype=np.float64))


def read_looks(path: str | Path) -> LookTable:
    """Read a table of looks, `stamp_s, landmark_id` and optionally `session_id`, CSV or Parquet.

    Raises:
        ScoreError: a column is missing, or a stamp is not a number.
    """
    rows = read_rows(path)
    for name in ("stamp_s", "landmark_id"):
        if rows and name not in rows[0]:
            raise ScoreError(f"no column {name}", path=path, hint="needed are stamp_s, landmark_id")
    stamps = [_number(row["stamp_s"], "stamp_s", path, line) for line, row in enumerate(rows, start=2)]
    return LookTable(
        np.array(stamps, dtype=np.float64),
        np.array([str(row["landmark_id"]).strip() for row in rows], dtype=np.str_),
        np.array([str(row.get("session_id") or "").strip() for row in rows], dtype=np.str_),
    )
