"""The table of looks that `evermap persist` reads: who was looked at when, and whether it was detected."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from evermap.errors import ConfigError, InputError
from evermap.existence.protocol import Looks, feature_of, firsts_of
from evermap.io.columns import Columns, read_columns
from evermap.io.text import counted, quote
from evermap.types import UNKNOWN, BoolArray, Clock, FloatArray, IntArray
from evermap.valid import STAMP_S, Quantity

_REQUIRED = ("stamp_s", "feature_id", "detected")
_OPTIONAL = ("p_miss", "p_false", "class_id", "present")
_P_MISS = Quantity("p_miss", 0.0, 1.0, optional=True, hint="the probability of no detection of a feature that is there")
_P_FALSE = Quantity("p_false", 0.0, 1.0, optional=True, hint="the probability of a detection of one that is not there")
_FLAG_HINT = "1 or true, 0 or false"


@dataclass(frozen=True, slots=True)
class LookTable:
    """R rows of a table, in its order; a row without a look only asks for the belief at its time.

    Attributes:
        names: F feature ids as they were given, in natural order.
        feature: (R,) index of each row's feature.
        stamp_s: (R,) when.
        detected: (R,) 1 where the detector fired, 0 where it did not, nan where there was no look.
        p_miss: (R,) `P(no detection | there)`.
        p_false: (R,) `P(detection | not there)`.
        class_names: classes in use.
        class_of_feature: (F,) index into them, `UNKNOWN` where none was given.
        present: (R,) truth: 1 there, 0 not, nan unknown; None without any. Read by the metrics and figures only.
        source: file it came from, '' if none.
        line: (R,) line of each row in that file.
        warnings: remarks of the reader.
        clock: what stamps count, where they were dates; None where the table does not say.

    Raises:
        InputError: columns of different lengths, a value that the reader would refuse, or error rates under which a
            detection speaks against the feature.
    """

    names: tuple[str, ...]
    feature: IntArray
    stamp_s: FloatArray
    detected: FloatArray
    p_miss: FloatArray
    p_false: FloatArray
    class_names: tuple[str, ...]
    class_of_feature: IntArray
    present: FloatArray | None
    source: str
    line: IntArray
    warnings: tuple[str, ...] = ()
    clock: Clock | None = None

    def __post_init__(self) -> None:
        if self.class_of_feature.shape != (self.n_features,):
            problem = f"{len(self.class_of_feature)} classes for {self.n_features} features"
            raise InputError(problem, field="class_of_feature")
        columns = {
            name: getattr(self, name) for name in ("feature", "detected", "p_miss", "p_false", "present", "line")
        }
        for name, column in columns.items():
            if column is not None and column.shape != self.stamp_s.shape:
                problem = f"shape {column.shape} where stamp_s has {self.stamp_s.shape}"
                raise InputError(problem, path=self.source or None, field=name, hint="one value a row")
        path = Path(self.source or "looks")
        for quantity in (STAMP_S, _P_MISS, _P_FALSE):
            replace(quantity, optional=False).check(getattr(self, quantity.name), path=path, line=self.line)
        nobody = ~np.isin(self.feature, np.arange(self.n_features))
        self._refuse(nobody, "feature", "there is no such feature", "an index into names")
        for name in ("detected", "present"):
            if columns[name] is not None:
                self._refuse(~(np.isin(columns[name], (0.0, 1.0)) | np.isnan(columns[name])), name,
                             "is neither 1 nor 0", "1, 0, or nan where there was no look")  # fmt: skip
        inverted = self.looked & (self.p_miss + self.p_false >= 1.0)
        if inverted.any():
            row = int(np.argmax(inverted))
            sure = self.p_miss[row] + self.p_false[row] == 1.0
            told = "tells nothing" if sure else "would speak against the feature, a miss for it"
            self._refuse(
                inverted,
                "p_miss",
                f"{self.p_miss[row]:g} and p_false {self.p_false[row]:g} make 1 or more: a detection {told}",
                "p_miss + p_false below 1; P(detection | there) is 1 - p_miss; leave out looks that tell nothing",
            )

    def _refuse(self, wrong: BoolArray, field: str, problem: str, hint: str) -> None:
        """Raise InputError for the first row that is wrong."""
        if wrong.any():
            line = int(self.line[np.argmax(wrong)]) or None
            raise InputError(problem, path=self.source or None, line=line, field=field, hint=hint)

    def __len__(self) -> int:
        return len(self.stamp_s)

    @property
    def n_features(self) -> int:
        """F."""
        return len(self.names)

    @property
    def looked(self) -> BoolArray:
        """(R,) whether the row is a look."""
        return ~np.isnan(self.detected)

    @property
    def now_s(self) -> float:
        """Time of the latest look."""
        return float(self.stamp_s[self.looked].max())

    def order(self) -> IntArray:
        """Return (R,) the rows by feature and time."""
        return np.lexsort((self.stamp_s, self.feature))

    def looks(self, order: IntArray) -> Looks:
        """Return the looks by feature and time; `order` is `self.order()`."""
        rows = order[self.looked[order]]
        columns = (self.stamp_s, self.detected, self.p_miss, self.p_false)
        return Looks(firsts_of(self.feature[rows], self.n_features), *(column[rows] for column in columns))

    def truth(self, order: IntArray) -> Truth | None:
        """Return what the column `present` says; None without any. `order` is `self.order()`."""
        if self.present is None:
            return None
        rows = order[~np.isnan(self.present[order])]
        return Truth(firsts_of(self.feature[rows], self.n_features), self.stamp_s[rows], self.present[rows])


@dataclass(frozen=True, slots=True)
class Truth:
    """What truly was there: T samples, each holding until the feature's next one.

    Attributes:
        first: (F + 1,) those of feature `f` are rows `first[f]` to `first[f + 1]`, in order of time.
        stamp_s: (T,) when.
        present: (T,) 1 or 0.
    """

    first: IntArray
    stamp_s: FloatArray
    present: FloatArray

    def at(self, feature: IntArray, stamp_s: FloatArray) -> FloatArray:
        """Return (N,) truth about features at instants; nan before a feature's first sample and after its last."""
        of_sample = feature_of(self.first)
        n = len(of_sample)
        asked = np.concatenate([np.full(n, -1), np.arange(len(stamp_s))])
        all_features = np.concatenate([of_sample, feature])
        order = np.lexsort((np.concatenate([self.stamp_s, stamp_s]), all_features))  # stable: samples before instants
        latest = np.maximum.accumulate(np.where(order < n, order, -1))
        answer = np.full(len(stamp_s), np.nan)
        mine = (order >= n) & (latest >= 0)
        instant, sample = asked[order[mine]], latest[mine]
        known = of_sample[sample] == feature[instant]
        known &= stamp_s[instant] <= self.stamp_s[self.first[feature[instant] + 1] - 1]
        answer[instant[known]] = self.present[sample[known]]
        return answer


def read_looks(path: str | Path, *, p_miss: float = 0.1, p_false: float = 0.1) -> LookTable:
    """Return a table with `stamp_s, feature_id, detected` and perhaps `p_miss, p_false, class_id, present`.

    Args:
        path: a `.csv`, `.csv.gz` or `.parquet` file; rows in any order.
        p_miss: `P(no detection | there)` where the table does not say.
        p_false: `P(detection | not there)` where the table does not say.

    Raises:
        InputError: anything wrong in the file, by line and column.
        ConfigError: a default that is not a probability.
    """
    for name, value in (("p_miss", p_miss), ("p_false", p_false)):
        if not 0.0 <= value <= 1.0:
            raise ConfigError(f"{value} is not a probability", field=name, hint="a number between 0 and 1")
    if p_miss + p_false >= 1.0:
        problem = f"{p_miss:g} and `p_false` {p_false:g} make 1 or more: a detection would speak against the feature"
        hint = "both below 0.5; P(detection | there) is 1 - p_miss"
        raise ConfigError(problem, field="p_miss", hint=hint)
    warnings: list[str] = []
    table = read_columns(path, warnings)
    _explain_missing(table)
    table.expect(_REQUIRED, _OPTIONAL)
    if len(table) == 0:
        raise InputError("has no rows below its header", path=path, hint="one row a look")
    names, feature = _features(table)
    detected = table.flags("detected", hint=_FLAG_HINT + ", empty where the sensor did not look")
    if np.isnan(detected).all():
        hint = "1 where it was detected, 0 where it was looked at and not detected"
        raise InputError("no row is a look: the whole column is empty", path=path, field="detected", hint=hint)
    class_names, class_of_feature = _classes(table, feature, names)
    present = table.flags("present", hint=_FLAG_HINT + ", empty where unknown") if "present" in table else None
    return LookTable(
        names=names,
        feature=feature,
        stamp_s=table.numbers(STAMP_S),
        detected=detected,
        p_miss=table.filled(_P_MISS, p_miss),
        p_false=table.filled(_P_FALSE, p_false),
        class_names=class_names,
        class_of_feature=class_of_feature,
        present=None if present is None or np.isnan(present).all() else present,
        source=str(path),
        line=table.line,
        warnings=tuple(warnings),
        clock=table.clock(),
    )


def read_truth(path: str | Path, looks: LookTable) -> tuple[Truth, tuple[str, ...]]:
    """Return a table with `stamp_s, feature_id, present` about the features of `looks`, and remarks about others.

    Raises:
        InputError: anything wrong in the file, or no feature in common.
    """
    warnings: list[str] = []
    table = read_columns(path, warnings)
    table.expect(("stamp_s", "feature_id", "present"), ("detected", "p_miss", "p_false", "class_id"))
    names, feature = _features(table)
    present = table.flags("present", hint=_FLAG_HINT + ", empty where unknown")
    stamp_s = table.numbers(STAMP_S)
    index = {name: k for k, name in enumerate(looks.names)}
    ours = np.array([index.get(name, UNKNOWN) for name in names], dtype=np.int64)
    strangers = int((ours == UNKNOWN).sum())
    if strangers == len(names):
        problem = f"knows none of the features of {looks.source or 'the looks'}"
        raise InputError(problem, path=path, field="feature_id", hint=f"such as {quote(looks.names[0])}")
    if strangers:
        warnings.append(f"{Path(path).name}: {counted(strangers, 'feature')} without looks left out")
    rows = np.flatnonzero((ours[feature] != UNKNOWN) & ~np.isnan(present))
    rows = rows[np.lexsort((stamp_s[rows], ours[feature[rows]]))]
    truth = Truth(firsts_of(ours[feature[rows]], looks.n_features), stamp_s[rows], present[rows])
    return truth, tuple(warnings)


def _explain_missing(table: Columns) -> None:
    """More than 'missing column' about the two columns that tables of looks lack most often."""
    if set(table.cells) - {*_REQUIRED, *_OPTIONAL}:
        return  # a name that is nearly right is the likelier mistake
    if "feature_id" not in table:
        hint = "add it, with one and the same value if there is only one feature"
        raise table.error("missing column", row=None, field="feature_id", hint=hint)
    if "detected" not in table and "present" in table:
        hint = "what the detector said, 1 or 0; 'present' is the truth, which only scores the result"
        raise table.error("missing column", row=None, field="detected", hint=hint)


def _features(table: Columns) -> tuple[tuple[str, ...], IntArray]:
    names, feature = table.labels("feature_id")
    empty = np.flatnonzero(feature == UNKNOWN)
    if empty.size:
        raise table.error("is empty", row=int(empty[0]), field="feature_id", hint="a name or a number in every row")
    return tuple(names), feature


def _classes(table: Columns, feature: IntArray, names: tuple[str, ...]) -> tuple[tuple[str, ...], IntArray]:
    """Class names, and each feature's; rows of a feature may leave it empty but not contradict each other."""
    of_feature = np.full(len(names), UNKNOWN, dtype=np.int64)
    if "class_id" not in table:
        return (), of_feature
    class_names, of_row = table.labels("class_id")
    said = np.flatnonzero(of_row != UNKNOWN)
    of_feature[feature[said][::-1]] = of_row[said][::-1]  # of several assignments the last holds: the first row
    other = said[of_row[said] != of_feature[feature[said]]]
    if other.size:
        row = int(other[0])
        first = class_names[of_feature[feature[row]]]
        problem = (
            f"feature {quote(names[feature[row]])} is {quote(class_names[of_row[row]])} here and {quote(first)} above"
        )
        raise table.error(problem, row=row, field="class_id", hint="one class a feature")
    return tuple(class_names), of_feature
