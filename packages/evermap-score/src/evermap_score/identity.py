"""Identity over sessions: IDF1 and HOTA, with each instant as a frame.

Sources: Ristani et al., Performance measures and a data set for multi-target, multi-camera tracking, ECCV Workshops
2016 (IDF1); Luiten et al., HOTA: a higher order metric for evaluating multi-object tracking, IJCV 2021.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evermap_score.episodes import Episodes, FloatArray, IntArray, TextArray
from evermap_score.matching import World, agree_classes, distances_m
from evermap_score.metric import Metric, f1_of, metric_of_rows

ALPHAS = np.arange(1, 20) * 0.05
"""Thresholds of the similarity in HOTA: .05, .1, ..., .95."""


@dataclass(frozen=True)
class IdentityFrame:
    """What is there at one instant.

    Attributes:
        truth: indices of landmarks of the truth (n,).
        estimate: indices of landmarks of the estimate (m,).
        similarity: between 0 and 1, (n, m).
    """

    truth: IntArray
    estimate: IntArray
    similarity: FloatArray


def make_frames(world: World, estimate: Episodes) -> tuple[list[IdentityFrame], TextArray, TextArray]:
    """Return a frame for each instant, and the ids that its indices are of: of the truth, of the estimate.

    The similarity of two points is 1 - d / (2 match_m), 0 beyond: .5 at the distance of Khronos. Names do not matter,
    only whether one of the estimate stays with one of the truth. At each instant the map of that robot time is asked.
    """
    rules = world.rules
    names, of = np.unique(world.truth.landmark_id), np.unique(estimate.landmark_id)
    frames = []
    for stamp_s in world.instants_s.tolist():
        truth = world.truth.state_at(stamp_s)
        stated = estimate.select_map(stamp_s).state_at(stamp_s, rules.present_p)
        away = distances_m(truth.position_m[:, : rules.dim], stated.position_m[:, : rules.dim])
        similarity = np.where(
            agree_classes(truth.class_id, stated.class_id), np.maximum(1.0 - away / (2.0 * rules.match_m), 0.0), 0.0
        )
        frames.append(
            IdentityFrame(
                np.searchsorted(names, truth.landmark_id).astype(np.int64),
                np.searchsorted(of, stated.landmark_id).astype(np.int64),
                similarity,
            )
        )
    return frames, names, of


def pair_identities(frames: Sequence[IdentityFrame], n_truth: int, n_estimate: int) -> dict[int, int]:
    """Return for each landmark of the truth the one of the estimate with which most frames agree, one to one.

    A frame agrees where the similarity is .5 or more. This is the assignment with the least IDFP + IDFN.
    """
    from scipy.optimize import linear_sum_assignment

    agree = np.zeros((n_truth, n_estimate))
    for frame in frames:
        np.add.at(agree, np.ix_(frame.truth, frame.estimate), frame.similarity >= 0.5)
    rows, columns = linear_sum_assignment(-agree)
    return {int(row): int(column) for row, column in zip(rows, columns, strict=True) if agree[row, column] > 0}


def identity_metrics(world: World, estimate: Episodes) -> list[Metric]:
    """Return IDF1 and HOTA with its parts, detection and association accuracy.

    In the bootstrap pairs, and the association accuracy of each pair, stay as they are in the whole.
    """
    frames, names, of = make_frames(world, estimate)
    pairs = pair_identities(frames, len(names), len(of))
    rows: list[tuple[int, str, tuple[float, float, float]]] = []
    for k, frame in enumerate(frames):
        at = {int(landmark): row for row, landmark in enumerate(frame.estimate.tolist())}
        used = set()
        for row, landmark in enumerate(frame.truth.tolist()):
            column = at.get(pairs.get(landmark, -1))
            agrees = column is not None and bool(frame.similarity[row, column] >= 0.5)
            if agrees:
                used.add(column)
            rows.append((k, str(names[landmark]), (float(agrees), 0.0, float(not agrees))))
        rows += [
            (k, str(of[each]), (0.0, 1.0, 0.0)) for column, each in enumerate(frame.estimate.tolist())
            if column not in used
        ]  # fmt: skip
    items = hota_items(frames, names, of)
    width = 4 * len(ALPHAS)
    return [
        metric_of_rows("identity/idf1", "", rows, 3, of_sums=f1_of(0, 1, 2)),
        metric_of_rows("identity/hota", "", items, width, of_sums=_hota),
        metric_of_rows("identity/hota_detection", "", items, width, of_sums=_detection_accuracy),
        metric_of_rows("identity/hota_association", "", items, width, of_sums=_association_accuracy),
    ]


def hota_items(
    frames: Sequence[IdentityFrame], names: TextArray, of: TextArray
) -> list[tuple[int, str, tuple[float, ...]]]:
    """Return for each detection (frame, landmark, values): by threshold TP, FN, FP, and A(c) of a TP.

    In each frame the pairs are those with the largest sum of similarities, weighted by how much of their time two
    landmarks are together, which is what HOTA maximises; A(c) = TPA / (TPA + FNA + FPA), section 5 of the paper.
    """
    from scipy.optimize import linear_sum_assignment

    together = np.zeros((len(names), len(of)))
    count_truth, count_estimate = np.zeros(len(names)), np.zeros(len(of))
    for frame in frames:
        below = frame.similarity.sum(0)[None, :] + frame.similarity.sum(1)[:, None] - frame.similarity
        share = np.divide(frame.similarity, below, out=np.zeros_like(below), where=below > 1e-12)
        np.add.at(together, np.ix_(frame.truth, frame.estimate), share)
        np.add.at(count_truth, frame.truth, 1.0)
        np.add.at(count_estimate, frame.estimate, 1.0)
    jaccard = together / np.maximum(count_truth[:, None] + count_estimate[None, :] - together, 1e-12)
    matched = []
    agree = np.zeros((len(ALPHAS), len(names), len(of)))
    for frame in frames:
        rows, columns = linear_sum_assignment(-jaccard[np.ix_(frame.truth, frame.estimate)] * frame.similarity)
        # an epsilon as in TrackEval: a similarity that is the threshold is a match
        over = frame.similarity[rows, columns][None, :] >= ALPHAS[:, None] - 1e-12
        matched.append((rows, columns, over))
        for a in range(len(ALPHAS)):
            agree[a, frame.truth[rows[over[a]]], frame.estimate[columns[over[a]]]] += 1.0
    accuracy = agree / np.maximum(count_truth[None, :, None] + count_estimate[None, None, :] - agree, 1.0)
    items: list[tuple[int, str, tuple[float, ...]]] = []
    for k, (frame, (rows, columns, over)) in enumerate(zip(frames, matched, strict=True)):
        values = np.zeros((len(frame.truth), 4, len(ALPHAS)))
        values[:, 1] = 1.0
        false = np.zeros((len(frame.estimate), 4, len(ALPHAS)))
        false[:, 2] = 1.0
        for row, column, good in zip(rows, columns, over.T, strict=True):
            values[row, 0], values[row, 1] = good, ~good
            values[row, 3] = good * accuracy[:, frame.truth[row], frame.estimate[column]]
            false[column, 2] = ~good
        items += [(k, str(names[one]), tuple(each.ravel())) for one, each in zip(frame.truth, values, strict=True)]
        items += [(k, str(of[one]), tuple(each.ravel())) for one, each in zip(frame.estimate, false, strict=True)]
    return items


def _accuracies(sums: FloatArray) -> tuple[FloatArray, FloatArray]:
    true, missed, false, association = sums.reshape(4, -1)
    detection = np.divide(true, true + missed + false, out=np.zeros_like(true), where=true + missed + false > 0.0)
    return detection, np.divide(association, true, out=np.zeros_like(true), where=true > 0.0)


def _hota(sums: FloatArray) -> float:
    detection, association = _accuracies(sums)
    return float(np.sqrt(detection * association).mean()) if sums.any() else float("nan")


def _detection_accuracy(sums: FloatArray) -> float:
    return float(_accuracies(sums)[0].mean()) if sums.any() else float("nan")


def _association_accuracy(sums: FloatArray) -> float:
    return float(_accuracies(sums)[1].mean()) if sums.any() else float("nan")
