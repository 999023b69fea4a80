"""The folder of a run of `evermap track`: tables, summary, figure and scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from evermap.runs.folder import RunFolder, if_installed
from evermap.runs.summary import RunInfo, summary_head
from evermap.runs.track.tables import track_files
from evermap.tracking.run import TrackResult
from evermap.tracking.tracklets import EventKind
from evermap.types import UNKNOWN, FloatArray, IntArray
from evermap.viz.plots import plot_track_run
from evermap.viz.style import save_png


def write_track(
    out: str | Path,
    result: TrackResult,
    *,
    info: RunInfo | None = None,
    scene: bool = False,
    force: bool = False,
    inputs: Iterable[str | Path | None] = (),
    progress: Callable[[float, float], None] | None = None,
) -> dict[str, Any]:
    """Write the folder of a run. Returns the content of `summary.json`.

    Args:
        out: the folder; an older run there is replaced at the end.
        result: of `run_track`.
        info: command and measured times.
        scene: whether to write a recording for rerun; left out with a warning where rerun-sdk is missing.
        force: write into a folder that holds other files, too; they stay.
        inputs: files that were read, beside the table.
        progress: told after each file.

    Raises:
        ConfigError: `out` must not or cannot be written.
    """
    start = perf_counter()
    files = track_files(result)
    with RunFolder(out, force=force, inputs=(result.table.source, *inputs)) as folder:
        for k, (name, content) in enumerate(files.items()):
            folder.path(name).write_bytes(content())
            if progress:
                progress(k + 1, len(files) + 1)
        written = perf_counter()
        save_png(plot_track_run(result), folder.path("figures/objects.png"))
        rerun = folder.path("scene.rrd")
        remarks = if_installed(rerun.name, partial(write_recording, result, rerun)) if scene else []
        timing = {"track_s": result.seconds, "write_s": written - start, "draw_s": perf_counter() - written}
        summary = track_summary(result, info=info or RunInfo(), timing=timing)
        summary["warnings"] += remarks
        return folder.finish(summary)


def track_summary(result: TrackResult, *, info: RunInfo, timing: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of `summary.json`; outside of `timing` and `versions` a function of the input and the
    choices.
    """
    table, spells = result.table, result.spells
    happened = np.array([event.kind for event in result.events], dtype=np.int64)
    class_of_track = result.class_of_track()
    config = {"track": result.config.to_dict()}
    pace = {"frames_per_second": table.n_frames / result.seconds if result.seconds > 0.0 else None}
    return {
        **summary_head(info, config=config, source=table.source, timing={**timing, **pace}, warnings=result.warnings),
        "counts": {
            "frames": table.n_frames,
            "empty_frames": int((np.diff(table.first) == 0).sum()),
            "gaps": result.n_gaps,
            "detections": len(table),
            "detections_of_objects": int((result.track_of_detection != UNKNOWN).sum()),
            "detections_of_low_score": table.n_weak,
            "objects": len(class_of_track),
            "events": {kind.name.lower(): int((happened == kind).sum()) for kind in EventKind},
            "spells": len(spells),
            "duration_s": float(table.stamp_s[-1] - table.stamp_s[0]),
        },
        "classes": {name or "all": _of_class(result, k, class_of_track) for k, name in enumerate(table.class_names)},
    }


def _of_class(result: TrackResult, class_id: int, class_of_track: IntArray) -> dict[str, Any]:
    """What there is to say about one class."""
    spells = result.spells
    mine = spells.class_id == class_id
    bounded = np.isfinite(spells.elsewhere_s)
    of_lifetime = np.unique(result.spell_of_lifetime)
    stays_s = (spells.last_s - spells.first_s)[mine]
    return {
        "objects": int((class_of_track == class_id).sum()),
        "spells": int(mine.sum()),
        "spells_that_ended": int((mine & np.isfinite(spells.gone_s)).sum()),
        "spells_of_known_beginning": int((mine & bounded).sum()),
        "spells_with_lifetimes": int((spells.class_id[of_lifetime] == class_id).sum()),
        "seen_to_stay_s": {"median": float(np.median(stays_s)), "most": float(stays_s.max())} if len(stays_s) else None,
    }


def write_recording(result: TrackResult, path: Path) -> None:
    """Record objects, frame after frame, with those that rest out of view.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    from evermap.viz.rerun_scene import log_tracks

    table, tracks = result.table, result.objects()
    rows = np.argsort(tracks.stamp_s, kind="stable")
    parts = np.searchsorted(tracks.stamp_s[rows], table.stamp_s[1:])
    log_tracks(
        path,
        stamp_s=table.stamp_s - table.stamp_s[0],
        track_id=np.split(tracks.track_id[rows], parts),
        position_m=np.split(tracks.position_m[rows], parts),
        static=np.split(tracks.static[rows], parts),
        resting_m=_resting(result),
        sensor_m=table.sensor_m,
        reach_m=result.config.range_m,
    )


def _resting(result: TrackResult) -> list[FloatArray]:
    """(F) of (K, 3) places of the objects in the working set at each frame, where they were last seen."""
    tracks = result.objects()
    place = dict(zip(tracks.track_id.tolist(), tracks.position_m, strict=True))  # the last row of each
    events = iter(sorted(result.events, key=lambda event: event.stamp_s))
    event = next(events, None)
    there: set[int] = set()
    resting = []
    for stamp_s in result.table.stamp_s.tolist():
        while event is not None and event.stamp_s <= stamp_s:
            if event.kind == EventKind.STORED:
                there.add(event.track_id)
            else:
                there.discard(event.track_id)
            event = next(events, None)
        resting.append(np.array([place[track] for track in sorted(there) if track in place]).reshape(-1, 3))
    return resting
