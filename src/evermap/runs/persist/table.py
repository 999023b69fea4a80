"""The table of looks of `evermap persist`: feature, stamp, and whether it was detected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evermap.config import PersistConfig
from evermap.errors import ConfigError, InputError
from evermap.existence.protocol import Looks, feature_of, firsts_of
from evermap.io.arrow import arrow_cells, pa, pq
from evermap.io.columns import Columns, DataFrame, TableSource, natural_order, parquet_batches, path_of, read_columns
from evermap.io.text import counted, quote
from evermap.show import Shown
from evermap.types import DEFAULT_P_FALSE, DEFAULT_P_MISS, UNKNOWN, BoolArray, Clock, FloatArray, IntArray
from evermap.valid import STAMP_S, Quantity

_REQUIRED = ("stamp_s", "feature_id", "detected")
_OPTIONAL = ("p_miss", "p_false", "class_id", "present")
_P_MISS = Quantity("p_miss", 0.0, 1.0, optional=True, hint="the probability of no detection of a feature that is there")
_P_FALSE = Quantity("p_false", 0.0, 1.0, optional=True, hint="the probability of a detection of one that is not there")
_FLAG_HINT = "1 or true, 0 or false"


class Span(NamedTuple):
    """Times between which a table has rows, and looks."""

    start_s: float
    stop_s: float
    first_look_s: float
    last_look_s: float


@dataclass(frozen=True, slots=True, repr=False)
class LookTable(Shown):
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
        whole: times of the whole table, where this is a part of it.

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
    whole: Span | None = None

    def __post_init__(self) -> None:
        if self.class_of_feature.shape != (self.n_features,):
            problem = f"{len(self.class_of_feature)} classes for {self.n_features} features"
            raise InputError(problem, field="class_of_feature")
        names = ("feature", "detected", "p_miss", "p_false", "present", "line")
        columns = {name: getattr(self, name) for name in names}
        for name, column in columns.items():
            if column is not None and column.shape != self.stamp_s.shape:
                problem = f"shape {column.shape} where stamp_s has {self.stamp_s.shape}"
                raise InputError(problem, path=self.source or None, field=name, hint="one value per row")
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
            told = "tells nothing" if sure else "would be evidence against the feature, a miss for it"
            self._refuse(
                inverted,
                "p_miss",
                f"{self.p_miss[row]:g} and p_false {self.p_false[row]:g} make 1 or more: a detection {told}",
                "p_miss + p_false below 1; P(detection | there) is 1 - p_miss; omit looks without information",
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
    def span(self) -> Span:
        """Times of all rows, of the whole table where this is a part."""
        if self.whole is not None:
            return self.whole
        looked_s = self.stamp_s[self.looked]
        times_s = (self.stamp_s.min(), self.stamp_s.max(), looked_s.min(), looked_s.max())
        return Span(*map(float, times_s))

    def order(self) -> IntArray:
        """Return (R,) the rows by feature and time."""
        return np.lexsort((self.stamp_s, self.feature))

    def looks(self, order: IntArray) -> Looks:
        """Return the looks by feature and time; `order` is `self.order()`."""
        rows = order[self.looked[order]]
        columns = (self.stamp_s, self.detected, self.p_miss, self.p_false)
        return Looks(firsts_of(self.feature[rows], self.n_features), *(column[rows] for column in columns))

    def only(self, features: IntArray) -> LookTable:
        """Return the rows of some features, which are given in their order."""
        number = np.full(self.n_features, UNKNOWN)
        number[features] = np.arange(len(features))
        rows = np.flatnonzero(number[self.feature] != UNKNOWN)
        columns = {name: getattr(self, name)[rows] for name in ("stamp_s", "detected", "p_miss", "p_false", "line")}
        return replace(
            self, **columns, names=tuple(self.names[k] for k in features), feature=number[self.feature[rows]],
            class_of_feature=self.class_of_feature[features], present=None, whole=self.span,
        )  # fmt: skip

    def truth(self, order: IntArray) -> Truth | None:
        """Return what the column `present` says; None without any. `order` is `self.order()`."""
        if self.present is None:
            return None
        rows = order[~np.isnan(self.present[order])]
        return Truth(firsts_of(self.feature[rows], self.n_features), self.stamp_s[rows], self.present[rows])


@dataclass(frozen=True, slots=True)
class Truth:
    """True presence: T samples, each holding until the feature's next one.

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


def read_looks(source: TableSource, *, p_miss: float = DEFAULT_P_MISS, p_false: float = DEFAULT_P_FALSE) -> LookTable:
    """Return a table with `stamp_s, feature_id, detected` and perhaps `p_miss, p_false, class_id, present`.

    Args:
        source: a `.csv`, `.csv.gz` or `.parquet` file, a folder of the latter, or a data frame; rows in any order.
        p_miss: `P(no detection | there)` where the table does not say.
        p_false: `P(detection | not there)` where the table does not say.

    Raises:
        InputError: anything wrong in the file, by line and column.
        ConfigError: a default that is not a probability.
    """
    _check_defaults(p_miss, p_false)
    warnings: list[str] = []
    table = read_columns(source, warnings)
    _explain_missing(table)
    table.expect(_REQUIRED, _OPTIONAL)
    if len(table) == 0:
        raise InputError("has no rows below its header", path=path_of(source), hint="one row per look")
    found = _looks_of(table, p_miss, p_false)
    if np.isnan(found.detected).all():
        raise _no_look(path_of(source))
    return replace(found, source="" if isinstance(source, DataFrame) else str(source), warnings=tuple(warnings))


def are_numbers(names: Sequence[str]) -> bool:
    """Return whether all names are whole numbers, written as usual."""
    return all(name.lstrip("-").isdigit() and str(int(name)) == name for name in names)


def _check_defaults(p_miss: float, p_false: float) -> None:
    for name, value in (("p_miss", p_miss), ("p_false", p_false)):
        if not 0.0 <= value <= 1.0:
            raise ConfigError(f"{value} is not a probability", field=name, hint="a number between 0 and 1")
    if p_miss + p_false >= 1.0:
        problem = f"{p_miss:g} and `p_false` {p_false:g} make 1 or more: a detection is evidence against the feature"
        hint = "both below 0.5; P(detection | there) is 1 - p_miss"
        raise ConfigError(problem, field="p_miss", hint=hint)


def _no_look(path: Path) -> InputError:
    hint = "1 where it was detected, 0 where it was looked at and not detected"
    return InputError("no row is a look: the whole column is empty", path=path, field="detected", hint=hint)


def _looks_of(table: Columns, p_miss: float, p_false: float) -> LookTable:
    names, feature = _features(table)
    detected = _detected(table)
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
        source=str(table.path),
        line=table.line,
        clock=table.clock(),
    )


def _detected(table: Columns) -> FloatArray:
    return table.flags("detected", hint=_FLAG_HINT + ", empty where the sensor did not look")


def read_truth(source: TableSource, looks: LookTable) -> tuple[Truth, tuple[str, ...]]:
    """Return a table with `stamp_s, feature_id, present` about the features of `looks`, and remarks about others.

    Raises:
        InputError: anything wrong in the file, or no feature in common.
    """
    warnings: list[str] = []
    table = read_columns(source, warnings)
    table.expect(("stamp_s", "feature_id", "present"), ("detected", "p_miss", "p_false", "class_id"))
    names, feature = _features(table)
    present = table.flags("present", hint=_FLAG_HINT + ", empty where unknown")
    stamp_s = table.numbers(STAMP_S)
    index = {name: k for k, name in enumerate(looks.names)}
    ours = np.array([index.get(name, UNKNOWN) for name in names], dtype=np.int64)
    strangers = int((ours == UNKNOWN).sum())
    if strangers == len(names):
        problem = f"contains none of the features of {looks.source or 'the looks'}"
        raise InputError(problem, path=path_of(source), field="feature_id", hint=f"such as {quote(looks.names[0])}")
    if strangers:
        warnings.append(f"{path_of(source).name}: {counted(strangers, 'feature')} without looks ignored")
    rows = np.flatnonzero((ours[feature] != UNKNOWN) & ~np.isnan(present))
    rows = rows[np.lexsort((stamp_s[rows], ours[feature[rows]]))]
    truth = Truth(firsts_of(ours[feature[rows]], looks.n_features), stamp_s[rows], present[rows])
    return truth, tuple(warnings)


def _explain_missing(table: Columns) -> None:
    """More than 'missing column' about the two columns that tables of looks lack most often."""
    if set(table.columns) - {*_REQUIRED, *_OPTIONAL}:
        return  # a name that is nearly right is the likelier mistake
    if "feature_id" not in table:
        hint = "add it, with one and the same value if there is only one feature"
        raise table.error("missing column", row=None, field="feature_id", hint=hint)
    if "detected" not in table and "present" in table:
        hint = "the detector's output, 1 or 0; 'present' is the truth, which only scores the result"
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
        whose, here = quote(names[feature[row]]), quote(class_names[of_row[row]])
        problem = f"feature {whose} is {here} here and {quote(first)} above"
        raise table.error(problem, row=row, field="class_id", hint="one class per feature")
    return tuple(class_names), of_feature


@dataclass(frozen=True, slots=True)
class PartedLooks:
    """A Parquet table of looks that is too large for memory, in files of so many features each as memory holds.

    Attributes:
        path: the table, a file or a folder.
        names: F feature ids, in natural order, as `LookTable` has them.
        class_names: classes in use.
        class_of_feature: (F,) index into them, `UNKNOWN` where none was given.
        looks: (F,) number of looks of each feature.
        edges: (P + 1,) features `edges[k]` to `edges[k + 1]` are in `files[k]`, rows in the order of the table.
        files: of the parts.
        rows: of the table.
        span: times of all rows.
        clock: what stamps count, where they were dates.
        p_miss, p_false: where the table does not say.
    """

    path: Path
    names: tuple[str, ...]
    class_names: tuple[str, ...]
    class_of_feature: IntArray
    looks: IntArray
    edges: IntArray
    files: tuple[Path, ...]
    rows: int
    span: Span
    clock: Clock | None
    p_miss: float
    p_false: float

    @property
    def n_features(self) -> int:
        """F."""
        return len(self.names)

    @classmethod
    def split(cls, path: Path, folder: Path, config: PersistConfig) -> PartedLooks:
        """Read a table twice, some rows at a time: what features there are, then which part in a folder each row is of.

        Of the configuration it takes `rows_at_once`, at most, unless one feature has more, `p_miss` and `p_false`.

        Raises:
            InputError, ConfigError: as `read_looks`; a table with truth, which is scored in one piece only.
        """
        _check_defaults(config.p_miss, config.p_false)
        found = _survey(path)
        order = natural_order(list(found.features))
        names = tuple(np.array(list(found.features), dtype=object)[order].tolist())
        rows, looks, classes = (np.array(column)[order] for column in zip(*found.features.values(), strict=True))
        kinds = [name for name in found.classes if name]
        class_names = tuple(kinds[k] for k in natural_order(kinds))
        number = {name: k for k, name in enumerate(class_names)}
        before = np.concatenate([[0], np.cumsum(rows)])
        edges = [0]
        while edges[-1] < len(names):
            fits = int(np.searchsorted(before, before[edges[-1]] + config.rows_at_once, side="right")) - 1
            edges.append(max(fits, edges[-1] + 1))
        files = tuple(folder / f"part{k}.parquet" for k in range(len(edges) - 1))
        _route(path, {name: k for k, name in enumerate(names)}, np.array(edges), files)
        return cls(
            path, names, class_names, np.array([number.get(found.classes[k], UNKNOWN) for k in classes]), looks,
            np.array(edges), files, int(rows.sum()), found.span, found.clock, config.p_miss, config.p_false,
        )  # fmt: skip

    def part(self, number: int) -> tuple[LookTable, IntArray]:
        """Return a part, and which row of the whole table each of its rows is, counted from 0."""
        read = pq.read_table(self.files[number], use_threads=False)
        cells = {name: read[name].combine_chunks() for name in read.column_names}
        row, rank = (cells.pop(name).to_numpy() for name in ("row", "rank"))
        table = _looks_of(Columns(self.path, cells, row + 1, None), self.p_miss, self.p_false)
        place = np.empty(table.n_features, dtype=np.int64)  # among all names, natural order may be another
        place[table.feature] = rank - self.edges[number]
        names = np.array(table.names, dtype=object)
        classes = np.array([*map(self.class_names.index, table.class_names), UNKNOWN])[table.class_of_feature]
        back = np.argsort(place)
        return replace(
            table, names=tuple(names[back].tolist()), feature=place[table.feature], class_names=self.class_names,
            class_of_feature=classes[back], whole=self.span, clock=self.clock,
        ), row  # fmt: skip

    def alone(self) -> PartedLooks:
        """Return the same without what a part does without, to be sent to a process."""
        none = np.zeros(0, dtype=np.int64)
        return replace(self, names=(), class_of_feature=none, looks=none)

    def of(self, features: IntArray) -> LookTable:
        """Return the rows of some features (in their order), which memory holds."""
        parts = []
        for number in np.unique(np.searchsorted(self.edges, features, side="right") - 1):
            first, end = self.edges[number : number + 2]
            parts.append(self.part(number)[0].only(features[(features >= first) & (features < end)] - first))
        start = np.cumsum([0, *(part.n_features for part in parts)])
        names = ("stamp_s", "detected", "p_miss", "p_false", "line", "class_of_feature")
        columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        feature = np.concatenate([part.feature + at for part, at in zip(parts, start, strict=False)])
        return replace(parts[0], **columns, feature=feature, names=tuple(name for part in parts for name in part.names))


@dataclass(slots=True)
class _Surveyed:
    """What the first reading of a table finds: rows, looks and class of each feature."""

    features: dict[str, tuple[int, int, int]]
    classes: list[str]
    span: Span
    clock: Clock | None


def _survey(path: Path) -> _Surveyed:
    found = _Surveyed({}, [""], Span(np.inf, -np.inf, np.inf, -np.inf), None)
    for table in parquet_batches(path):
        _explain_missing(table)
        table.expect(_REQUIRED, _OPTIONAL)
        if "present" in table:
            hint = "without that column, or with `rows_at_once` as many as it has"
            raise InputError("truth is scored in one piece only", path=path, field="present", hint=hint)
        names, feature = _features(table)
        class_names, classes = _classes(table, feature, names)
        stamp_s, looked = table.numbers(STAMP_S), ~np.isnan(_detected(table))
        found.clock = found.clock or (table.clock() if len(table) else None)
        looked_s = stamp_s[looked]
        here = [stamp_s.min(initial=np.inf), stamp_s.max(initial=-np.inf)]
        here += [looked_s.min(initial=np.inf), looked_s.max(initial=-np.inf)]
        least = zip(found.span, map(float, here), (min, max, min, max), strict=True)
        found.span = Span(*(choose(a, b) for a, b, choose in least))
        found.classes += [name for name in class_names if name not in found.classes]
        counts = np.bincount(feature, minlength=len(names)), np.bincount(feature[looked], minlength=len(names))
        for name, rows, looks, kind in zip(names, *counts, classes, strict=True):
            had = found.features.get(name, (0, 0, 0))
            of = 0 if kind == UNKNOWN else found.classes.index(class_names[kind])
            found.features[name] = (had[0] + int(rows), had[1] + int(looks), had[2] or of)
    if not found.features:
        raise InputError("has no rows below its header", path=path, hint="one row per look")
    if not np.isfinite(found.span.last_look_s):
        raise _no_look(path)
    return found


def _route(path: Path, rank: Mapping[str, int], edges: IntArray, files: Sequence[Path]) -> None:
    """Write each row to the file of its feature."""
    with ExitStack() as stack:
        writers: dict[int, Any] = {}
        for table in parquet_batches(path):
            names, feature = _features(table)
            ranks = np.array([rank[name] for name in names])[feature]
            part = np.searchsorted(edges, ranks, side="right") - 1
            order = np.argsort(part, kind="stable")
            numbers = {"row": arrow_cells(table.line - 1), "rank": arrow_cells(ranks)}
            batch = pa.table({**table.columns, **numbers}).take(arrow_cells(order))
            start = np.searchsorted(part[order], np.arange(len(files) + 1))
            for number in np.unique(part):
                if number not in writers:
                    made = pq.ParquetWriter(files[number], batch.schema, compression="zstd")
                    writers[number] = stack.enter_context(made)
                writers[number].write_table(batch.slice(start[number], start[number + 1] - start[number]))
