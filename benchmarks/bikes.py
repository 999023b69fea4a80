"""Where shared bikes will be: the chain of places against a semi-Markov chain by place, on trips of a month.

    python -m benchmarks.bikes ../shared/data/citibike/trips_2015_09.csv.gz
    python -m benchmarks.bikes ../shared/data/citibike/trips_2015_09.csv.gz --hindsight

Trips of bikes with ids between docks. Where the next trip starts elsewhere, a truck moved the bike unseen. The first
two thirds of the time are learned from. Every three hours of the rest each bike that stands is asked for: its dock an
hour, a day and a week later, and its next trip (log probability of the ten minutes in which it leaves and of where to;
of staying, where no trip comes before the end). A dock counts where it is known: between a trip that ends there and
one that starts there.

The baseline has for each dock its own hazard by age, and its own shares of destinations, each with one pseudo-count of
what all docks have together; no hours. With `--hindsight` both are learned of all trips, too, those asked for among
them: no chain of this kind, however it learns from what was, can be expected to gain more.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.csv as pa_csv

from evermap.existence.places import AGE_EDGES_S, PlaceChain, PlaceStays, age_bins
from evermap.survival.hazard_regression import overlaps
from evermap.types import UNKNOWN, FloatArray, IntArray

HOUR_S, DAY_S = 3600.0, 86400.0
HORIZONS_S = {"1 h": HOUR_S, "1 d": DAY_S, "1 week": 7.0 * DAY_S}
EVERY_S = 3.0 * HOUR_S
LEARNED_PART = 2.0 / 3.0


@dataclass(frozen=True, slots=True)
class Trips:
    """N trips, by bike and time.

    Attributes:
        bike, start, end: (N,) bike and places.
        start_s, end_s: (N,) local wall time.
        n_places: number of docks.
    """

    bike: IntArray
    start: IntArray
    end: IntArray
    start_s: FloatArray
    end_s: FloatArray
    n_places: int


def read_trips(path: Path) -> Trips:
    """Read trips as the operator publishes them."""
    table = pa_csv.read_csv(path)
    names = [table.column(name).to_numpy() for name in ("Start Station ID", "End Station ID")]
    ids, index = np.unique(np.concatenate(names), return_inverse=True)
    start, end = np.split(index, 2)
    times = [
        table.column(name).cast("timestamp[s]").to_numpy().astype("datetime64[s]").astype(np.float64)
        for name in ("Start Time", "Stop Time")
    ]
    bike = table.column("Bike ID").to_numpy()
    order = np.lexsort((times[0], bike))
    return Trips(bike[order], start[order], end[order], times[0][order], times[1][order], len(ids))


def stays_until(trips: Trips, until_s: float) -> PlaceStays:
    """Return the stays between trips, as known at an instant.

    A bike whose next trip starts elsewhere left unseen, between two trips; of its stay there only the end is known.
    """
    known = np.flatnonzero(trips.end_s <= until_s)
    follows = np.append(trips.bike[known][1:] == trips.bike[known][:-1], False)
    last, one, two = known[~follows], known[follows], known[1:][follows[:-1]]
    leaves_s = np.maximum(trips.start_s[two], trips.end_s[one])
    seen = trips.start[two] == trips.end[one]
    lost, n = ~seen, len(last)
    never, nowhere = np.full(n, np.inf), np.full(n, UNKNOWN)
    return PlaceStays(
        place=np.concatenate([trips.end[one], trips.start[two][lost], trips.end[last]]),
        from_s=np.concatenate([trips.end_s[one], np.full(lost.sum(), np.nan), trips.end_s[last]]),
        until_s=np.concatenate([np.where(seen, leaves_s, trips.end_s[one]), leaves_s[lost], np.full(n, until_s)]),
        gone_s=np.concatenate([leaves_s, leaves_s[lost], never]),
        next_place=np.concatenate([np.where(seen, trips.end[two], trips.start[two]), trips.end[two][lost], nowhere]),
        n_places=trips.n_places,
    )


def by_place(stays: PlaceStays) -> PlaceChain:
    """Return the semi-Markov chain whose stays and moves are those of each place, without hours."""
    n, a = stays.n_places, len(AGE_EDGES_S) - 1
    timed = np.isfinite(stays.from_s)
    left = np.where(np.isfinite(stays.gone_s), 0.5 * (stays.until_s + stays.gone_s), stays.until_s)
    age = (left - stays.from_s)[timed]
    place, ended = stays.place[timed], stays.next_place[timed] != UNKNOWN
    spent = overlaps(np.zeros_like(age), age, AGE_EDGES_S[:-1])
    exposure, events = np.zeros((n, a)), np.zeros((n, a))
    np.add.at(exposure, place, spent)
    np.add.at(events, (place[ended], age_bins(age[ended])), 1.0)
    overall = (events.sum(0) + 0.5) / (exposure.sum(0) + 0.5 * exposure.sum() / events.sum())
    hazard = (events + 1.0) / (exposure + 1.0 / overall)
    counts = np.zeros((n, n))
    went = stays.next_place != UNKNOWN
    np.add.at(counts, (stays.place[went], stays.next_place[went]), 1.0)
    overall_share = (counts.sum(0) + 0.5) / (counts.sum() + 0.5 * n)
    share = counts + overall_share
    share /= share.sum(axis=1, keepdims=True)
    return PlaceChain(np.repeat(hazard[:, :, None], 48, axis=2), np.repeat(share[None], 48, axis=0))


def scores(trips: Trips, chains: dict[str, PlaceChain], from_s: float, until_s: float) -> dict[str, dict[str, float]]:
    """Return mean log losses by chain and question."""
    losses: dict[str, dict[str, list[float]]] = {name: {q: [] for q in (*HORIZONS_S, "next trip")} for name in chains}
    for now in np.arange(from_s, until_s, EVERY_S).tolist():
        past = np.flatnonzero(trips.end_s <= now)
        last = past[np.append(trips.bike[past][1:] != trips.bike[past][:-1], True)]
        following = np.minimum(last + 1, len(trips.bike) - 1)
        again = (following > last) & (trips.bike[following] == trips.bike[last])
        riding = again & (trips.start_s[following] <= now)
        moved = again & (trips.start[following] != trips.end[last])
        there = ~riding & ~moved
        last, following, again = last[there], following[there], again[there]
        place, age = trips.end[last], now - trips.end_s[last]
        horizons = {name: h for name, h in HORIZONS_S.items() if now + h <= until_s}
        for name, chain in chains.items():
            p = chain.forecast(place, age, now, np.array(list(horizons.values()))) if horizons else None
            for h, (label, horizon) in enumerate(horizons.items()):
                assert p is not None
                for row, bike in enumerate(trips.bike[last].tolist()):
                    where = place_at(trips, bike, now + horizon)
                    if where != UNKNOWN:
                        losses[name][label].append(-float(np.log(p[row, h, where])))
            for row in range(len(last)):
                leaves = float(trips.start_s[following[row]]) if again[row] else until_s
                goes = int(trips.end[following[row]]) if again[row] else None
                losses[name]["next trip"].append(
                    -chain.log_leaving(int(place[row]), float(age[row]), now, leaves, goes)
                )
    return {name: {q: float(np.mean(x)) for q, x in of.items() if x} for name, of in losses.items()}


def place_at(trips: Trips, bike: int, at_s: float) -> int:
    """Return where a bike stands, `UNKNOWN` where it rides or was moved."""
    low, high = np.searchsorted(trips.bike, [bike, bike + 1])
    k = low + int(np.searchsorted(trips.end_s[low:high], at_s, side="right")) - 1
    if k < low or (k + 1 < high and (trips.start_s[k + 1] <= at_s or trips.start[k + 1] != trips.end[k])):
        return UNKNOWN
    return int(trips.end[k]) if k + 1 < high else UNKNOWN


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trips", type=Path)
    parser.add_argument("--train-days", type=float, help="instead of two thirds of the time")
    parser.add_argument("--hindsight", action="store_true", help="also chains of all trips, asked for or not")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    trips = read_trips(given.trips)
    first, last = float(trips.start_s.min()), float(trips.start_s.max())
    part = given.train_days * DAY_S if given.train_days else LEARNED_PART * (last - first)
    stays = stays_until(trips, first + part)
    chains = {"by place": by_place(stays), "evermap": PlaceChain.learn(stays)}
    if given.hindsight:
        every = stays_until(trips, last)
        chains |= {"by place, hindsight": by_place(every), "evermap, hindsight": PlaceChain.learn(every)}
    found = scores(trips, chains, first + part, last)
    if given.json:
        print(json.dumps(found))
        return 0
    for question in found["evermap"]:
        base = found["by place"][question]
        line = (f"{name} {of[question]:.4f} {1.0 - of[question] / base:+.1%}" for name, of in found.items())
        print(f"{question:<10}", *line, sep="  ")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
