"""Do departures that were seen make false changes? Three days on a street of 24 cars and 12 vans.

On the first day some of the vans leave while the robot passes; all else stays. Before each later day a few leave and a
few come, unseen. A statement of a later day is right if it says what happened at its slot since the drive before, or
earlier where that was not yet told (late); a change is found if the next drive tells it. What left in view is not
counted: it was told on the spot. Where it was not, since something hid it, the map has it still (`kept`): a later day
tells it late.

    python -m benchmarks.street                        # 20 seeds, with 0, 2, 4 and 6 vans that leave; an hour
    python -m benchmarks.street --seeds 5 --leaving 4  # some
    python -m benchmarks.street --later back           # each later day driven the other way
    python -m benchmarks.street --later lane           # or in the other lane
    python -m benchmarks.street --set living.learn_lifetimes=false
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evermap.config import Config, with_overrides
from evermap.maps.living import EXISTS
from evermap.pipeline import run_session
from evermap.types import ChangeKind
from evermap_studies.worlds.parking import CAR, DAY_S, SPEED_MPS, STEP_S, VAN, Parking

N_SLOTS, N_VANS, DAYS = 36, 12, 3
LEAVE, COME = 2, 1
"""Cars or vans between two days."""
FIRST_S, EVERY_S, AHEAD_M = 9.0, 4.5, 24.0
"""When the first van leaves, how long after it the next, and how far ahead of the robot."""
EVER_S = 1e6
GOES, COMES = "left", "came"
KINDS = {ChangeKind.VANISHED: GOES, ChangeKind.APPEARED: COMES, ChangeKind.RETURNED: COMES}


class Way(NamedTuple):
    """How later days are driven: the other way, and how far left of the first day's lane."""

    back: bool = False
    aside_m: float = 0.0


WAYS = {"same": Way(), "back": Way(back=True), "lane": Way(aside_m=3.0), "both": Way(back=True, aside_m=3.0)}


def park_for_days(seed: int, n_leaving: int) -> Parking:
    """Return a street whose slots are all taken at first."""
    rng, street = np.random.default_rng(seed), Parking.of(seed, n_slots=N_SLOTS, class_names=(CAR, VAN))
    gone: dict[int, float] = {}
    for k in range(n_leaving):
        at_s = FIRST_S + EVERY_S * k
        ahead = min(int((at_s + AHEAD_M / SPEED_MPS) / STEP_S), len(street.path) - 1)
        away = np.linalg.norm(street.slot[:, :2] - street.path[ahead, :2], axis=1)
        away[list(gone)] = np.inf
        gone[int(np.argmin(away))] = at_s
    others = rng.permutation([slot for slot in range(N_SLOTS) if slot not in gone]).tolist()
    vans = {*gone, *others[: N_VANS - n_leaving]}
    rng.shuffle(others)
    came: list[tuple[int, float, int]] = []
    for day in range(1, DAYS):
        between_s = (day - 0.5) * DAY_S
        free = rng.permutation([slot for slot in gone if slot not in {one[0] for one in came}]).tolist()
        came += [(slot, between_s, int(rng.random() < N_VANS / N_SLOTS)) for slot in free[:COME]]
        gone |= dict.fromkeys((others.pop() for _ in range(LEAVE)), between_s)
    for slot in range(N_SLOTS):
        street.park(rng, slot, -EVER_S, gone.get(slot, EVER_S), int(slot in vans))
    for slot, from_s, class_id in came:
        street.park(rng, slot, from_s, EVER_S, class_id)
    return street


def score_street(seed: int, n_leaving: int, config: Config, later: Way = WAYS["same"]) -> Counter[str]:
    """Return the numbers of statements, of right ones, and of changes, over the later days.

    `lost` where a day is; `kept` is what left in view and is in the map; `departed` cars and vans left, of which
    `reported` are told, and `left_percent` is the sum of what the map believes of their presence afterwards;
    `stay_percent` the map's probability that a car stays for a day, at the end.
    """
    street, living, found = park_for_days(seed, n_leaving), None, Counter[str]()
    slots: dict[int, int] = {}
    owed: set[tuple[int, str]] = set()
    for day in range(DAYS):
        way = later if day else WAYS["same"]
        recording = street.drive(100 * seed + day, day * DAY_S, back=way.back, aside_m=way.aside_m)
        session = run_session(recording, living, config)
        living = session.living
        if day and not session.found:
            found["lost"] += 1
            continue
        known = living.landmarks()
        slots |= dict(zip(known.landmark_id.tolist(), street.find_slots(known.position_m[:, :2]).tolist(), strict=True))
        if not day:
            left = {one.slot for one in street.spells if 0.0 <= one.until_s < len(street.path) * STEP_S}
            kept = left & {slots[name] for name in known.landmark_id[known.p_exists >= EXISTS].tolist()}
            found["kept"], owed = len(kept), {(slot, GOES) for slot in kept}
            continue
        before, now = (street.standing(DAY_S * at + 60.0) for at in (day - 1, day))
        true = {(slot, GOES) for slot in before - now} | {(slot, COMES) for slot in now - before}
        true = {(slot, what) for slot, what in true if slot in street.find_passed(back=way.back)}
        told = [
            (slots[change.landmark_ids[0]], KINDS.get(change.kind, change.kind.value))
            for change in session.changes
            if change.kind is not ChangeKind.REPLACED
        ]
        replaced = [change.landmark_ids for change in session.changes if change.kind is ChangeKind.REPLACED]
        told += [(slots[name], what) for pair in replaced for name, what in zip(pair, (GOES, COMES), strict=True)]
        late = owed - true
        found.update(told=len(told), right=sum(one in true | late for one in told), true=len(true))
        found.update(found=len(true & set(told)), late=len(late & set(told)))
        owed = (true | late) - set(told)
        departed = {slot for slot, what in true if what == GOES}
        found.update(departed=len(departed), reported=sum((slot, GOES) in told for slot in departed))
        for slot in departed:
            mine = [slots.get(name) == slot for name in known.landmark_id.tolist()]
            found["left_percent"] += round(100.0 * known.p_exists[mine].max(initial=0.0))
        found.update(f"false {one[1]}" for one in told if one not in true | late)
    assert living is not None
    stay = living.lives.of(0, np.zeros(3)).stay
    found["streets"], found["stay_percent"] = 1, round(100.0 * float(np.exp(stay.log_survival(np.array([DAY_S]))[0])))
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Score streets and print a line for each number of vans that leave."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--leaving", type=int, nargs="+", default=[0, 2, 4, 6])
    parser.add_argument("--later", choices=WAYS, default="same", help="how later days are driven")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    chosen = parser.parse_args(arguments)
    config, total = with_overrides(Config(), ["living.accept=any", *chosen.overrides]), Counter[str]()
    for n_leaving in chosen.leaving:
        of_number = Counter[str]()
        for seed in range(chosen.first, chosen.first + chosen.seeds):
            of_number.update(score_street(seed, n_leaving, config, WAYS[chosen.later]))
        total.update(of_number)
        _print_row(f"{n_leaving} leave", of_number)
    _print_row("all", total)


def _print_row(name: str, of: Counter[str]) -> None:
    false = of["told"] - of["right"]
    print(
        f"{name}: {false} of {of['told']} statements false, {of['found']} of {of['true']} changes found;",
        f"{of['reported']} of {of['departed']} departures, believed there by {of['left_percent']} % in sum;",
        f"a car stays for a day with {of['stay_percent'] / max(of['streets'], 1):.1f} %",
        {key: count for key, count in of.items() if key.startswith(("false", "kept", "late", "lost"))},
        flush=True,
    )


if __name__ == "__main__":
    main()
