"""Looks sorted into the frames of every clique, and what each frame says for each of its sites."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.existence.site_chains import Chains
from evermap.existence.site_records import SiteLooks
from evermap.sensing.sightlines import Lines
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Frames:
    """F frames, by clique and time; the last of every clique is the end of the session, at which nothing is looked at.

    Attributes:
        clique, stamp_s: (F,).
        is_look: (F,) False for the ends.
        first: (C + 1,) frames of clique c are `first[c]` to `first[c + 1]`.
        order: (N,) rows of the looks, by frame and site.
        of_look: (N,) frame of each look, in that order.
    """

    clique: IntArray
    stamp_s: FloatArray
    is_look: BoolArray
    first: IntArray
    order: IntArray
    of_look: IntArray

    @classmethod
    def of(cls, looks: SiteLooks, n_cliques: int, until_s: float) -> Frames:
        """The frames of a session that ends at `until_s`."""
        order = np.lexsort((looks.site, looks.stamp_s, looks.clique))
        clique, stamp = looks.clique[order], looks.stamp_s[order]
        opens = np.append(True, (np.diff(clique) != 0) | (np.diff(stamp) != 0))[: len(order)]
        clique = np.append(clique[opens], np.arange(n_cliques))
        stamp = np.append(stamp[opens], np.full(n_cliques, until_s))
        by_clique = np.argsort(clique, kind="stable")  # those of a clique are in order already, its end last
        is_look = (by_clique < np.count_nonzero(opens)).astype(np.bool_)
        first = np.searchsorted(clique[by_clique], np.arange(n_cliques + 1)).astype(np.int64)
        of_look = np.flatnonzero(is_look)[np.cumsum(opens) - 1]
        return cls(clique[by_clique], stamp[by_clique], is_look, first, order, of_look)

    def __len__(self) -> int:
        return len(self.clique)


@dataclass(frozen=True, slots=True)
class Said:
    """What F frames say of W seats.

    Attributes:
        log_ratio: (F, W) log likelihood of each seat, less that of being away.
        n_hits, n_misses: (F, W) detections and misses of its places.
        expected: (F, W) mean number of detections, had the clique been there.
    """

    log_ratio: FloatArray
    n_hits: IntArray
    n_misses: IntArray
    expected: FloatArray


def said_by(
    frames: Frames,
    looks: SiteLooks,
    chains: Chains,
    lines: Lines,
    *,
    p_false: float,
    p_occluded: float,
    occluded_s: float,
    use_misses: bool,
) -> Said:
    """What every frame says; arguments as those of `sites.follow_sites`."""
    from evermap.existence.site_kernels import frame_evidence

    site, key = looks.site[frames.order], looks.key[frames.order]
    n_lines = max(len(lines.hits), 1)
    pair, slot = np.unique(site * n_lines + key, return_inverse=True)  # lines of sight to each site learn by themselves
    p_free, hits, misses = (np.asarray(column, dtype=np.float64)[pair % n_lines] for column in lines[:3])
    shape = len(frames), chains.width
    n_hits, n_misses = np.zeros((2, *shape), dtype=np.int64)
    said = Said(np.zeros(shape), n_hits, n_misses, np.zeros(shape))
    frame_evidence(
        np.searchsorted(frames.of_look, np.arange(len(frames) + 1)),
        frames.clique,
        frames.stamp_s,
        slot.ravel(),
        chains.row_of_site[site] - chains.first[looks.clique[frames.order]],
        np.asarray(looks.hit, dtype=np.bool_)[frames.order],
        p_free,
        hits,
        misses,
        float(lines.p_blocked),
        p_false,
        p_occluded,
        occluded_s,
        use_misses,
        said.log_ratio,
        said.n_hits,
        said.n_misses,
        said.expected,
    )
    return said
