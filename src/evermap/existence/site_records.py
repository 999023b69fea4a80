"""What the belief of a living map takes and gives: frozen dataclasses of arrays, and what is wrong with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.existence import checks
from evermap.sensing.sightlines import Lines
from evermap.survival.base import LifetimePrior
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class SiteLooks:
    """Places that were looked at: (N,) rows in any order, one for each place and frame.

    Attributes:
        stamp_s: of the frame; rows of one clique and stamp are one frame.
        clique: row of the clique, 0 to C - 1.
        site: row of the site the place belongs to, 0 to S - 1.
        key: row of its line of sight, 0 to K - 1.
        hit: whether it was detected.
    """

    stamp_s: FloatArray
    clique: IntArray
    site: IntArray
    key: IntArray
    hit: BoolArray

    def __len__(self) -> int:
        return len(self.stamp_s)


@dataclass(frozen=True, slots=True)
class SiteDynamics:
    """How S sites of C cliques are left and returned to.

    Attributes:
        stay: S lifetimes of a stay at each site.
        since_s: (S,) when the newest stay there began.
        absence: C lifetimes of the time away of each clique.
        away_since_s: (C,) when it went away, if it is away.
        p_hop: (C,) probability that who leaves a site stands at another site at once.
        return_share: (S,) probability that who turns up does so at this site, at most 1 in sum of a clique; the rest
            turns up at places that are not known, which is 'away'. One that hops from a site has the shares of the
            others and of unknown places, scaled to sum 1. 0 for a clique that never returns.
    """

    stay: tuple[LifetimePrior, ...]
    since_s: FloatArray
    absence: tuple[LifetimePrior, ...]
    away_since_s: FloatArray
    p_hop: FloatArray
    return_share: FloatArray


@dataclass(frozen=True, slots=True)
class SiteTrace:
    """What was said of cliques, frame by frame: (E,) rows by clique, then by time.

    Attributes:
        clique, stamp_s: which frame of which clique.
        n_hits, n_misses: at its most probable site.
        expected: mean number of detections, had it stood there.
        log_odds: of the frame for 'at one of its sites' against 'away' [nats].
        p_exists: probability that it stands at one of its sites, after the frame.
    """

    clique: IntArray
    stamp_s: FloatArray
    n_hits: IntArray
    n_misses: IntArray
    expected: FloatArray
    log_odds: FloatArray
    p_exists: FloatArray


@dataclass(frozen=True, slots=True)
class SiteBeliefs:
    """Beliefs of C cliques with S sites after a session of N looks.

    Attributes:
        p_here: (S,) probability that its clique stands at each site, at the end.
        p_stayed: (S,) part of it: that it has stood there since before the start.
        p_before: (S,) before the clique's first look; at the end where there was none.
        since_s: (S,) mean begin of the stay there, given that it stands there at the end.
        weight: (N,) probability that the clique stood at the looks' sites then, given all hits of the session. Misses
            are left out: whether they are due to the line of sight or to the clique is what is learned from them.
        log_evidence: (C,) log probability of all looks at a clique, less that of the same looks if it were away.
        trace: what every frame said.
    """

    p_here: FloatArray
    p_stayed: FloatArray
    p_before: FloatArray
    since_s: FloatArray
    weight: FloatArray
    log_evidence: FloatArray
    trace: SiteTrace


def check_sites(
    p_here: FloatArray,
    clique_of_site: IntArray,
    dynamics: SiteDynamics,
    looks: SiteLooks,
    lines: Lines,
    start_s: FloatArray,
    until_s: float,
    p_false: float,
    p_occluded: float,
    occluded_s: float,
) -> None:
    """Raise `InputError` for what cannot be."""
    n_cliques, n_sites, n_looks = len(dynamics.p_hop), len(p_here), len(looks)
    lengths: dict[str, tuple[Any, int]] = {
        "p_here": (p_here, n_sites), "clique_of_site": (clique_of_site, n_sites), "stay": (dynamics.stay, n_sites),
        "since_s": (dynamics.since_s, n_sites), "return_share": (dynamics.return_share, n_sites),
        "absence": (dynamics.absence, n_cliques), "away_since_s": (dynamics.away_since_s, n_cliques),
        "p_hop": (dynamics.p_hop, n_cliques), "clique": (looks.clique, n_looks), "site": (looks.site, n_looks),
        "key": (looks.key, n_looks), "hit": (looks.hit, n_looks), "misses": (lines.misses, len(lines.hits)),
        "p_free": (lines.p_free, len(lines.hits)),
    }  # fmt: skip
    for field, (column, n) in lengths.items():
        shape = (len(column),) if isinstance(column, tuple) else np.shape(column)
        if shape != (n,):
            raise InputError(f"shape {shape} instead of ({n},)", field=field)
    checks.check_rows(clique_of_site, n_cliques, twice=True, field="clique_of_site")
    checks.check_rows(looks.clique, n_cliques, twice=True, field="clique")
    checks.check_rows(looks.site, n_sites, twice=True, field="site")
    checks.check_rows(looks.key, len(lines.hits), twice=True, field="key")
    for field, values in (
        ("p_here", p_here),
        ("p_hop", dynamics.p_hop),
        ("return_share", dynamics.return_share),
        ("p_free", lines.p_free),
    ):
        checks.check_probability(np.asarray(values, dtype=np.float64), field)
    for field, summed in (("p_here", p_here), ("return_share", dynamics.return_share)):
        total = np.bincount(clique_of_site, summed, minlength=n_cliques)
        if (total > 1.0 + 1e-9).any():
            row = int(np.argmax(total))
            raise InputError(f"clique {row}: {total[row]} is more than 1 in sum", field=field)
    for field, stamps in (("since_s", dynamics.since_s), ("away_since_s", dynamics.away_since_s), ("start_s", start_s)):
        if not np.isfinite(stamps).all():
            raise InputError(f"row {int(np.argmin(np.isfinite(stamps)))}: no instant", field=field, hint="finite times")
    wrong = np.flatnonzero(clique_of_site[looks.site] != looks.clique)
    if wrong.size:
        raise InputError(f"row {wrong[0]}: site {looks.site[wrong[0]]} is of another clique", field="site")
    checks.check_times(looks.stamp_s, start_s[looks.clique], noun="look")
    last = max(np.max(looks.stamp_s, initial=-np.inf), np.max(start_s, initial=-np.inf))
    if not last <= until_s < np.inf:
        raise InputError(f"{until_s} s lies before the last look", field="until_s")
    if not 0.0 < p_false < 1.0:
        raise InputError(f"{p_false} is no probability between 0 and 1", field="p_false")
    if not 0.0 <= lines.p_blocked < 1.0:
        raise InputError(f"{lines.p_blocked} is no probability below 1", field="p_blocked")
    if not 0.0 <= p_occluded < 1.0:
        raise InputError(f"{p_occluded} is no probability below 1", field="p_occluded")
    if not 0.0 <= occluded_s < np.inf:
        raise InputError(f"{occluded_s} s is no time", field="occluded_s")
    for field, counts in (("hits", lines.hits), ("misses", lines.misses)):
        good = np.isfinite(counts) & (np.asarray(counts) > 0.0)
        if not good.all():
            row = int(np.argmin(good))
            raise InputError(f"row {row}: {counts[row]} is no pseudo count", field=field, hint="a number above 0")
