"""Scores of tracked boxes: the protocol of AB3DMOT (overlap in space, recall swept), and HOTA and IDF1 by TrackEval.

Labels are only inside the image. What KITTI does not count (neighbouring classes, truncated or hardly visible objects,
boxes lower than 25 px) is neither right nor wrong, and so is what lies outside the image and matches no label.
"""

from __future__ import annotations

import contextlib
import io
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from evermap.types import BoolArray, FloatArray, IntArray

LEAST_OVERLAP = 0.25
N_RECALLS = 40
MOST_OCCLUDED, MOST_TRUNCATED, LEAST_PX = 2, 0, 25.0


class Judged(NamedTuple):
    """A frame of one class: G labels and T tracks.

    Attributes:
        label: (G,) ids; counted: (G,) whether a label counts.
        track: (T,) ids; excused: (T,) whether a track is no mistake where it matches nothing.
        overlap: (G, T) intersection over union in space.
    """

    label: IntArray
    counted: BoolArray
    track: IntArray
    excused: BoolArray
    overlap: FloatArray


Sequences = list[list[Judged]]


class Clear(NamedTuple):
    """Counts of the CLEAR metrics, and the overlap of what matched."""

    labels: int
    hits: int
    misses: int
    false: int
    switches: int
    fragments: int
    overlap: float
    scores: list[float]

    @property
    def mota(self) -> float:
        return 1.0 - (self.misses + self.false + self.switches) / max(self.labels, 1)

    @property
    def motp(self) -> float:
        return self.overlap / max(self.hits, 1)

    def smota(self, recall: float) -> float:
        """MOTA scaled to what is possible at a recall."""
        wrong = self.misses + self.false + self.switches - (1.0 - recall) * self.labels
        return float(np.clip(1.0 - wrong / (recall * self.labels), 0.0, 1.0))


def clear(sequences: Sequences, mean_score: list[dict[int, float]], least: float) -> Clear:
    """Count what is right and wrong of the tracks whose mean score is at least `least`."""
    n = np.zeros(6, dtype=np.int64)
    overlap, scores = 0.0, []
    for frames, score in zip(sequences, mean_score, strict=True):
        matched: dict[int, list[tuple[int, bool]]] = {}
        for f in frames:
            kept = np.array([score[i] >= least for i in f.track.tolist()], dtype=np.bool_)
            iou = f.overlap[:, kept]
            fits = iou >= LEAST_OVERLAP
            rows, columns = linear_sum_assignment(np.where(fits, 1.0 - iou, 1e9))
            pairs = [(g, t) for g, t in zip(rows.tolist(), columns.tolist(), strict=True) if fits[g, t]]
            of = dict(pairs)
            ids, free = f.track[kept], set(range(iou.shape[1])) - set(of.values())
            for g in range(len(f.label)):
                found = int(ids[of[g]]) if g in of else -1
                matched.setdefault(int(f.label[g]), []).append((found, bool(f.counted[g])))
                if not f.counted[g]:
                    continue
                n[0] += 1
                n[1 if g in of else 2] += 1
                if g in of:
                    overlap += float(iou[g, of[g]])
                    scores.append(score[found])
            n[3] += sum(not f.excused[kept][t] for t in free)
        for way in matched.values():
            n[4:] += _switches(way)
    return Clear(*n.tolist(), overlap, scores)


def _switches(way: list[tuple[int, bool]]) -> tuple[int, int]:
    """Identity switches and fragments of one label, as KITTI counts them: frames that do not count forget."""
    if not any(counted for _, counted in way):
        return 0, 0
    g, switches, fragments = [found for found, _ in way], 0, 0
    last = g[0]
    for k in range(1, len(g)):
        if not way[k][1]:
            last = -1
            continue
        if last not in (-1, g[k]) and g[k] != -1 and g[k - 1] != -1:
            switches += 1
        ends = k == len(g) - 1
        if g[k - 1] != g[k] and last != -1 and g[k] != -1 and (ends or g[k + 1] != -1):
            fragments += 1
        if g[k] != -1:
            last = g[k]
    return switches, fragments


def thresholds(scores: list[float], n_labels: int) -> list[tuple[float, float]]:
    """Return (score, recall) at which recall comes nearest to each of 40 steps, without recall zero."""
    ordered = sorted(scores, reverse=True)
    found, recall = [], 0.0
    for i, score in enumerate(ordered):
        left = (i + 1) / n_labels
        right = (i + 2) / n_labels if i < len(ordered) - 1 else left
        if right - recall < recall - left and i < len(ordered) - 1:
            continue
        found.append((score, recall))
        recall += 1.0 / N_RECALLS
    return found[1:]


def swept(sequences: Sequences, mean_score: list[dict[int, float]]) -> dict[str, Any]:
    """sAMOTA, AMOTA, AMOTP over recall; the others where MOTA is best; and MOTA over recall, the `curve`."""
    everything = clear(sequences, mean_score, -np.inf)
    steps = [
        (recall, score, clear(sequences, mean_score, score))
        for score, recall in thresholds(everything.scores, everything.labels)
    ]
    score, best = max(((s, found) for _, s, found in steps), key=lambda pair: pair[1].mota, default=(0.0, everything))
    return {
        "sAMOTA": sum(found.smota(recall) for recall, _, found in steps) / N_RECALLS,
        "AMOTA": sum(found.mota for _, _, found in steps) / N_RECALLS,
        "AMOTP": sum(found.motp for _, _, found in steps) / N_RECALLS,
        **told(best),
        "threshold": score,
        "curve": [[recall, found.mota] for recall, _, found in steps],
    }


def told(found: Clear) -> dict[str, float]:
    """The CLEAR metrics of one answer."""
    return {
        "MOTA": found.mota, "MOTP": found.motp, "IDS": found.switches, "FRAG": found.fragments,
        "FP": found.false, "FN": found.misses,
    }  # fmt: skip


def identities(sequences: Sequences) -> dict[str, float]:
    """HOTA (of its parts DetA and AssA, too) and IDF1 by TrackEval, overlap in space; what is excused is left out."""
    from trackeval.metrics import HOTA, Identity

    quiet = io.StringIO()
    with contextlib.redirect_stdout(quiet):
        hota, identity = HOTA(), Identity({"THRESHOLD": LEAST_OVERLAP, "PRINT_CONFIG": False})
        data = {str(k): _for_trackeval(frames) for k, frames in enumerate(sequences)}
        data = {k: one for k, one in data.items() if one["num_gt_dets"] + one["num_tracker_dets"] > 0}
        if not data:
            return dict.fromkeys(("HOTA", "DetA", "AssA", "IDF1"), 0.0)
        by_hota = hota.combine_sequences({k: hota.eval_sequence(one) for k, one in data.items()})
        by_id = identity.combine_sequences({k: identity.eval_sequence(one) for k, one in data.items()})
    means = {name: float(np.mean(by_hota[name])) for name in ("HOTA", "DetA", "AssA")}
    return means | {"IDF1": float(by_id["IDF1"])}


def _for_trackeval(frames: list[Judged]) -> dict[str, Any]:
    """A sequence as TrackEval takes it: labels that do not count are removed with the tracks that match them."""
    labels, tracks, similar = [], [], []
    for f in frames:
        fits = f.overlap >= LEAST_OVERLAP
        rows, columns = linear_sum_assignment(np.where(fits, 1.0 - f.overlap, 1e9))
        right = fits[rows, columns]
        drop = f.excused.copy()
        drop[columns[right]] = ~f.counted[rows[right]]
        labels.append(f.label[f.counted])
        tracks.append(f.track[~drop])
        similar.append(f.overlap[f.counted][:, ~drop])
    label_ids, label = np.unique(np.concatenate(labels), return_inverse=True)
    track_ids, track = np.unique(np.concatenate(tracks), return_inverse=True)
    return {
        "num_gt_ids": len(label_ids),
        "num_tracker_ids": len(track_ids),
        "num_gt_dets": len(label),
        "num_tracker_dets": len(track),
        "gt_ids": np.split(label, np.cumsum([len(one) for one in labels])[:-1]),
        "tracker_ids": np.split(track, np.cumsum([len(one) for one in tracks])[:-1]),
        "similarity_scores": similar,
    }
