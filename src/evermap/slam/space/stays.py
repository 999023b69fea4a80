"""What stood among boxes without identity, as landmarks: by the ids of the tracks, with belief, heading and changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from evermap.slam.space.gauge import SIGMA_BEND, SIGMA_SCALE, Gauge
from evermap.tracking.run import TrackResult
from evermap.tracking.standing import Standing
from evermap.types import (
    UNKNOWN,
    ChangeKind,
    IntArray,
    Landmarks,
    MapChange,
    ParameterEstimate,
    SlamResult,
    landmark_id_of,
    rows_of,
)

TILT = 0.05
"""Boxes are upright to within this [rad]."""
WHEN_S = 0.5
"""When a thing came to rest, or left, is known to within this to both sides [s]."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """What is around the robot.

    Attributes:
        followed: the tracker's answer; None where nothing was seen often enough.
        standing: what of it stands, a row a box.
        gauge: errors that repeat themselves.
    """

    followed: TrackResult | None
    standing: Standing
    gauge: Gauge


def with_stays(
    result: SlamResult, traffic: Traffic, followed: TrackResult | None, known: int, rows: IntArray
) -> SlamResult:
    """Return the result with what stood under the ids of its tracks.

    Args:
        result: landmarks of ids from `known` on are stays.
        traffic: by which these were chosen.
        followed: the tracks along the estimated poses.
        known: the first id that is no landmark of the recording.
        rows: (K,) of the recording's detections that were used.
    """
    landmarks, track = result.landmarks, _tracks(traffic.standing, followed)
    identities, names = _identities(track, known)
    stay = landmarks.landmark_id - known
    ours = np.flatnonzero((stay >= 0) & (stay < len(identities)))
    stay, new = stay[ours], landmarks.landmark_id.copy()
    new[ours] = identities[stay]
    p_exists = landmarks.p_exists.copy()
    p_exists[ours] = traffic.standing.p_stay[stay]
    told = replace(landmarks, landmark_id=new, p_exists=p_exists, names={**landmarks.names, **names})
    if followed is not None and len(ours):
        told = _headed(told, ours, track[stay], followed)
    renamed = dict(zip(landmarks.landmark_id.tolist(), new.tolist(), strict=True))
    asked = np.array([renamed.get(one, one) for one in result.innovations.landmark_id.tolist()], dtype=np.int64)
    return replace(
        result,
        landmarks=rows_of(told, np.argsort(new, kind="stable")),
        innovations=replace(result.innovations, landmark_id=asked, detection=rows[result.innovations.detection]),
        parameters=(*result.parameters, *_parameters(traffic.gauge)),
        changes=(*result.changes, *_changes(traffic.standing, identities, names)),
        followed=followed,
    )


def _tracks(standing: Standing, followed: TrackResult | None) -> IntArray:
    """(S,) the track that most boxes of each stay are of."""
    found = standing.track.copy()
    if followed is None:
        return found
    for stay in range(len(found)):
        of = followed.track_of_detection[standing.stay == stay]
        of = of[of != UNKNOWN]
        found[stay] = np.bincount(of).argmax() if len(of) else found[stay]
    return found


def _identities(track: IntArray, known: int) -> tuple[IntArray, dict[int, str]]:
    """Ids (S,) of stays, and names: the second stay of one track is called '7#2'."""
    found, names, times = known + track, dict[int, str](), dict[int, int]()
    for stay, one in enumerate(track.tolist()):
        times[one] = times.get(one, 0) + 1
        if times[one] > 1:
            name = f"{known + one}#{times[one]}"
            found[stay] = landmark_id_of(name)
            names[int(found[stay])] = name
    return found, names


def _headed(landmarks: Landmarks, ours: IntArray, track: IntArray, followed: TrackResult) -> Landmarks:
    """Landmarks with the heading and the belief that their tracks had when they were seen there last."""
    count, tracks = len(landmarks), followed.tracks
    rotation = np.full((count, 4), np.nan) if landmarks.rotation is None else landmarks.rotation.copy()
    turned = np.full((count, 3, 3), np.nan)
    if landmarks.rotation_covariance is not None:
        turned[:] = landmarks.rotation_covariance
    p_exists = landmarks.p_exists.copy()
    first, last = (np.searchsorted(tracks.track_id, track, side=side) for side in ("left", "right"))
    for row, begin, end in zip(ours.tolist(), first.tolist(), last.tolist(), strict=True):
        if begin == end:
            continue
        seen = int(np.searchsorted(tracks.stamp_s[begin:end], landmarks.last_seen_s[row] + 1e-6))
        at = begin + max(seen - 1, 0)
        p_exists[row] *= tracks.p_exists[at]
        half = 0.5 * tracks.box[at, 3]
        rotation[row] = 0.0, 0.0, np.sin(half), np.cos(half)
        turned[row] = np.diag([TILT**2, TILT**2, tracks.box_variance[at, 3]])
    return replace(landmarks, p_exists=p_exists, rotation=rotation, rotation_covariance=turned)


def _parameters(gauge: Gauge) -> tuple[ParameterEstimate, ...]:
    """What odometry and detector repeat in error."""
    if not gauge.things:
        return ()
    given, none = gauge.stated is not None, float("nan")
    ranges, driven = (0.0, gauge.scale_sigma) if given else (gauge.scale_sigma, 0.0)
    return (
        ParameterEstimate(
            "range_scale", gauge.range_scale, ranges, 1.0, SIGMA_SCALE, "1", fixed=given,
            meaning="factor on ranges of boxes, by the odometry's metre",
        ),
        ParameterEstimate(
            "odometry_scale", gauge.odometry_scale, driven, 1.0, SIGMA_SCALE if given else none, "1", fixed=not given,
            meaning="factor on the odometry's way",
        ),
        ParameterEstimate(
            "odometry_bend_radpm", gauge.bend, gauge.bend_sigma, 0.0, SIGMA_BEND, "rad/m",
            meaning="angle that the odometry turns too little by the metre",
        ),
    )  # fmt: skip


def _changes(standing: Standing, identities: IntArray, names: Mapping[int, str]) -> tuple[MapChange, ...]:
    """What came to rest in view, and what left."""
    found = []
    for stay, identity in enumerate(identities.tolist()):
        hits = int(np.count_nonzero(standing.stay == stay))
        for kind, when in ((ChangeKind.APPEARED, standing.since_s), (ChangeKind.VANISHED, standing.until_s)):
            if np.isfinite(when[stay]):
                span, p = (float(when[stay] - WHEN_S), float(when[stay] + WHEN_S)), float(standing.p_stay[stay])
                n_hits = hits if kind is ChangeKind.APPEARED else 0
                change = MapChange((identity,), kind, *span, (np.nan,) * 3, 0.0, p, n_hits)
                found.append(change.named(names))
    return tuple(found)
