"""Is the car where one stood that one, or another? Days on a street on which cars and vans come and go, beside truth.

For each box that stands where one stood a drive before: what is said of it, in classes of the stated probability that
it is another one, the truth beside it. One that is told as the same counts as 0.

    python -m benchmarks.same_or_other --seeds 10           # as many wrong sizes as the settings say
    python -m benchmarks.same_or_other --seeds 10 --odd 0   # a detector that always sees the right size

How many boxes are seen with a wrong size, a drive long, is a setting (`living.boxes.odd_share`, in either of two
drives): in one session that looks like others that took their places. Where a detector sees fewer, the probability of
another one is too low.
"""

from __future__ import annotations

import argparse
import itertools
from collections import Counter
from collections.abc import Sequence

import numpy as np

import evermap as em
from evermap.config import BoxesConfig
from evermap.types import ChangeKind
from evermap_studies.worlds.parking import USUAL, StreetConfig, simulate_street

EDGES = (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
WITHIN_S = 20.0
"""After the start of a drive: what stands then is what it meets."""
Row = tuple[bool, float]


def score_street(config: StreetConfig, seed: int) -> tuple[list[Row], Counter[str]]:
    """Return whether each box is another one, and the probability that was told (0: it goes on); and counts."""
    run, living, last = simulate_street(config, seed), None, dict[int, int]()
    known = dict[int, int]()
    rows, counts = list[Row](), Counter[str]()
    for drive in run.drives:
        session = em.run_session(drive, living, em.Config(living={"accept": "any"}))
        living = session.living
        if not session.found:
            counts["lost"] += 1
            continue
        at_s = float(drive.frames.stamp_s[0]) + WITHIN_S
        now = {one.slot: k for k, one in enumerate(run.street.spells) if one.from_s <= at_s < one.until_s}
        marks = living.landmarks()
        slot = dict(
            zip(marks.landmark_id.tolist(), run.street.find_slots(marks.position_m[:, :2]).tolist(), strict=True)
        )
        replaced = {one.landmark_ids[1]: one.probability for one in session.changes if one.kind is ChangeKind.REPLACED}
        facts = Counter(
            slot[one.landmark_ids[0]]
            for one in session.changes
            if one.kind in (ChangeKind.VANISHED, ChangeKind.APPEARED, ChangeKind.RETURNED)
        )
        counts["two facts"] += sum(count > 1 for count in facts.values())
        stands = {
            slot[name]: name for name, p in zip(marks.landmark_id.tolist(), marks.p_exists, strict=True) if p >= 0.5
        }
        for one, name in stands.items():
            if one not in now or one not in last or one not in known:
                continue
            if name in replaced:
                rows.append((now[one] != last[one], replaced[name]))
            elif known[one] == name:
                rows.append((now[one] != last[one], 0.0))
            else:
                counts["told otherwise"] += 1
        last, known = now, stands
    return rows, counts


def main(arguments: Sequence[str] | None = None) -> None:
    """Score streets and print a line for each class of probability."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--days", type=int, default=5)
    parser.add_argument("--odd", type=float, default=0.5 * BoxesConfig().odd_share, help="share of wrong sizes")
    chosen = parser.parse_args(arguments)
    rows, counts = list[Row](), Counter[str]()
    config = StreetConfig(days=chosen.days, faults=USUAL._replace(odd=chosen.odd))
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        more, others = score_street(config, seed)
        rows += more
        counts.update(others)
    table = np.array(rows, dtype=np.float64).reshape(-1, 2)
    print("p of another one   boxes   mean p   true share")
    for low, high in itertools.pairwise(EDGES):
        mine = table[(table[:, 1] >= low) & ((table[:, 1] < high) | (high == 1.0))]
        if len(mine):
            print(f"{low:8.2f} to {high:.2f} {len(mine):8d} {mine[:, 1].mean():8.3f} {mine[:, 0].mean():10.3f}")
    print(dict(counts), flush=True)


if __name__ == "__main__":
    main()
