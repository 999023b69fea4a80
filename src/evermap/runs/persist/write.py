"""The folder of a run: beliefs, changes, forecasts, summary, figures and report, whole or not at all."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from evermap.io.columns import csv_bytes, named
from evermap.runs.folder import RunFolder
from evermap.runs.persist.report import clock_of, draw_run, render_report
from evermap.runs.persist.run import PersistResult
from evermap.runs.summary import RunInfo, change_dict, changes_text, summary_head
from evermap.types import ChangeKind, Clock, MapChange, json_number, landmark_id_of
from evermap.viz.style import NamedFigure, save_png, save_svg


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

    Args:
        out: the folder; an older run there is replaced at the end.
        result: of `run_persist`; `result.config.figures` features get a figure of their own.
        clock: of the stamps, for the figures; None guesses.
        info: command and measured times.
        force: write into a folder that holds other files, too; they stay.
        inputs: files that were read, beside the table.
        progress: told after each figure.

    Raises:
        ConfigError: `out` must not or cannot be written.
    """
    with RunFolder(out, force=force, inputs=(result.table.source, *inputs)) as folder:
        start = perf_counter()
        folder.path("beliefs.csv").write_bytes(_beliefs(result))
        folder.path("forecasts.csv").write_bytes(_forecasts(result))
        folder.path("changes.jsonl").write_text(_changes(result), encoding="utf-8")
        if result.learned is not None:
            from evermap.runs.persist.models import save_models

            save_models(result.models, result.learned.per, folder.path("model.json"))
        written = perf_counter()
        drawn: list[NamedFigure] = []
        total = min(result.config.figures, result.table.n_features) + 1 + (result.scores is not None)
        for figure in draw_run(result, figures=result.config.figures, clock=clock):
            save_png(figure.figure, folder.path(f"figures/{figure.name}.png"))
            save_svg(figure.figure, folder.path(f"figures/{figure.name}.svg"))
            drawn.append(figure)
            if progress:
                progress(len(drawn), total)
        timing = {
            **{f"{name}_s": seconds for name, seconds in result.step_s.items()},
            "write_s": written - start,
            "draw_s": perf_counter() - written,
        }
        summary = folder.finish(persist_summary(result, info=info or RunInfo(), timing=timing), "report.html")
        page = render_report(result, summary, drawn, clock or clock_of(result))
        folder.path("report.html").write_text(page, encoding="utf-8")
    return summary


def persist_summary(result: PersistResult, *, info: RunInfo, timing: dict[str, float]) -> dict[str, Any]:
    """Return the content of `summary.json`; outside of `timing` and `versions` a function of input and choices."""
    table, changes = result.table, result.changes
    looked = table.looked
    config = {"persist": result.config.to_dict()}
    return {
        **summary_head(info, config=config, source=table.source, timing=timing, warnings=result.warnings),
        "model": {name: model["kind"] for name, model in result.models.to_dict().items()},
        "learning": None if result.learned is None else result.learned.to_dict(),
        "counts": {
            "rows": len(table),
            "looks": int(looked.sum()),
            "detections": int((table.detected == 1.0).sum()),
            "features": table.n_features,
            "features_detected": len(np.unique(table.feature[table.detected == 1.0])),
            "classes": len(table.class_names),
            "beliefs": int((~np.isnan(result.beliefs.p_exists)).sum()),
            "vanished": int((~changes.returned).sum()),
            "returned": int(changes.returned.sum()),
            "duration_s": float(table.stamp_s.max() - table.stamp_s.min()),
        },
        "detector": {
            name: {"least": float(values[looked].min()), "most": float(values[looked].max())}
            for name, values in (("p_miss", table.p_miss), ("p_false", table.p_false))
        },
        "never_leave_share": _never_leave(result),
        "expected_present_now": json_number(float(np.nansum(result.forecasts.p_exists[:, 0]))),
        "merged_mass": json_number(result.merged_mass),
        "metrics": None if result.scores is None else {k: json_number(v) for k, v in asdict(result.scores).items()},
        "reliability": None if result.reliability is None else _reliability(result),
    }


def _beliefs(result: PersistResult) -> bytes:
    beliefs = result.beliefs
    return csv_bytes(
        {
            "stamp_s": beliefs.stamp_s,
            "feature_id": named(result.table.names, beliefs.feature),
            "p_exists": beliefs.p_exists,
        }
    )


def _forecasts(result: PersistResult) -> bytes:
    """By feature and time; what is expected from now on stands where the forecast begins."""
    stamp_s, p_exists = result.forecasts.stamp_s, result.forecasts.p_exists
    features, steps = p_exists.shape
    columns = {
        "stamp_s": np.tile(stamp_s, features),
        "feature_id": named(result.table.names, np.repeat(np.arange(features), steps)),
        "p_exists": p_exists.ravel(),
    }
    for name in ("median_stay_s", "mean_stay_s", "mean_absence_s"):
        column = np.full((features, steps), np.nan)
        column[:, 0] = getattr(result.forecasts, name)
        columns[name] = column.ravel()
    return csv_bytes(columns)


def _changes(result: PersistResult) -> str:
    """What vanished and returned, as every verb writes changes."""
    changes, names = result.changes, result.table.names
    numbers = all(name.lstrip("-").isdigit() and str(int(name)) == name for name in names)
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


def _never_leave(result: PersistResult) -> dict[str, float]:
    """Share of the features that never leave, by class, where the lifetime says so."""
    models = zip(result.models.names, result.models.models, strict=True)
    return {name or "all": float(getattr(getattr(m, "prior", None), "p_never_leaves", 0.0)) for name, m in models}


def _reliability(result: PersistResult) -> dict[str, list[Any]]:
    bins = result.reliability
    assert bins is not None
    return {
        "edge": bins.edge.tolist(),
        "count": bins.count.tolist(),
        "belief": [json_number(value) for value in bins.belief.tolist()],
        "present": [json_number(value) for value in bins.present.tolist()],
    }
