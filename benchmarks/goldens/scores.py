"""What parts have in common: the figures of a run that is compared with the truth, of changes, of CPU time."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from evermap.metrics.consistency import chi2_quantile
from evermap.metrics.summary import compare_with_truth, metrics_dict
from evermap.types import AnyRecording, ChangeKind, FloatArray, MapChange, SlamResult

Named = tuple[str, float | None]
"""A figure's name without its part, and its value."""


class MissingDataError(Exception):
    """A recording that is not here; its text says which."""


def scores(recording: AnyRecording, result: SlamResult, *, rate_hz: float = 2.0) -> Iterator[Named]:
    """Yield the errors of poses and landmarks, and NEES and NIS over what is expected of them, of one run.

    Poses are aligned, also in the frame of a map; landmarks are aligned by the poses, and without true poses by
    themselves. NEES are medians over the median of a chi-square: near the first pose of a map from an unknown start,
    covariances vanish, and a mean is of those few poses. Their alignment lowers them, as their kind says.
    """
    compared = compare_with_truth(recording, result, rate_hz=rate_hz)
    found, poses, places = metrics_dict(compared), compared.poses, compared.landmarks
    turn = found["heading_rmse_deg"] if found["heading_rmse_deg"] is not None else found["orientation_rmse_deg"]
    at = "landmark_rmse_m" if found["landmark_rmse_m"] is not None else "landmark_rmse_own_alignment_m"
    figures = {
        "position_m": found["pose_rmse_m"],
        "turn_deg": turn,
        "landmarks_m": found[at],
        "poses/aligned_nees": None if poses is None else _typical(poses.nees, poses.dof),
        "landmarks/aligned_nees": None if places is None else _typical(places.nees[places.scored], places.dof),
        "nis": None if found["nis_mean"] is None else found["nis_mean"] / 2.0,
    }
    yield from ((name, value) for name, value in figures.items() if value is not None)


def mean_of(rows: Sequence[Sequence[Named]]) -> Iterator[Named]:
    """Yield means over runs: errors by their squares, ratios by their logarithms, all else as it is."""
    names = list(dict.fromkeys(name for row in rows for name, _ in row))
    for name in names:
        values = np.array([value for row in rows for of, value in row if of == name and value is not None])
        kind = name.rpartition("/")[2]
        if kind in ("position_m", "turn_deg", "landmarks_m"):
            yield name, float(np.sqrt(np.mean(values**2)))
        elif kind in ("nees", "aligned_nees", "nis"):
            yield name, float(np.exp(np.mean(np.log(values))))
        else:
            yield name, float(np.mean(values))


def _typical(nees: FloatArray, dof: int) -> float | None:
    known = nees[np.isfinite(nees)]
    return float(np.median(known)) / chi2_quantile(0.5, dof) if len(known) else None


def levels(result: SlamResult, names: Sequence[str]) -> Iterator[Named]:
    """Yield some of the calibrations and noise levels that a run has found."""
    found = {item.name: item.value for item in result.parameters}
    yield from ((f"{name}/level", found.get(name)) for name in names)


def changes(told: Sequence[MapChange], true: Sequence[MapChange]) -> Iterator[Named]:
    """Yield how many landmarks are rightly, wrongly and not reported, and how far off the moves are, on average."""
    from evermap_studies.changes import compare_changes, count_changes

    count = count_changes(told, true)
    off = compare_changes(told, true).displacement_error_m
    yield from counted(count.n_found, count.n_true, count.n_right)
    yield "off_m", float(np.nanmean(off)) if np.isfinite(off).any() else None


def counted(n_found: int, n_true: int, n_right: int) -> Iterator[Named]:
    """Yield right, false and missed."""
    yield from (("right", n_right), ("false", n_found - n_right), ("missed", n_true - n_right))


def moved(landmark_id: int, by_m: Sequence[float]) -> MapChange:
    """Return the change of one landmark that moved."""
    return MapChange((landmark_id,), ChangeKind.MOVED, np.nan, np.nan, tuple(by_m), 0.0, 1.0)


class Spent:
    """CPU seconds of this process, known after `measured`."""

    cpu_s = 0.0


@contextmanager
def measured() -> Iterator[Spent]:
    """Measure CPU seconds."""
    spent, began = Spent(), time.process_time()
    yield spent
    spent.cpu_s = time.process_time() - began


def longest_frame_ms(recording: AnyRecording) -> float:
    """Return the longest frame of the stream, after the first ones; without the key `slam.online` all runs stream."""
    import evermap as em
    from benchmarks import scale
    from evermap.config import SlamConfig

    ticks, streams = scale.Ticks(), {"online": True} if "online" in SlamConfig.model_fields else {}
    em.run_slam(recording, em.Config(slam=streams), progress=ticks)
    return 1e3 * float(ticks.frame_s[scale.STREAM_FROM :].max())
