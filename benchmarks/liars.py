"""One of five robots has something wrong with it: what does that do to the map that they share?

Five robots take turns in a simulated building (20 sessions), each of them calibrated anew in every session; the last
one's readings are falsified, or those of several. Precision and recall are those of the landmarks that the map believes
in after the first round, on average over the sessions, and so is the log loss of their existence.

    python -m benchmarks.liars                            # the table of docs/server-robots.md
    python -m benchmarks.liars --seeds 0 --lies nothing "ranges 10 %"
    python -m benchmarks.liars --seeds 0 1 2 3 4 5 --session-s 60 --liars 2 --lies "detects a third" "detects a seventh"
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.soak import entered, world
from evermap.config import Config, load_config
from evermap.types import Recording, rows_of

ROBOTS, SESSION_S, SESSIONS = 5, 120.0, 20
LIES = (
    "nothing",
    "bearings 6 degrees",
    "ranges 0.3 m",
    "detects a third",
    "sees 2.5 m",
    "misreads",
    "ranges 10 %",
    "ranges 5 %",
    "drifts",
    "another building",
    "detects a seventh",
)
RATES = {"detects a third": 0.35, "detects a seventh": 0.143}
"""Shares of the detections that are left."""


def lie(recording: Recording, kind: str, elsewhere: Recording, rng: np.random.Generator) -> Recording:
    """Return the recording of a robot with something wrong, one of `LIES`.

    Args:
        recording: what an honest one records.
        kind: what is wrong.
        elsewhere: a recording of another building, at the same time.
        rng: of what is wrong at random.

    Raises:
        KeyError: `kind` is not in `LIES`.
    """
    told = recording.detections
    if kind == "another building":
        return elsewhere
    if kind in RATES or kind == "sees 2.5 m":
        kept = rng.random(len(told)) < RATES[kind] if kind in RATES else told.range_m < 2.5
        return replace(recording, detections=rows_of(told, kept))
    if kind == "misreads":
        names, wrong = told.landmark_id.copy(), rng.random(len(told)) < 0.2
        names[wrong] = rng.choice(np.unique(names), np.count_nonzero(wrong))
        return replace(recording, detections=replace(told, landmark_id=names))
    into = (recording.frames.stamp_s[told.frame] - recording.frames.stamp_s[0]) / SESSION_S
    factor, longer, turned = {
        "nothing": (1.0, 0.0, 0.0),
        "bearings 6 degrees": (1.0, 0.0, 0.1),
        "ranges 0.3 m": (1.0, 0.3, 0.0),
        "ranges 10 %": (1.1, 0.0, 0.0),
        "ranges 5 %": (1.05, 0.0, 0.0),
        "drifts": (1.0 + 0.1 * into, 0.0, 0.26 * into),
    }[kind]
    wrong = replace(told, range_m=told.range_m * factor + longer, bearing_rad=told.bearing_rad + turned)
    return replace(recording, detections=wrong)


def scores(
    kind: str, seed: int, session_s: float = SESSION_S, liars: int = 1, config: Config | None = None
) -> tuple[float, float, float, float]:
    """Return precision, recall and log loss of the map after the first round, and the share of the liars' sessions that
    are set aside.
    """
    hours = SESSIONS * session_s / 3600.0
    honest, other = (world(hours, at, session_s=session_s, a_day=ROBOTS) for at in (seed, seed + 500))
    rng, lying = np.random.default_rng(seed), {ROBOTS - 1 - 2 * k for k in range(liars)}

    def told() -> Iterator[Recording]:
        for row, (recording, elsewhere) in enumerate(zip(honest, other, strict=True)):
            drive = lie(recording, kind, elsewhere, rng) if row % ROBOTS in lying else recording
            yield replace(drive, robot=f"robot {row % ROBOTS}")

    found = entered(told(), honest, config)
    told_wrong = [row for row in range(len(honest)) if row % ROBOTS in lying]
    apart = [row for row in told_wrong if row in found.set_aside or np.isnan(found.rmse_m[row])]
    shares = found.precision, found.recall, found.log_loss
    precision, recall, log_loss = (float(np.nanmean(share[ROBOTS:])) for share in shares)
    return precision, recall, log_loss, len(apart) / len(told_wrong)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line, with its arguments if none are given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--lies", choices=LIES, nargs="+", default=LIES)
    parser.add_argument("--session-s", type=float, default=SESSION_S)
    parser.add_argument("--liars", type=int, choices=(1, 2), default=1, help="robots of five")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of evermap")
    chosen = parser.parse_args(arguments)
    config = load_config(None, chosen.set)
    print("| what is wrong | seed | precision | recall | log loss of P(exists) | their sessions set aside |")
    print("|---|---:|---:|---:|---:|---:|")
    for kind in chosen.lies:
        for seed in chosen.seeds:
            *shares, aside = scores(kind, seed, chosen.session_s, chosen.liars, config)
            print(f"| {kind} | {seed} | {' | '.join(f'{one:.3f}' for one in shares)} | {aside:.0%} |", flush=True)


if __name__ == "__main__":
    main()
