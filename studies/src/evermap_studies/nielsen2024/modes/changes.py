"""What moved, when, and how surely: read off the modes that were selected."""

from __future__ import annotations

import numpy as np

from evermap.types import ChangeKind, MapChange
from evermap_studies.nielsen2024.modes.alternation import Explanation
from evermap_studies.nielsen2024.selectors.chain import ModeChain
from evermap_studies.nielsen2024.selectors.inference import smoothed


def switches(found: Explanation, chain: ModeChain) -> tuple[MapChange, ...]:
    """Every switch between the modes of consecutive detections of a landmark, and first of all from the prior map's.

    The probability is a lower bound, from the forward-backward marginals at both ends: that the landmark was in the one
    mode before and in the other after is at least the sum of both probabilities less one.

    Returns:
        One change a switch, by row of landmark and time; stamps on the problem's clock.
    """
    looks = found.looks
    if not len(looks.several):
        return ()
    held = np.exp(smoothed(looks.evidence, chain).log_smoothed)
    changes: list[MapChange] = []
    for landmark, begin, end in zip(looks.several, looks.evidence.first[:-1], looks.evidence.first[1:], strict=True):
        hits = begin + np.flatnonzero(looks.hit[begin:end])
        column = found.selection.indicator[hits]
        place = looks.table[landmark]
        if found.problem.mapped[landmark] and place[column[0]] != landmark:
            certain = float(held[hits[0], column[0]])
            changes.append(_moved(found, landmark, landmark, place[column[0]], np.nan, hits[0], certain))
        for k in np.flatnonzero(np.diff(column)):
            before, after = hits[k], hits[k + 1]
            certain = float(held[before, column[k]] + held[after, column[k + 1]] - 1.0)
            stamp_s = looks.evidence.stamp_s[before]
            changes.append(_moved(found, landmark, place[column[k]], place[column[k + 1]], stamp_s, after, certain))
    return tuple(changes)


def _moved(
    found: Explanation, landmark: int, from_: int, to: int, stamp_from_s: float, after: int, probability: float
) -> MapChange:
    """One landmark from one place to another, seen there first at the look `after`."""
    at = found.estimate.landmark
    dx, dy = (at[to] - at[from_]).tolist()
    return MapChange(
        landmark_ids=(int(landmark),),
        kind=ChangeKind.MOVED,
        stamp_from_s=float(stamp_from_s),
        stamp_to_s=float(found.looks.evidence.stamp_s[after]),
        displacement_m=(dx, dy),
        rotation_rad=0.0,
        probability=max(0.0, min(1.0, probability)),
    )
