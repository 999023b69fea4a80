"""What parts have in common: the figures of a run that is compared with the truth, of changes, of CPU time."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from evermap.geometry.group import PLANE, SPACE, group_of
from evermap.metrics.consistency import chi2_quantile, nees
from evermap.metrics.landmarks import by_recorded_identity, evaluate_landmarks
from evermap.metrics.summary import compare_with_truth, metrics_dict
from evermap.types import AnyRecording, ChangeKind, FloatArray, Landmarks, MapChange, SlamResult

Named = tuple[str, float | None]
"""A figure's name without its part, and its value."""


class MissingDataError(Exception):
    """A recording that is not here; its text says which."""


def scores(
    recording: AnyRecording, result: SlamResult, *, prior: Landmarks | None = None, rate_hz: float = 2.0
) -> Iterator[Named]:
    """Yield the errors of poses and landmarks, and NEES and NIS over what is expected of them, of one run.

    Poses are aligned, also in the frame of a map; landmarks are aligned by the poses, and without true poses by
    themselves. NEES is typical of poses and of landmarks, one by one; see `typical_nees`. A map (`prior`) that is the
    truth is better than it states, which lowers it, as its kind says; `benchmarks.consistency` draws maps.
    """
    compared = compare_with_truth(recording, result, rate_hz=rate_hz)
    found = metrics_dict(compared)
    turn = found["heading_rmse_deg"] if found["heading_rmse_deg"] is not None else found["orientation_rmse_deg"]
    at = "landmark_rmse_m" if found["landmark_rmse_m"] is not None else "landmark_rmse_own_alignment_m"
    poses, places = typical_nees(recording, result, rate_hz=rate_hz, in_map=prior is not None)
    kind = "nees" if prior is None else "mapped_nees"
    figures = {
        "position_m": found["pose_rmse_m"],
        "turn_deg": turn,
        "landmarks_m": found[at],
        f"poses/{kind}": poses,
        f"landmarks/{kind}": places,
        "nis": None if found["nis_mean"] is None else found["nis_mean"] / 2.0,
    }
    yield from ((name, value) for name, value in figures.items() if value is not None)


def typical_nees(
    recording: AnyRecording, result: SlamResult, *, rate_hz: float, in_map: bool
) -> tuple[float | None, float | None]:
    """Return NEES of poses and of landmarks, medians over the median of a chi-square; None where there is no truth.

    Each is in the frame that its covariances hold in: that of a given map, which is that of the truth, or of the pose
    that is known exactly. To align poses first lowers it; in a map it lays errors of poses on landmarks, which are
    known to millimetres (a hand-held camera: 175, but 2.8 as they stand). Means are of few poses: near the first one,
    and where some are lost. What the run tells as changed does not count: it is not where the key has it.
    """
    compared = compare_with_truth(recording, result, rate_hz=rate_hz)
    poses, places = compared.poses, compared.landmarks_anchored
    of_poses = None if poses is None else poses.anchored_nees
    if in_map and poses is not None:
        group, dim = group_of(poses.truth), poses.dof
        pose = group.compose(group.inverse(poses.pose_truth_estimate), poses.estimate)
        off = np.einsum("kji,kj->ki", group.rotation_of(pose), pose[:, :dim] - poses.truth[:, :dim])
        of_poses = nees(off, poses.covariance[:, :dim, :dim])
    if in_map and recording.true_landmarks is not None:
        mapped = by_recorded_identity(result.landmarks, result.innovations, recording)
        frame = (PLANE if mapped.position_m.shape[1] == 2 else SPACE).identity()
        places = evaluate_landmarks(mapped, recording.true_landmarks, frame)
    told = [landmark for change in result.changes for landmark in change.landmark_ids]
    of_places = None if places is None else places.nees[places.scored & ~np.isin(places.landmark_id, told)]
    return _typical(of_poses, poses and poses.dof), _typical(of_places, places and places.dof)


def _typical(values: FloatArray | None, dof: int | None) -> float | None:
    known = np.zeros(0) if values is None else values[np.isfinite(values)]
    return float(np.median(known)) / chi2_quantile(0.5, dof) if dof is not None and len(known) else None


def mean_of(rows: Sequence[Sequence[Named]]) -> Iterator[Named]:
    """Yield means over runs: errors by their squares, ratios by their logarithms, all else as it is."""
    names = list(dict.fromkeys(name for row in rows for name, _ in row))
    for name in names:
        values = np.array([value for row in rows for of, value in row if of == name and value is not None])
        kind = name.rpartition("/")[2]
        if kind in ("position_m", "turn_deg", "landmarks_m"):
            yield name, float(np.sqrt(np.mean(values**2)))
        elif kind in ("nees", "mapped_nees", "nis"):
            yield name, float(np.exp(np.mean(np.log(values))))
        else:
            yield name, float(np.mean(values))


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
