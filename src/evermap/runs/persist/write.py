"""The folder of a run: beliefs, changes, forecasts, summary, figures and report, whole or not at all."""

from __future__ import annotations

import heapq
import json
import math
import shutil
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from evermap.config import NO_RECURRENCE, PersistConfig
from evermap.errors import ConfigError, EvermapError
from evermap.io.arrow import arrow_cells
from evermap.io.columns import csv_bytes, named, needs_quotes
from evermap.metrics.belief import Reliability
from evermap.runs.folder import RunFolder
from evermap.runs.persist.changes import MOST_FEATURES, most_changed
from evermap.runs.persist.models import (
    LearnedModels,
    draw_features,
    grouping_of,
    groups_of,
    learn_models,
    save_models,
)
from evermap.runs.persist.report import MOST_ROWS, draw_run, render_report
from evermap.runs.persist.run import BELIEF, OUTLOOK, Part, PersistResult, Totals, remarks, run_persist
from evermap.runs.persist.table import PartedLooks, are_numbers
from evermap.runs.summary import RunInfo, change_dict, changes_text, summary_head
from evermap.types import ChangeKind, Clock, FloatArray, IntArray, MapChange, json_number, landmark_id_of
from evermap.viz.style import NamedFigure, save_png, save_svg
from evermap.viz.time_axis import guess_clock


def write_persist(
    out: str | Path,
    result: PersistResult,
    *,
    clock: Clock | None = None,
    info: RunInfo | None = None,
    force: bool = False,
    inputs: Iterable[str | Path | None] = (),
    progress: Callable[[float, float], None] | None = None,
) -> dict[str, Any]:
    """Write the folder of a run and return the content of `summary.json`.

    `result.config.figures` features get a figure of their own, after each of which `progress` is told. Without a
    `clock` of the stamps it is guessed. `out`, `force` and `inputs` (beside the table) are as of `RunFolder`.

    Raises:
        ConfigError: `out` must not or cannot be written.
    """
    with RunFolder(out, force=force, inputs=(result.table.source, *inputs)) as folder:
        start = perf_counter()
        folder.path("beliefs.csv").write_bytes(_table(result, "beliefs"))
        folder.path("forecasts.csv").write_bytes(_table(result, "forecasts"))
        folder.path("changes.jsonl").write_text(_changes(result, are_numbers(result.table.names)), encoding="utf-8")
        if result.learned is not None:
            save_models(result.models, result.learned.per, folder.path("model.json"))
        timing = {f"{name}_s": seconds for name, seconds in result.step_s.items()}
        timing["write_s"] = perf_counter() - start
        return _finish(folder, result, clock, info or RunInfo(), timing, progress)


def _finish(
    folder: RunFolder,
    result: PersistResult,
    clock: Clock | None,
    info: RunInfo,
    timing: dict[str, float],
    progress: Callable[[float, float], None] | None,
) -> dict[str, Any]:
    """Draw, and write summary and report."""
    start = perf_counter()
    clock = clock or result.table.clock or guess_clock(result.table.stamp_s)
    drawn: list[NamedFigure] = []
    total = min(result.config.figures, result.table.n_features) + 1 + (result.scores is not None)
    for figure in draw_run(result, clock):
        save_png(figure.figure, folder.path(f"figures/{figure.name}.png"))
        save_svg(figure.figure, folder.path(f"figures/{figure.name}.svg"))
        drawn.append(figure)
        if progress:
            progress(len(drawn), total)
    timing = {**timing, "draw_s": perf_counter() - start}
    summary = folder.finish(persist_summary(result, info=info, timing=timing), "report.html")
    folder.path("report.html").write_text(render_report(result, summary, drawn, clock), encoding="utf-8")
    return summary


def persist_in_parts(
    folder: RunFolder,
    path: str | Path,
    config: PersistConfig,
    *,
    clock: Clock | None = None,
    info: RunInfo | None = None,
    workers: int | None = 1,
    cluster: str | None = None,
    progress: Callable[[float, float], None] | None = None,
) -> dict[str, Any]:
    """Write what `run_persist` and `write_persist` make of a Parquet table, but in parts of `config.rows_at_once` rows.

    In memory there are a part for each worker, and a few hundred bytes a feature. A part has all rows of its features.
    How the work is spread is as of `runs.company.spread_over`; a cluster reaches the table, which may be a folder of
    files, and the folder of the run under the same names. Returns the summary.

    Raises:
        ConfigError, InputError, DataError: as `read_looks`, `run_persist` and `write_persist`; a model for each feature
            of its own, and a table with truth, are for one piece only.
    """
    from evermap.runs.company import spread_over

    start = perf_counter()
    with TemporaryDirectory(prefix="parts-", dir=folder.path(".")) as name:
        scratch = Path(name)
        parted = PartedLooks.split(Path(path), scratch, config)
        learned, with_model = _learn_models(folder, parted, config)
        quoted, numbered = needs_quotes(arrow_cells(list(parted.names))), are_numbers(parted.names)
        work = partial(
            _work_on, parted=parted.alone(), config=with_model, quoted=quoted, numbered=numbered, folder=scratch
        )
        items = list(map(str, range(len(parted.files))))
        done = spread_over(items, work, workers=workers, cluster=cluster, progress=progress)
        for one in done:
            if isinstance(one, EvermapError):
                raise one
        _join(folder, scratch, parted, config, quoted)
        totals = Totals.merged([part.totals for part in done])
        shown = run_persist(parted.of(_choose_shown(parted, done, totals, config)), with_model)
    told = tuple(remarks(config, shown.models, totals))
    result = replace(shown, config=config, learned=learned, totals=totals, warnings=told)
    return _finish(folder, result, clock, info or RunInfo(), {"parts_s": perf_counter() - start}, None)


class _Part(NamedTuple):
    """What is kept of a part in memory: what is counted, changes of each feature, and the latest of them."""

    totals: Totals
    changes: IntArray
    latest: FloatArray


def _work_on(
    number: str, parted: PartedLooks, config: PersistConfig, quoted: bool, numbered: bool, folder: Path
) -> _Part:
    """Run a part, and write its pieces of the files."""
    table, row = parted.part(int(number))
    result, first = run_persist(table, config), parted.edges[int(number)]
    beliefs, changes = result.beliefs, result.changes
    if config.query == "times":
        columns = {"row": row, "stamp_s": beliefs.stamp_s, "feature": beliefs.feature + first, "p": beliefs.p_exists}
        for name, column in columns.items():
            np.save(folder / f"{name}-{number}.npy", column)
    else:
        (folder / f"beliefs-{number}").write_bytes(_table(result, "beliefs", quoted=quoted, header=False))
    (folder / f"forecasts-{number}").write_bytes(_table(result, "forecasts", quoted=quoted, header=False))
    (folder / f"changes-{number}").write_text(_changes(result, numbered), encoding="utf-8")
    latest = np.array([changes.decided_s, changes.stamp_s, changes.feature + first])[:, -MOST_ROWS:]
    return _Part(result.totals, changes.per_feature(table.n_features), latest)


def _learn_models(
    folder: RunFolder, parted: PartedLooks, config: PersistConfig
) -> tuple[LearnedModels | None, PersistConfig]:
    """Learn as from the table in one piece, and return settings that read what was learned."""
    if not config.learns:
        return None, config
    per = grouping_of(parted, parted.looks, config)
    if per == "feature":
        problem, hint = "a model for each feature is learned in one piece", "all or class, or `rows_at_once` larger"
        raise ConfigError(problem, field="per", hint=hint)
    groups = [features for _, features in groups_of(parted, per)]
    most = max(config.learn_from // len(groups), 2)
    chosen = [features[draw_features(parted.looks[features], most)] for features in groups]
    table = parted.of(np.sort(np.concatenate(chosen)))
    learned = learn_models(table, table.looks(table.order()), config.model_copy(update={"per": per}))
    save_models(learned.models, learned.per, folder.path("model.json"))
    return learned, config.model_copy(update={"recurrent": NO_RECURRENCE, "model": str(folder.path("model.json"))})


def _join(folder: RunFolder, scratch: Path, parted: PartedLooks, config: PersistConfig, quoted: bool) -> None:
    """Put the pieces of all parts together, as one piece would have them."""
    numbers = range(len(parted.files))
    for name in ("forecasts",) if config.query == "times" else ("forecasts", "beliefs"):
        with folder.path(f"{name}.csv").open("wb") as file:
            file.write((",".join(BELIEF if name == "beliefs" else (*BELIEF, *OUTLOOK)) + "\n").encode())
            for number in numbers:
                with (scratch / f"{name}-{number}").open("rb") as piece:
                    shutil.copyfileobj(piece, file)
    if config.query == "times":
        _join_rows(folder.path("beliefs.csv"), scratch, parted, quoted)
    with ExitStack() as stack, folder.path("changes.jsonl").open("w", encoding="utf-8") as file:
        pieces = [stack.enter_context((scratch / f"changes-{k}").open(encoding="utf-8")) for k in numbers]
        file.writelines(heapq.merge(*pieces, key=_when))  # of equal times, the first part's comes first


def _when(line: str) -> tuple[float, float]:
    told = json.loads(line)
    return told["decided_s"], told["stamp_s"]


def _join_rows(path: Path, scratch: Path, parted: PartedLooks, quoted: bool) -> None:
    """Write beliefs in the order of the table, some rows at a time."""
    names = arrow_cells(list(parted.names))
    with path.open("wb") as file:
        for start in range(0, parted.rows, _ROWS):
            size = min(_ROWS, parted.rows - start)
            stamp_s, p, feature = np.empty(size), np.empty(size), np.empty(size, dtype=np.int64)
            for number in range(len(parted.files)):
                pieces = (scratch / f"{name}-{number}.npy" for name in ("row", "stamp_s", "p", "feature"))
                row, *columns = (np.load(piece, mmap_mode="r") for piece in pieces)
                a, b = np.searchsorted(row, (start, start + size))
                for into, column in zip((stamp_s, p, feature), columns, strict=True):
                    into[row[a:b] - start] = column[a:b]
            cells = dict(zip(BELIEF, (stamp_s, names.take(arrow_cells(feature)), p), strict=True))
            file.write(csv_bytes(cells, quoted=quoted, header=start == 0))


def _choose_shown(parted: PartedLooks, done: Sequence[_Part], totals: Totals, config: PersistConfig) -> IntArray:
    """The features of which figures and report tell."""
    changes = np.concatenate([part.changes for part in done])
    changed = most_changed(changes, parted.looks, max(MOST_FEATURES, config.figures))
    decided_s, stamp_s, feature = np.concatenate([part.latest for part in done], axis=1)
    latest = feature[np.lexsort((feature, stamp_s, decided_s))][-MOST_ROWS:].astype(np.int64)
    return np.unique(np.concatenate([changed, latest, np.flatnonzero(~np.isnan(totals.p_now))[:MOST_ROWS]]))


def persist_summary(result: PersistResult, *, info: RunInfo, timing: dict[str, float]) -> dict[str, Any]:
    """Return the content of `summary.json`; outside of `timing` and `versions` a function of input and choices."""
    table, totals = result.table, result.totals
    config = {"persist": result.config.to_dict()}
    return {
        **summary_head(info, config=config, source=table.source, timing=timing, warnings=result.warnings),
        "model": {name: model["kind"] for name, model in result.models.to_dict().items()},
        "learning": None if result.learned is None else result.learned.to_dict(),
        "counts": {
            "rows": totals.rows,
            "looks": totals.looks,
            "detections": totals.detections,
            "features": len(totals.p_now),
            "features_detected": totals.features_detected,
            "classes": len(table.class_names),
            "beliefs": totals.beliefs,
            "vanished": totals.vanished,
            "returned": totals.returned,
            "duration_s": table.span.stop_s - table.span.start_s,
        },
        "detector": {
            name: dict(zip(("least", "most"), getattr(totals, name), strict=True)) for name in ("p_miss", "p_false")
        },
        "never_leave_share": {name or "all": share for name, share in result.models.never_leave().items()},
        "expected_present_now": json_number(float(np.nansum(totals.p_now))),
        "merged_mass": json_number(totals.merged_mass),
        "metrics": None if result.scores is None else {k: json_number(v) for k, v in asdict(result.scores).items()},
        "reliability": None if result.reliability is None else _reliability(result.reliability),
    }


_ROWS = 1 << 18
"""That are written at a time."""


def _table(result: PersistResult, part: Part, **how: bool) -> bytes:
    return csv_bytes(result.columns_of(part, partial(named, result.table.names)), **how)


def _changes(result: PersistResult, numbers: bool) -> str:
    """What vanished and returned, as every verb writes changes."""
    changes, names = result.changes, result.table.names
    rows = []
    for k, feature in enumerate(changes.feature.tolist()):
        name = names[feature]
        change = MapChange(
            landmark_ids=(int(name) if numbers else landmark_id_of(name),),
            kind=ChangeKind.RETURNED if changes.returned[k] else ChangeKind.VANISHED,
            stamp_from_s=float(changes.earliest_s[k]),
            stamp_to_s=float(changes.latest_s[k]),
            displacement_m=(math.nan, math.nan),
            rotation_rad=0.0,
            probability=float(changes.confidence[k]),
            names=() if numbers else (name,),
        )
        rows.append(change_dict(change, stamp_s=float(changes.stamp_s[k]), decided_s=float(changes.decided_s[k])))
    return changes_text(rows)


def _reliability(bins: Reliability) -> dict[str, list[Any]]:
    return {
        "edge": bins.edge.tolist(),
        "count": bins.count.tolist(),
        "belief": [*map(json_number, bins.belief.tolist())],
        "present": [*map(json_number, bins.present.tolist())],
    }
