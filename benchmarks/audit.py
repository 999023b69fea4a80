"""What an audit costs and finds: a map of 500 entries, of which some are wrong, and a drive of 60 s.

    python -m benchmarks.audit                   # the plane and space, a line each
    python -m benchmarks.audit --only space --profile FILE

Five entries are moved by .05 to 1 m, one is turned, two are exchanged, one is taken away and one is not in the map; all
of them were seen at least ten times. CPU seconds are those of `audit_map` alone, with kernels compiled before.
"""

from __future__ import annotations

import argparse
import cProfile
import time
from dataclasses import dataclass, replace

import numpy as np

from evermap.cli.warmup import warm_up
from evermap.geometry import se3
from evermap.runs.audit.run import audit_map
from evermap.types import AnyRecording, Landmarks, is_in_space, rows_of
from evermap_studies.causes.drives import Make, Reading, as_recording, simulate

MAKES = {
    "plane": Make("reflectors", Reading.RANGE_BEARING, 8.0, 2.2, (0.02, 0.005), speed_mps=1.2, duration_s=60.0),
    "space": Make("racks", Reading.CORNERS, 6.0, 0.6, (0.3,), (0.03, 0.03, 0.03), speed_mps=1.2, duration_s=60.0),
}
OFF_M = (0.05, 0.1, 0.2, 0.5, 1.0)
OFTEN = 10


@dataclass(frozen=True, slots=True)
class Edited:
    """A drive, the map that it is audited with, and what is wrong in that: state by landmark."""

    recording: AnyRecording
    given: Landmarks
    wrong: dict[int, str]


def edit_map(make: Make, seed: int, off_m: tuple[float, ...] = OFF_M) -> Edited:
    """Return a drive in a map with mistakes."""
    drive = simulate(make, seed, in_map=True)
    recording, given = as_recording(drive), drive.places
    assert given is not None
    rng = np.random.default_rng([seed, 5])
    names, hits = np.unique(recording.detections.landmark_id, return_counts=True)
    chosen = rng.permutation(names[hits >= OFTEN])[: len(off_m) + 5]
    row = {int(name): k for k, name in enumerate(given.landmark_id)}
    position, wrong, dim = given.position_m.copy(), dict[int, str](), given.position_m.shape[1]
    for name, far in zip(chosen, off_m, strict=False):
        way = rng.normal(size=dim)
        position[row[int(name)]] += far * way / np.linalg.norm(way)
        wrong[int(name)] = "wrong"
    turned, one, other, gone, missing = map(int, chosen[len(off_m) :])
    rotation = None if given.rotation is None else given.rotation.copy()
    swap = [row[other], row[one]]
    position[[row[one], row[other]]] = position[swap]
    wrong |= {one: "exchanged", other: "exchanged", gone: "gone", missing: "missing"}
    if rotation is not None:
        rotation[[row[one], row[other]]] = rotation[swap]
        turn = se3.from_angles(np.radians([0.0, 0.0, 30.0]))
        rotation[row[turned]] = se3.compose(turn, np.append(np.zeros(3), rotation[row[turned]]))[3:]
        wrong[turned] = "wrong"
    given = replace(given, position_m=position, rotation=rotation)
    seen = recording.detections
    without: AnyRecording = replace(recording, detections=rows_of(seen, seen.landmark_id != gone))  # type: ignore[arg-type]
    return Edited(without, given[given.landmark_id != missing], wrong)


def measure(name: str, seed: int, profile: str | None = None) -> str:
    """Return a line: CPU seconds, and what was found and what not."""
    world = edit_map(MAKES[name], seed)
    in_space = is_in_space(world.recording)
    warm_up(search=not in_space, in_space=in_space)
    began = time.process_time()
    with cProfile.Profile() as profiler:
        if profile is None:
            profiler.disable()
        found = audit_map(world.given, [world.recording])
    cpu_s = time.process_time() - began
    if profile is not None:
        profiler.dump_stats(profile)
    said = {entry.landmark_id: entry.state.value for entry in found.faults}
    right = sum(said.get(key) == state for key, state in world.wrong.items())
    false = {key: state for key, state in said.items() if world.wrong.get(key) != state}
    missed = {key: state for key, state in world.wrong.items() if said.get(key) != state}
    count = len(world.recording.detections)
    return (
        f"{name} {seed}: {cpu_s:.1f} CPU s, {len(world.given)} entries, {count} detections; "
        f"{right} of {len(world.wrong)} found, not found {missed}, false {false}"
    )


def main() -> None:
    """Print a line for each world."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--only", choices=sorted(MAKES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--profile", help="file for cProfile's figures of the last world")
    options = parser.parse_args()
    for name in [options.only] if options.only else MAKES:
        for seed in options.seeds:
            print(measure(name, seed, options.profile), flush=True)


if __name__ == "__main__":
    main()
