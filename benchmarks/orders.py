"""Sessions of two robots that enter a map in other orders, one of them twice: is what the map tells the same?

    python -m benchmarks.orders                          # 60 random ones of the 720 orders of six sessions
    python -m benchmarks.orders --orders 720 --patrol-s 20
    python -m benchmarks.orders --without-identities     # half of the landmarks are anonymous
    python -m benchmarks.orders --worlds 50 --sessions 4 --orders 1 --patrol-s 90   # a late session in each of 50

Of every order: beliefs and places, what each session tells and what changed between any two instants, and what the
landmarks are called, each compared with the right order. Orders that begin alike share the file of their beginning, and
`run_session` is asked once for the same recording and the same map, to the last bit. With `--worlds` the orders of
every world are other ones, none the right one; a line each, and the sums.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

import evermap as em
from evermap import pipeline
from evermap.errors import DataError, InputError
from evermap.maps.diff import diff, story_of
from evermap.maps.store import MapStore, open_store
from evermap.runs.sessions import enter_session
from evermap.types import UNKNOWN, MapChange, Recording
from evermap_studies.sim import BuildingConfig, simulate_building

SESSIONS, ORDERS, PATROL_S = 6, 60, 35.0
TOLERANCE = 1e-6
"""Of numbers that two orders give: of probabilities, metres, radians and seconds."""

ANONYMOUS = em.Config(slam=em.Config().slam.model_copy(update={"unknown_ids": "empty"}))
"""Detections without an identity are of landmarks that have none."""

Story = dict[tuple[str, float], Any]


@dataclass
class Asked:
    """Answers of `run_session`, by what it was asked."""

    answers: dict[str, Any] = field(default_factory=dict)
    asked: int = 0
    run: Callable[..., Any] = pipeline.run_session

    def __call__(self, recording: Recording, living: Any = None, config: Any = None, **named: Any) -> Any:
        """Return the answer that it gives, or has given."""
        key = digest((recording, living, config))
        self.asked += 1
        if key not in self.answers:
            self.answers[key] = self.run(recording, living, config, **named)
        return self.answers[key]


def digest(value: Any) -> str:
    """Return a digest of values: of arrays by their bytes, of dataclasses by their fields."""
    total = hashlib.sha256()

    def add(item: Any) -> None:
        total.update(type(item).__name__.encode())
        if isinstance(item, np.ndarray):
            total.update(f"{item.dtype}{item.shape}".encode() + np.ascontiguousarray(item).tobytes())
        elif is_dataclass(item) and not isinstance(item, type):
            for part in fields(item):
                add(getattr(item, part.name))
        elif isinstance(item, dict):
            for key, part in item.items():
                add((key, part))
        elif isinstance(item, (tuple, list)):
            for part in item:
                add(part)
        else:
            total.update(repr(item).encode())

    add(value)
    return total.hexdigest()


def sessions_of(count: int, patrol_s: float, seed: int, *, anonymous: bool = False) -> list[Recording]:
    """Return sessions of two robots in a changing building; if so, every other landmark has no identity."""
    made = simulate_building(BuildingConfig(days=count, patrol_s=patrol_s), seed).sessions
    sessions = [replace(one, robot=f"robot {k % 2}", truth=None) for k, one in enumerate(made)]
    if not anonymous:
        return sessions
    return [
        replace(
            one,
            detections=replace(
                one.detections,
                landmark_id=np.where(one.detections.landmark_id % 2 == 1, UNKNOWN, one.detections.landmark_id),
            ),
        )
        for one in sessions
    ]


def tell(store: MapStore) -> Story:
    """Return what a map tells, by question and instant: beliefs, what each session tells, what changed since, names."""
    living = store.load()
    records = living.landmarks()
    name = [living.label(one) for one in records.landmark_id.tolist()]
    rows = np.column_stack([records.p_exists, records.position_m, records.covariance_m2.reshape(len(name), -1)])
    found: Story = {("believed", 0.0): sorted(zip(name, rows.tolist(), strict=True))}
    found["called", 0.0] = sorted(map(living.label, living.members.landmark_id.tolist()))
    names = living.landmark_names
    for one in story_of(store):
        found["told by", one.start_s] = sorted(_spoken(change.named(names)) for change in one.changes)
    for number in range(store.head() + 1):
        changes = sorted(_spoken(change.named(names)) for change in diff(store, number).changes)
        found["since", store.load(number).session_start_s] = changes
    return found


def _spoken(change: MapChange) -> tuple[str, list[str], list[float]]:
    spread = np.ravel(change.displacement_covariance_m2).tolist()
    numbers = (change.stamp_from_s, change.stamp_to_s, *change.displacement_m, change.rotation_rad, change.probability)
    counts = (change.n_hits, change.n_misses)
    return change.kind.value, list(change.labels), [*map(float, numbers), *map(float, counts), *spread]


def differences(wanted: Story, found: Story) -> list[str]:
    """Return which questions are answered otherwise than in the right order; those that both can answer."""
    return [str(key) for key in sorted(found) if key not in wanted or not _same(wanted[key], found[key])]


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, (list, tuple)):
        return type(a) is type(b) and len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, float):
        return bool(np.isclose(a, b, rtol=0.0, atol=TOLERANCE, equal_nan=True))
    return bool(a == b)


def compare(
    sessions: Sequence[Recording], orders: Sequence[tuple[int, ...]], config: em.Config | None = None
) -> dict[str, Any]:
    """Enter sessions in some orders, and compare what the maps tell with what the right order tells.

    Returns:
        How many orders, how many of them differ and in what, in how many a session was refused (it shares too little
        with those that came before it; all, where one is in the right order), and how often `run_session` was asked
        and run.
    """
    asked, right = Asked(run=pipeline.run_session), tuple(range(len(sessions)))
    files: dict[tuple[int, ...], bytes | None] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "site.evermap"

        def enter(order: tuple[int, ...]) -> bytes | None:
            if order not in files:
                before = enter(order[:-1]) if order[1:] else b""
                files[order] = None if before is None else _enter(path, before, sessions[order[-1]], config)
            return files[order]

        def story(order: tuple[int, ...]) -> Story | None:
            content = enter(order)
            if content is None:
                return None
            path.write_bytes(content)
            with open_store(path) as store:
                _enter_again(store, sessions[order[0]], config)
                return tell(store)

        pipeline.run_session = asked  # type: ignore[assignment]
        try:
            wanted = story(right)
            differing: dict[str, list[str]] = {}
            refused = 0
            if wanted is None:  # nothing to compare with
                wanted, orders, refused = {("called", 0.0): []}, [], len(orders)
            for order in sorted(orders):
                found = story(order)
                refused += found is None
                for key in [one for one in files if one != order[: len(one)] and one != right]:
                    del files[key]  # the next order begins otherwise
                if found is not None and (wrong := differences(wanted, found)):
                    differing[str(order)] = wrong
        finally:
            pipeline.run_session = asked.run
    told = sum(len(lines) for (question, _), lines in wanted.items() if question in ("told by", "since"))
    counts = {"orders": max(len(orders), refused), "refused": refused, "differing": differing, "changes": told}
    return {**counts, "landmarks": len(wanted["called", 0.0]), "asked": asked.asked, "run": len(asked.answers)}


def _enter(path: Path, before: bytes, recording: Recording, config: em.Config | None) -> bytes | None:
    """Return the file after a session; None where it is refused."""
    path.unlink(missing_ok=True)
    if before:
        path.write_bytes(before)
    with open_store(path, create=not before) as store:
        try:
            enter_session(store, recording, config).commit(store, config)
        except DataError:  # it does not fit yet, or with it a later one does not fit any more
            return None
    return path.read_bytes()


def _enter_again(store: MapStore, recording: Recording, config: em.Config | None) -> None:
    try:
        enter_session(store, recording, config)
    except InputError:
        return
    raise AssertionError(f"{recording.name} enters twice")


def orders_of(sessions: int, count: int, seed: int = 0, *, late: bool = False) -> list[tuple[int, ...]]:
    """Return random ones of all orders, or all; if `late`, never the right one."""
    every = list(permutations(range(sessions)))[int(late) :]
    if count >= len(every):
        return every
    return [every[k] for k in np.random.default_rng(seed).choice(len(every), count, replace=False)]


def late_in_worlds(
    worlds: Sequence[int], sessions: int, orders: int, patrol_s: float, *, anonymous: bool = False
) -> dict[str, Any]:
    """Compare wrong orders with the right one in worlds of these seeds, and print a line of each.

    Returns:
        The sums of `compare`; `differing` by the seed and the order.
    """
    total: dict[str, Any] = {"worlds": 0, "differing": {}}
    for seed in worlds:
        recordings = sessions_of(sessions, patrol_s, seed, anonymous=anonymous)
        found = compare(recordings, orders_of(sessions, orders, seed, late=True), ANONYMOUS if anonymous else None)
        wrong = found.pop("differing")
        print(json.dumps({"seed": seed, **found, "differing": wrong}), flush=True)
        total["differing"] |= {f"{seed}: {order}": what for order, what in wrong.items()}
        total |= {name: total.get(name, 0) + number for name, number in {"worlds": 1, **found}.items()}
    return total


def main() -> None:
    """Print the comparison as JSON; exit with 1 where an order differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=SESSIONS)
    parser.add_argument("--orders", type=int, default=ORDERS)
    parser.add_argument("--patrol-s", type=float, default=PATROL_S)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--worlds", type=int, default=0, help="seeds from --seed on, each with orders of its own")
    parser.add_argument("--without-identities", action="store_true")
    said = parser.parse_args()
    if said.worlds:
        seeds = range(said.seed, said.seed + said.worlds)
        found = late_in_worlds(seeds, said.sessions, said.orders, said.patrol_s, anonymous=said.without_identities)
    else:
        sessions = sessions_of(said.sessions, said.patrol_s, said.seed, anonymous=said.without_identities)
        found = compare(sessions, orders_of(said.sessions, said.orders), ANONYMOUS if said.without_identities else None)
    print(json.dumps(found, indent=1))
    raise SystemExit(bool(found["differing"]))


if __name__ == "__main__":
    main()
