"""Looks at pairs of landmarks in masks of an image, as a segmentation of instances gives them.

What is on one body lies in one mask from wherever it is seen; what is not does so in one view at most, by chance. The
numbers of masks need hold within an image only, so that those of a tracker and those of each image say the same.
"""

from __future__ import annotations

import numpy as np

from evermap.slam.co_motion import BODY_M, LEAST_M, Reckoned
from evermap.slam.space.box_owners import Sights, count_places
from evermap.types import FloatArray, IntArray

VIEW = 0.5
"""Share of their range by which landmarks move, for the robot, until the view of them is another one."""
FEWEST_TOGETHER, MOST_BESIDE = 2, 8
"""Looks in one mask for a pair to be asked about; landmarks with which each in a mask is paired: bounds the work."""
MOST_OF_ALL, WIDE = 0.5, 3.0
"""Share of all landmarks that are on one body, at most; its length over `BODY_M`, from landmark to landmark, at most.
What has more, or is longer, is the scenery. Both were chosen after looking at yards whose walls are a mask.
"""


def see_masks(seen: Reckoned, mask: FloatArray, sensor: IntArray, others: IntArray) -> Sights:
    """Return looks at pairs of landmarks in an image: whether they lie in one mask.

    Two in no mask say nothing; one in a mask and another in none are apart.

    Args:
        seen: sightings (N,) of landmarks.
        mask: (N,) number of the mask in the image that each lies in, nan for none.
        sensor: (N,) that made the image.
        others: (P, 2) pairs to ask about, beside those that lie in one mask.

    Returns:
        Of each pair the landmark with the larger number, and as the thing the one with the smaller.
    """
    image = _number_images(seen, sensor)
    parts, none = list[Sights](), np.zeros(0, dtype=np.int64)
    pairs = np.vstack([_find_candidates(seen.landmark_id, image, mask), np.sort(others, axis=1)])
    for one, other in np.unique(pairs, axis=0).tolist():
        a, b = _match(seen.landmark_id, image, one, other)
        says = np.isfinite(mask[a]) | np.isfinite(mask[b])
        a, b = a[says], b[says]
        if not len(a):
            continue
        order = np.argsort(seen.stamp_s[a], kind="stable")
        a, b = a[order], b[order]
        own = np.hstack([seen.own[a], seen.own[b]])
        view = count_places(own, VIEW * float(np.median(np.linalg.norm(own, axis=1))))
        parts.append(Sights(np.full(len(a), other), np.full(len(a), one), view, seen.stamp_s[a], mask[a] == mask[b]))
    if not parts:
        return Sights(none, none, none, np.zeros(0), none == 1)
    return Sights(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def is_scenery(seen: Reckoned, sensor: IntArray, pairs: IntArray) -> bool:
    """Return whether pairs (P, 2), which make one body, are what is around: most of all landmarks, or too far apart."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    names, row = np.unique(pairs, return_inverse=True)
    if len(names) > MOST_OF_ALL * len(np.unique(seen.landmark_id)):
        return True
    image, apart_m = _number_images(seen, sensor), list[float]()
    for one, other in pairs.tolist():
        a, b = _match(seen.landmark_id, image, one, other)
        apart_m.append(max(float(np.median(np.linalg.norm(seen.own[a] - seen.own[b], axis=1))), LEAST_M))
    begin, end = row.reshape(-1, 2).T
    graph = csr_array((np.array(apart_m), (begin, end)), shape=(len(names), len(names)))
    far = int(np.argmax(dijkstra(graph, directed=False, indices=[0])))
    return bool(dijkstra(graph, directed=False, indices=[far]).max() > WIDE * BODY_M)


def _match(landmark_id: IntArray, image: IntArray, one: int, other: int) -> tuple[IntArray, IntArray]:
    """Rows of sightings, in order of landmarks, of two of these in the same images."""
    i, j = (np.arange(*np.searchsorted(landmark_id, [name, name + 1])) for name in (one, other))
    _, a, b = np.intersect1d(image[i], image[j], return_indices=True)
    return i[a], j[b]


def _number_images(seen: Reckoned, sensor: IntArray) -> IntArray:
    """(N,) number of the image of each sighting: of one frame and one sensor."""
    return np.unique(np.column_stack([seen.frame, sensor]), axis=0, return_inverse=True)[1].ravel()


def _find_candidates(landmark_id: IntArray, image: IntArray, mask: FloatArray) -> IntArray:
    """(P, 2) landmarks, the smaller number first, that lay in one mask in some looks."""
    rows = np.flatnonzero(np.isfinite(mask))
    rows = rows[np.lexsort((landmark_id[rows], mask[rows], image[rows]))]
    found = [np.zeros((0, 2), dtype=np.int64)]
    for step in range(1, min(MOST_BESIDE, len(rows) - 1) + 1):
        a, b = rows[:-step], rows[step:]
        same = (image[a] == image[b]) & (mask[a] == mask[b]) & (landmark_id[a] < landmark_id[b])
        found.append(np.column_stack([landmark_id[a], landmark_id[b]])[same])
    pairs, count = np.unique(np.vstack(found), axis=0, return_counts=True)
    return pairs[count >= FEWEST_TOGETHER]
