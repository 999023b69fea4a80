"""All races, their ratios, and the committed baseline they are compared with.

Contenders take turns in one process, so that both meet the same machine in the same mood. Of the long races (SLAM, on
one core) the ratio of every turn is formed before the median is taken; of the short ones see `persistence`. A time
alone says nothing about another machine and is only shown.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from benchmarks import (
    association,
    cliques,
    fleet,
    kitti,
    localize,
    npmle,
    persistence,
    scale,
    scale_report,
    selectors,
    space,
    tracking,
)
from benchmarks.contenders import CONTENDERS
from benchmarks.memory import measure
from benchmarks.world import circular_world
from evermap.errors import InputError
from evermap.io.files import write_atomic

BASELINE = Path(__file__).resolve().parent / "baseline.json"
N_POSES = 2000
TURNS = 5
_WARM_UP_POSES = 50

METRICS: dict[str, tuple[str, float, str]] = {
    "isam2_speed_ratio": ("higher", 0.25, "poses a second of IncrementalSmoother over plain gtsam ISAM2"),
    "isam2_memory_ratio": ("lower", 0.25, "memory that streaming adds, over plain gtsam ISAM2"),
    "batch_speed_ratio": ("higher", 0.25, "speed of Smoother (optimum and marginals) over gtsam LM and Marginals"),
    "batch_memory_ratio": ("lower", 0.25, "memory that it adds, over gtsam LM and Marginals"),
    **persistence.METRICS,
    **selectors.METRICS,
    **cliques.METRICS,
    **npmle.METRICS,
    **tracking.METRICS,
    **kitti.METRICS,
    **localize.METRICS,
    **scale.METRICS,
    **space.METRICS,
    **association.METRICS,
    **fleet.METRICS,
}
"""Metric: which direction is better, relative tolerance, meaning."""

PARTS = (
    "slam",
    "persistence",
    "selectors",
    "cliques",
    "npmle",
    "tracking",
    "kitti",
    "localize",
    "scale",
    "space",
    "association",
    "fleet",
)
_RENEW = "evermap bench --update-baseline"


def run(
    update_baseline: bool = False,
    *,
    only: str | None = None,
    n_poses: int = N_POSES,
    turns: int = TURNS,
    n_features: int = persistence.N_FEATURES,
    seconds: float = persistence.SECONDS,
    n_cliques: int = cliques.N_CLIQUES,
    n_lifetimes: int = npmle.N_LIFETIMES,
    n_frames: int = tracking.N_FRAMES,
    n_stored: int = tracking.N_STORED,
    n_steps: int = localize.N_FRAMES,
    sizes: Sequence[int] | None = None,
) -> dict[str, Any]:
    """Measure everything and compare it with the baseline.

    Args:
        update_baseline: make these measurements the baseline; what is not measured stays.
        only: one of `PARTS`; all where None, `kitti` where its recordings are there.
        n_poses, turns: size of the world and repetitions; the baseline belongs to the defaults.
        n_features, seconds, n_cliques: the same for the persistence filter, and for the filters of cliques.
        n_lifetimes: censored samples of each kind.
        n_frames, n_stored: length of a scene for trackers, and objects in the working set.
        n_steps: frames of a drive in a known map.
        sizes: landmarks of the warehouses whose cost is measured; None for those of the baseline.

    Returns:
        `metrics` (a dictionary each: metric, value, baseline, direction, tolerance, change, regression), `shown`
        (times and memory as they were, for information) and `regressions`, the names of metrics out of tolerance.

    Raises:
        InputError: the baseline is missing or damaged, and is not being updated; a part that does not exist.
    """
    if only not in (None, *PARTS):
        raise InputError(f"no part '{only}'", field="only", hint=" or ".join(PARTS))
    measured: dict[str, float] = {}
    shown: dict[str, Any] = {}
    if only in (None, "slam"):
        shown |= {"n_poses": n_poses, "turns": turns}
        for race in CONTENDERS:
            measured[f"{race}_speed_ratio"], speeds = _speed(race, n_poses, turns)
            measured[f"{race}_memory_ratio"], memory = _memory(race, n_poses)
            shown[race] = speeds | memory
    if only in (None, "persistence"):
        ratios, shown["persistence"] = persistence.run(n_features, seconds)
        measured |= ratios
    if only in (None, "selectors"):
        ratios, shown["selectors"] = selectors.run()
        measured |= ratios
    if only in (None, "cliques"):
        ratios, shown["cliques"] = cliques.run(n_cliques, seconds)
        measured |= ratios
    if only in (None, "npmle"):
        ratios, shown["npmle"] = npmle.run(n_lifetimes)
        measured |= ratios
    if only in (None, "tracking"):
        ratios, shown["tracking"] = tracking.run(n_frames, n_stored)
        measured |= ratios
    if only == "kitti" or (only is None and kitti.FOLDER.is_dir()):
        ratios, shown["kitti"] = kitti.run()
        measured |= ratios
    if only in (None, "localize"):
        ratios, shown["localize"] = localize.run(n_steps)
        measured |= ratios
    if only in (None, "scale"):
        ratios, shown["scale"] = scale.run(sizes)
        measured |= ratios
    if only == "space" or (only is None and (space.FOLDER / "tagslam").is_dir()):
        ratios, shown["space"] = space.run()
        measured |= ratios
    if only == "association" or (only is None and (association.FOLDER / "mrclam").is_dir()):
        ratios, shown["association"] = association.run()
        measured |= ratios
    if only == "fleet" or (only is None and find_spec("fastapi")):
        ratios, shown["fleet"] = fleet.run()
        measured |= ratios
    if update_baseline:
        kept = {name: row["value"] for name, row in _rows(BASELINE).items()} if only or "kitti" not in shown else {}
        write_atomic(BASELINE, json.dumps(_as_baseline(kept | measured), indent=2) + "\n")
    metrics = compare(measured, read_baseline())
    return {
        "metrics": metrics,
        "shown": shown,
        "regressions": [row["metric"] for row in metrics if row["regression"]],
    }


def read_baseline(path: Path = BASELINE) -> dict[str, dict[str, Any]]:
    """The committed baseline by metric: direction, tolerance, value.

    Raises:
        InputError: it is missing, damaged, or lacks a metric.
    """
    baseline = _rows(path)
    lacking = [name for name in METRICS if name not in baseline]
    if lacking:
        raise InputError(f"lacks {', '.join(lacking)}", path=path, hint=_RENEW)
    return baseline


def _rows(path: Path) -> dict[str, dict[str, Any]]:
    """What a baseline file holds, complete or not."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["metrics"]
        return {row["metric"]: {key: row[key] for key in ("direction", "tolerance", "value")} for row in rows}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError("is no benchmark baseline", path=path, hint=_RENEW) from error


def compare(measured: Mapping[str, float], baseline: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Every metric beside its baseline; `change` is relative and positive where it got better."""
    rows = []
    for name, value in measured.items():
        was = baseline[name]
        better = 1.0 if was["direction"] == "higher" else -1.0
        change = better * (value / was["value"] - 1.0)
        rows.append(
            {
                "metric": name,
                "value": value,
                "baseline": was["value"],
                "direction": was["direction"],
                "tolerance": was["tolerance"],
                "change": change,
                "regression": change < -was["tolerance"],
            }
        )
    return rows


def as_text(measured: Mapping[str, Any]) -> str:
    """The comparison as aligned text, regressions marked, with the times behind it below."""
    width = max(map(len, METRICS))
    lines = [f"{'metric':<{width}} {'value':>7} {'baseline':>9} {'change':>8} {'allowed':>8}"]
    for row in measured["metrics"]:
        mark = "  REGRESSION" if row["regression"] else ""
        allowed = f"-{row['tolerance']:.0%}"
        numbers = f"{row['value']:>7.3f} {row['baseline']:>9.3f} {row['change']:>+8.0%} {allowed:>8}"
        lines.append(f"{row['metric']:<{width}} {numbers}{mark}")
        lines.append(f"  {METRICS[row['metric']][2]} ({row['direction']} is better)")
    shown = measured["shown"]
    if "n_poses" in shown:
        size = f"{shown['n_poses']} poses, median of {shown['turns']} turns"
        lines += ["", f"on this machine now, {size} (for information):"]
    for race in CONTENDERS if "n_poses" in shown else ():
        for contender in ("evermap", "gtsam"):
            pace, memory = shown[race][f"{contender}_poses_per_s"], shown[race][f"{contender}_memory_mb"]
            lines.append(f"  {race:<6} {contender:<8} {pace:>8.0f} poses/s  {memory:>6.1f} MB")
    if "persistence" in shown:
        lines += ["", persistence.as_markdown(shown["persistence"])]
    if "selectors" in shown:
        took = ", ".join(f"{name} {ms:.2f} ms" for name, ms in shown["selectors"]["ms"].items())
        lines += ["", f"{shown['selectors']['n_looks']} looks at each of {selectors.N_LANDMARKS} landmarks: {took}"]
    if "cliques" in shown:
        lines += ["", cliques.as_text(shown["cliques"])]
    if "npmle" in shown:
        lines += ["", npmle.as_text(shown["npmle"])]
    if "tracking" in shown:
        lines += ["", tracking.as_markdown(shown["tracking"])]
    if "kitti" in shown:
        lines += ["", kitti.as_markdown(shown["kitti"])]
    if "localize" in shown:
        lines += ["", localize.as_markdown(shown["localize"])]
    if "scale" in shown:
        lines += ["", scale_report.as_markdown(shown["scale"])]
    if "space" in shown:
        lines += ["", space.as_markdown(shown["space"])]
    if "association" in shown:
        lines += ["", association.as_markdown(shown["association"])]
    if "fleet" in shown:
        lines += ["", fleet.as_markdown(shown["fleet"])]
    verdict = ", ".join(measured["regressions"])
    lines += ["", f"worse than the baseline allows: {verdict}" if verdict else "no regression"]
    return "\n".join(lines)


def _speed(race: str, n_poses: int, turns: int) -> tuple[float, dict[str, float]]:
    """Median over the turns of gtsam's time over evermap's, and the paces."""
    ours, theirs = CONTENDERS[race]
    calibrated = race == "isam2"  # streaming estimates the calibration too, as it does in earnest
    for contender in (ours, theirs):
        contender(circular_world(_WARM_UP_POSES, calibrated=calibrated))
    world = circular_world(n_poses, calibrated=calibrated)
    times = [(ours(world).elapsed_s, theirs(world).elapsed_s) for _ in range(turns)]
    return statistics.median(their_s / our_s for our_s, their_s in times), {
        "evermap_poses_per_s": n_poses / statistics.median(our_s for our_s, _ in times),
        "gtsam_poses_per_s": n_poses / statistics.median(their_s for _, their_s in times),
    }


def _memory(race: str, n_poses: int) -> tuple[float, dict[str, float]]:
    """Ratio of what the contenders' processes grew by, and both [MB]."""
    grown, shown = {}, {}
    for contender in ("evermap", "gtsam"):
        found = measure(race, contender, n_poses)
        grown[contender] = max(found["peak_mb"] - found["before_mb"], 0.1)
        shown[f"{contender}_memory_mb"] = grown[contender]
        shown[f"{contender}_peak_mb"] = found["peak_mb"]
    return grown["evermap"] / grown["gtsam"], shown


def _as_baseline(measured: Mapping[str, float]) -> dict[str, Any]:
    rows = [
        {"metric": name, "direction": direction, "tolerance": tolerance, "value": round(measured[name], 4)}
        for name, (direction, tolerance, _) in METRICS.items()
        if name in measured
    ]
    return {"n_poses": N_POSES, "n_features": persistence.N_FEATURES, "metrics": rows}
