"""How often is a verdict right? Runs that are sound by the truth, and runs of recordings that were broken on purpose.

Every world and recording is run as it is, from an unknown map and in its surveyed one, and then with one mistake after
another: other units, signs, axes, clocks, scales, identities, noise, and maps that are mirrored, scaled, outdated, or
of another site. A row a run (signs, errors by the truth, verdict) is appended to a file; a run that is in it is not
repeated, and `--judge` judges the rows of a file again without running anything.

    python -m benchmarks.verdicts --out rows.jsonl                # all; hours on one core
    python -m benchmarks.verdicts --out rows.jsonl --only robot   # some, by the beginnings of their names
    python -m benchmarks.verdicts --out rows.jsonl --held-out     # worlds of seeds that no limit was set with
    python -m benchmarks.verdicts --out rows.jsonl --small        # short drives at a low rate, ten minutes; or both
    python -m benchmarks.verdicts --out rows.jsonl --small --first 2000  # the same, of seeds from 2000 on
    python -m benchmarks.verdicts --out rows.jsonl --judge        # rates, of all that set limits and of the held-out

A run is bad where poses are worse than odometry alone (by 5 % and 1 cm), or the median NEES of poses or landmarks is
beyond 4 times its expectation, both aligned and in the frame of the first pose; then it must not be called sound. A run
of an unbroken recording that is not bad should be. Worlds of seeds from `FRESH` on are held out: limits are set on all
others, and looked at beside the recordings. Whoever looks at rows of held-out worlds and then changes a limit moves
`FRESH` behind them.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

import evermap as em
from benchmarks.goldens.recordings import as_map, case
from benchmarks.goldens.scores import _typical
from evermap.errors import EvermapError
from evermap.geometry import se3
from evermap.metrics.summary import compare_with_truth, metrics_dict
from evermap.slam.plane import in_its_space
from evermap.types import UNKNOWN, AnyRecording, FloatArray, Landmarks, SlamResult, SpatialRecording, is_in_space

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
LONGEST_S, SMALL_LONGEST_S = 240, 8
"""CPU time of a run, and of one in a small world; a lost one may search for long."""
WORSE, SLACK_M, MOST_NEES = 1.05, 0.01, 4.0
FRESH = 7000
"""Seed from which worlds take no part in setting limits."""
SPLIT = 1000
"""Seeds between the beginnings of splits: a world has as many of each kind in any of them."""
FRESH_WORLDS = 40
"""Fresh seeds of each kind of world, at most."""
SMALL_HZ, SMALL_S, SMALL_WORLDS = 2.0, 60.0, 20
"""Of small worlds: rate of their frames, length of drives, and seeds of each kind, at most."""
SMALL_SOUND = 4
"""Seeds of each small world of `evermap reproduce causes` in which nothing is wrong."""


@dataclass(frozen=True, slots=True)
class Case:
    """A run: its name, as 'world/map/mistake', and how to make its recording and map."""

    name: str
    make: Callable[[], tuple[AnyRecording, Landmarks | None]]

    @property
    def is_broken(self) -> bool:
        """Whether something was broken on purpose."""
        return self.name.rsplit("/", 1)[1] != "as it is"

    @property
    def is_held_out(self) -> bool:
        """Whether its world takes no part in setting limits."""
        return is_held_out(self.name)


MIRRORED = ("laser alone: bearings clockwise and turning, too", "uwb alone: sign of turning")
"""Beginnings of names of runs that are right but for a mirror, which nothing shows without a map."""


def is_held_out(name: str) -> bool:
    """Return whether a world takes no part in setting limits."""
    seed = name.split("/", 1)[0].rsplit(" ", 1)[-1]
    return seed.isdigit() and int(seed) >= FRESH


Mistake = Callable[[Any, np.random.Generator], Any]


def _seen(recording: Any, **columns: Any) -> Any:
    return replace(recording, detections=replace(recording.detections, **columns))


def _driven(recording: Any, **columns: Any) -> Any:
    return replace(recording, odometry=replace(recording.odometry, **columns))


def _late(recording: Any, by_s: float) -> Any:
    return _driven(recording, stamp_s=recording.odometry.stamp_s + by_s)


def _noisy_odometry(recording: Any, rng: np.random.Generator) -> Any:
    driven = recording.odometry
    n = len(driven.stamp_s)
    rate = 1.0 / np.median(np.diff(driven.stamp_s))
    forward = driven.forward_mps * (1.0 + 0.1 * math.sqrt(rate) * rng.normal(size=n))
    turn = driven.angular_radps + 0.05 * math.sqrt(rate) * rng.normal(size=n)
    return _driven(recording, forward_mps=forward, angular_radps=turn)


def _noisy_detections(recording: Any, rng: np.random.Generator) -> Any:
    seen = recording.detections
    count = len(seen)
    return _seen(
        recording,
        range_m=np.maximum(seen.range_m * (1.0 + 0.1 * rng.normal(size=count)), 0.05),
        bearing_rad=seen.bearing_rad + 0.1 * rng.normal(size=count),
    )


def _swapped(recording: Any, rng: np.random.Generator, share: float = 0.0) -> Any:
    """Two identities are each other's in the second half; or a share of all are any."""
    seen = recording.detections
    name, known = seen.landmark_id.copy(), np.unique(seen.landmark_id[seen.landmark_id != UNKNOWN])
    if share:
        wrong = (rng.random(len(name)) < share) & (name != UNKNOWN)
        name[wrong] = rng.choice(known, int(wrong.sum()))
    else:
        count = [np.sum(name == one) for one in known]
        one, two = known[np.argsort(count)[-2:]]
        late = np.arange(len(name)) > len(name) // 2
        name = np.where(late & (name == one), two, np.where(late & (name == two), one, name))
    return _seen(recording, landmark_id=name)


IN_PLANE: dict[str, Mistake] = {
    "ranges in mm": lambda r, _: _seen(r, range_m=r.detections.range_m * 1e3),
    "ranges in feet": lambda r, _: _seen(r, range_m=r.detections.range_m / 0.3048),
    "ranges 10 % long": lambda r, _: _seen(r, range_m=r.detections.range_m * 1.1),
    "ranges 30 % long": lambda r, _: _seen(r, range_m=r.detections.range_m * 1.3),
    "bearings in degrees": lambda r, _: _seen(r, bearing_rad=np.degrees(r.detections.bearing_rad)),
    "bearings mirrored": lambda r, _: _seen(r, bearing_rad=-r.detections.bearing_rad),
    "bearings 0.3 rad": lambda r, _: _seen(r, bearing_rad=r.detections.bearing_rad + 0.3),
    "bearings 90 deg": lambda r, _: _seen(r, bearing_rad=r.detections.bearing_rad + 0.5 * np.pi),
    "turns mirrored": lambda r, _: _driven(r, angular_radps=-r.odometry.angular_radps),
    "turns in degrees": lambda r, _: _driven(r, angular_radps=np.degrees(r.odometry.angular_radps)),
    "turns 30 % more": lambda r, _: _driven(r, angular_radps=1.3 * r.odometry.angular_radps),
    "turns biased": lambda r, _: _driven(r, angular_radps=r.odometry.angular_radps + 0.03),
    "speeds in mm": lambda r, _: _driven(r, forward_mps=r.odometry.forward_mps * 1e3),
    "speeds backwards": lambda r, _: _driven(r, forward_mps=-r.odometry.forward_mps),
    "speeds 30 % more": lambda r, _: _driven(r, forward_mps=1.3 * r.odometry.forward_mps),
    "odometry 0.5 s late": lambda r, _: _late(r, 0.5),
    "odometry 3 s late": lambda r, _: _late(r, 3.0),
    "odometry noisy": _noisy_odometry,
    "detections noisy": _noisy_detections,
    "two ids swapped at half time": _swapped,
    "a fifth of the ids wrong": lambda r, rng: _swapped(r, rng, 0.2),
    "half of the ids wrong": lambda r, rng: _swapped(r, rng, 0.5),
}
"""Mistakes in the plane."""


def _scaled_positions(recording: Any, factor: Any) -> Any:
    seen = recording.detections
    if np.isfinite(seen.corner_px).any():  # a tag of another size
        return _seen(recording, tag_size_m=seen.tag_size_m * factor, position_sensor_m=seen.position_sensor_m * factor)
    return _seen(recording, position_sensor_m=seen.position_sensor_m * factor)


def _mirror_positions(recording: Any) -> Any:
    corner = recording.detections.corner_px
    at = recording.detections.position_sensor_m * [-1.0, 1.0, 1.0]
    nan = np.full_like(corner, np.nan)
    return _seen(recording, position_sensor_m=at, corner_px=nan, rotation=np.full((len(at), 4), np.nan))


def _turned_mount(recording: Any, turn: Sequence[float]) -> Any:
    by = np.concatenate([np.zeros(3), turn])
    sensors = tuple(
        replace(one, mount_robot_sensor=tuple(se3.compose(np.array(one.mount_robot_sensor), by).tolist()))
        for one in recording.sensors
    )
    return replace(recording, sensors=sensors)


def _drifting(recording: Any, rng: np.random.Generator, sigma: float, scale: float = 1.0) -> Any:
    driven = recording.odometry
    step = se3.log(se3.between(driven.pose_world_robot[:-1], driven.pose_world_robot[1:]))
    lasted = np.sqrt(np.diff(driven.stamp_s))[:, None]
    step[:, :3] *= scale
    step = step + sigma * lasted * rng.normal(size=step.shape) * [1.0, 1.0, 1.0, 0.5, 0.5, 0.5]
    pose = [driven.pose_world_robot[0]]
    for one in se3.exp(step):
        pose.append(se3.compose(pose[-1], one))
    return _driven(recording, pose_world_robot=np.array(pose))


HALF = math.sqrt(0.5)
IN_SPACE: dict[str, Mistake] = {
    "positions in mm": lambda r, _: _scaled_positions(r, 1e3),
    "tags 10 % larger": lambda r, _: _scaled_positions(r, 1.1),
    "tags 30 % larger": lambda r, _: _scaled_positions(r, 1.3),
    "positions mirrored": lambda r, _: _mirror_positions(r),
    "camera turned 90 deg": lambda r, _: _turned_mount(r, (0.0, 0.0, HALF, HALF)),
    "camera turned 15 deg": lambda r, _: _turned_mount(r, (0.0, 0.1305, 0.0, 0.9914)),
    "two ids swapped at half time": _swapped,
    "a fifth of the ids wrong": lambda r, rng: _swapped(r, rng, 0.2),
    "half of the ids wrong": lambda r, rng: _swapped(r, rng, 0.5),
}
WITH_ODOMETRY: dict[str, Mistake] = {
    "odometry in mm": lambda r, rng: _drifting(r, rng, 0.0, 1e3),
    "odometry 30 % more": lambda r, rng: _drifting(r, rng, 0.0, 1.3),
    "odometry noisy": lambda r, rng: _drifting(r, rng, 0.2),
    "odometry 0.3 s late": lambda r, _: _late(r, 0.3),
    "odometry 3 s late": lambda r, _: _late(r, 3.0),
}
"""Mistakes in space, and those of an odometry."""

MapMistake = Callable[[Landmarks, np.random.Generator], Landmarks]


def _move_map(given: Landmarks, position_m: np.ndarray) -> Landmarks:
    return replace(given, position_m=position_m)


def _shuffled(given: Landmarks, rng: np.random.Generator, share: float) -> Landmarks:
    at, some = given.position_m.copy(), np.flatnonzero(rng.random(len(given)) < share)
    size = np.ptp(at[:, :2], axis=0).max()
    at[some, :2] += rng.uniform(-0.3, 0.3, (len(some), 2)) * size
    return _move_map(given, at)


def _other_site(given: Landmarks, rng: np.random.Generator) -> Landmarks:
    low, high = given.position_m.min(axis=0), given.position_m.max(axis=0)
    return _move_map(given, rng.uniform(low, high + 1e-6, given.position_m.shape))


OF_MAP: dict[str, MapMistake] = {
    "map mirrored": lambda m, _: _move_map(m, m.position_m * ([1.0, -1.0, 1.0][: m.position_m.shape[1]])),
    "map 20 % larger": lambda m, _: _move_map(m, 1.2 * m.position_m),
    "a fifth of the map moved": lambda m, rng: _shuffled(m, rng, 0.2),
    "half of the map moved": lambda m, rng: _shuffled(m, rng, 0.5),
    "map of another site": _other_site,
    "no id in common": lambda m, _: replace(m, landmark_id=m.landmark_id + 1_000_000),
}
"""Mistakes of a map that is given."""

Made = Callable[[], AnyRecording]


def all_cases(data: Path = DATA) -> Iterator[Case]:
    """Yield every run: worlds first, then recordings."""
    for name, make, mistakes in (*_worlds(range(60)), *_recordings(data)):
        yield from _of_base(name, make, mistakes)


def fresh_cases(first: int) -> Iterator[Case]:
    """Yield runs of worlds of seeds from `first` on: those of `all_cases` and of `evermap reproduce causes`."""
    for seed in range(first, first + FRESH_WORLDS):
        for name, make, mistakes in _worlds(range(seed, seed + 1)):
            yield from _of_base(name, make, mistakes)
    yield from _of_causes(first)


def small_cases(first: int) -> Iterator[Case]:
    """Yield runs of a second or two in worlds of seeds from `first` on, some of every kind that others have, too."""
    for seed in range(first, first + SMALL_WORLDS):
        for name, make, mistakes in _worlds(range(seed, seed + 1), small=True):
            yield from _of_base(name, make, mistakes)
    yield from _of_causes(first, small=True)


def _of_causes(seed: int, *, small: bool = False) -> Iterator[Case]:
    """Yield a run of every world of `evermap reproduce causes`, and more of those in which nothing is wrong."""
    from evermap_studies.causes.catalogue import World, catalogue
    from evermap_studies.causes.drives import as_recording
    from evermap_studies.causes.judge import make_case

    def made(world: World, seed: int) -> tuple[AnyRecording, Landmarks | None]:
        if small:
            world = replace(world, make=replace(world.make, frame_hz=min(SMALL_HZ, world.make.frame_hz)))
        given = make_case(world, seed).given
        return as_recording(given), given.places

    label, sound = ("small ", SMALL_SOUND) if small else ("", 3)
    for world in catalogue():
        kind, mistake = "in map" if world.in_map else "alone", "as it is" if not world.cause else world.cause
        for k in range(sound if world.group == "sound" else 1):
            name = f"{world.name.replace('/', ' per ')} {label}{seed + k}/{kind}/{mistake}"
            yield Case(name, lambda world=world, k=k: made(world, seed + k))


def _of_base(name: str, make: Made, mistakes: int) -> Iterator[Case]:
    """Yield a base without and with its map: unchanged, and with some of the mistakes, in rotation."""

    def broken(mistake: str, kind: str) -> tuple[AnyRecording, Landmarks | None]:
        rng = np.random.default_rng(zlib.crc32(f"{name}/{kind}/{mistake}".encode()))
        recording = make()
        survey = recording.true_landmarks
        given = as_map(survey, 0.02) if kind == "in map" and survey is not None else None
        if mistake in OF_MAP:
            assert given is not None
            return recording, OF_MAP[mistake](given, rng)
        table = {**IN_SPACE, **WITH_ODOMETRY} if is_in_space(recording) else IN_PLANE
        return (recording if mistake == "as it is" else table[mistake](recording, rng)), given

    for kind in ("alone", "in map"):
        yield Case(f"{name}/{kind}/as it is", lambda kind=kind: broken("as it is", kind))
    if not mistakes:
        return
    spatial = name.startswith(("patrol", "tags", "objects", "star", "case"))
    own = {**IN_SPACE, **({} if name.startswith(("objects", "star", "tags test_9")) else WITH_ODOMETRY)}
    table = list(own if spatial else IN_PLANE)
    turn = zlib.crc32(name.encode())
    for k in range(mistakes):
        mistake, kind = table[(turn + 7 * k) % len(table)], ("alone", "in map")[(turn + k) % 2]
        yield Case(f"{name}/{kind}/{mistake}", lambda kind=kind, mistake=mistake: broken(mistake, kind))
    for k in range((mistakes + 1) // 2):
        mistake = list(OF_MAP)[(turn + k) % len(OF_MAP)]
        yield Case(f"{name}/in map/{mistake}", lambda mistake=mistake: broken(mistake, "in map"))


def _worlds(seeds: range, *, small: bool = False) -> Iterator[tuple[str, Made, int]]:
    """Yield names, makers, and how many mistakes each is broken by; of fresh seeds some of each kind."""
    from evermap_studies.sim import BuildingConfig, simulate_building
    from evermap_studies.worlds.lasers import LaserWorld, simulate_laser
    from evermap_studies.worlds.robots import draw_robot, simulate_robot

    def robot(seed: int) -> AnyRecording:
        made = draw_robot(seed)
        return simulate_robot(replace(made, duration_s=min(made.duration_s, 2.0 * lasting_s if small else 180.0)), seed)

    label, lasting_s = ("small ", SMALL_S) if small else ("", 150.0)
    lasers = {
        "plain": LaserWorld(),
        "lasting": LaserWorld(lasting_m=0.02, lasting_rad=0.005),
        "thick": LaserWorld(radius_m=0.1, radius_spread_m=0.03),
        "late": LaserWorld(delay_s=0.15, scan_s=0.1),
        "slips": LaserWorld(slips=60.0, noise=0.03, scale=1.03, turn_scale=0.97),
        "few": LaserWorld(n_landmarks=5, range_max_m=8.0),
        "misread": LaserWorld(p_wrong=0.03),
    }
    lasers = {name: replace(world, duration_s=lasting_s) for name, world in lasers.items()}
    if small:
        lasers = {name: replace(world, rate_hz=SMALL_HZ) for name, world in lasers.items()}
    for seed in seeds:
        number = seed % SPLIT
        yield f"robot {label}{seed}", lambda seed=seed: robot(100 + seed), 2
        if number < 24 and not small:
            yield f"patrol {seed}", lambda seed=seed: _patrol(seed), 2
        if number < 3:
            for name, world in lasers.items():
                yield f"laser {name} {label}{seed}", lambda world=world, seed=seed: simulate_laser(world, 40 + seed), 2
        if number < (3 if small else 10):
            config = BuildingConfig(days=1, sessions_per_day=1, patrol_s=SMALL_S if small else (60.0, 165.0)[seed % 2])
            yield (
                f"building {label}{seed}",
                lambda config=config, seed=seed: simulate_building(config, seed=seed).sessions[0],
                2,
            )


def _recordings(data: Path) -> Iterator[tuple[str, Made, int]]:
    """Yield names, readers, and how many mistakes each is broken by."""
    for name in ("c_po", "c_latency", "c_midmove", "f_uwb_moved_far"):
        yield f"case {name}", lambda name=name: case(name, data=data), 0
    for name in sorted(path.name for path in (data / "ycbv").glob("0*")):
        yield f"objects {name}", lambda name=name: em.read_recording(data / "ycbv" / name), 2
    for name in STARLOC:
        yield f"star {name}", lambda name=name: _starloc(data, name), 2
    for name in ("test_11", "test_13", "test_9", "test_10"):
        yield f"tags {name}", lambda name=name: em.read_recording(data / "tagslam" / name), 2
    for number, robots in ((6, (1, 2, 3, 4, 5)), (3, (1, 2, 3, 5))):
        for one in robots:
            yield f"mrclam {number} {one}", lambda number=number, one=one: _mrclam(data, number, one), 3


STARLOC = (
    "loop-2d_s1", "loop-2d-fast_s2", "eight_s2", "loop-2d_s2", "loop-3d_s1", "loop-3d_s2", "loop-2d-fast_s1",
    "zigzag_s2",
)  # fmt: skip


def _mrclam(data: Path, number: int, robot: int) -> AnyRecording:
    return em.read_recording(data / "mrclam" / f"MRCLAM_Dataset{number}.zip", robot=robot)


def _starloc(data: Path, session: str) -> AnyRecording:
    folder = data / "starloc"
    with tempfile.TemporaryDirectory() as temporary:
        script = folder / "starloc_to_plain.py"
        command = [sys.executable, script, folder, session, temporary, "--truth"]
        subprocess.run(list(map(str, command)), check=True, capture_output=True)
        return em.read_recording(temporary)


def _patrol(seed: int) -> SpatialRecording:
    """One day in a building in space; every fifth one by hand."""
    from evermap_studies.building.patrol import patrolled
    from evermap_studies.building.world import made

    day, world = seed % 2, made(seed, 2)
    there = np.flatnonzero(np.isfinite(world.landmarks(day)[0][:, 0]))
    found = patrolled(world, day, seed, there, np.full_like(there, day), seed % 5 == 4).recording
    assert found.truth is not None
    return replace(found, truth=replace(found.truth, clock=found.clock))


class TooLongError(Exception):
    """A run took longer than `LONGEST_S`."""


def _stop(*_: Any) -> None:
    raise TooLongError


def run(one: Case, longest_s: int = LONGEST_S) -> dict[str, Any]:
    """Return the row of a run, which is given up after some CPU time."""
    began = time.process_time()
    row: dict[str, Any] = {"name": one.name, "broken": one.is_broken}
    signal.signal(signal.SIGPROF, _stop)
    signal.setitimer(signal.ITIMER_PROF, longest_s)
    try:
        recording, given = one.make()
        named = bool((recording.detections.landmark_id != UNKNOWN).any())
        config = em.Config.model_validate({"slam": {"unknown_ids": not named}})
        dim = None if given is None else int(given.position_m.shape[1])
        recording = in_its_space(recording, config.slam, dim=dim)
        result = em.run_slam(recording, config, prior_map=given)
        row |= scores(recording, result, given) | describe(recording, result, given)
    except EvermapError as error:
        row["error"] = error.one_line()
    except TooLongError:
        row["error"] = "too long"
    except Exception as error:  # a defect; the other runs go on
        row["error"] = f"{type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return row | {"cpu_s": round(time.process_time() - began, 2)}


def scores(recording: AnyRecording, result: SlamResult, given: Landmarks | None) -> dict[str, Any]:
    """Return errors by the truth: None where there is none."""
    rate_hz = 20.0 if is_in_space(recording) else 2.0
    compared = compare_with_truth(recording, result, rate_hz=rate_hz)
    found, poses = metrics_dict(compared), compared.poses
    names = ("pose_rmse_m", "dead_reckoning_rmse_m", "landmark_rmse_m", "heading_rmse_deg")
    row = {name: found[name] for name in names}
    row["pose_nees"] = None if poses is None else _least_nees((poses.nees, poses.anchored_nees), poses.dof)
    places = [one for one in (compared.landmarks, compared.landmarks_anchored) if one is not None]
    if not places and compared.landmarks_own is not None:
        places = [compared.landmarks_own]
    row["landmark_nees"] = _least_nees([one.nees[one.scored] for one in places], places[0].dof) if places else None
    if given is not None and recording.truth is not None and result.trajectory.frame == "prior_map":
        truth = recording.truth
        at = np.clip(np.searchsorted(truth.stamp_s, result.trajectory.stamp_s), 0, len(truth) - 1)
        dim = 3 if is_in_space(recording) else 2
        near = np.abs(truth.stamp_s[at] - result.trajectory.stamp_s) < 0.1
        apart = result.trajectory.pose_world_robot[near, :dim] - truth.pose_world_robot[at[near], :dim]
        row["absolute_m"] = float(np.sqrt(np.mean((apart**2).sum(axis=1)))) if near.any() else None
    return row


def _least_nees(in_frames: Sequence[FloatArray | None], dof: int) -> float | None:
    """Return the least of typical NEES in several frames: aligned with the truth, and where the first pose is exact.

    Covariances hold in the second, in which one error of the first pose is in all others; the first lays errors of
    some poses on what lies beside the first one and is known to millimetres. What is too sure is so in both.
    """
    found = [_typical(values, dof) for values in in_frames]
    return min((one for one in found if one is not None), default=None)


def describe(recording: AnyRecording, result: SlamResult, given: Landmarks | None) -> dict[str, Any]:
    """Return the signs of a run and its verdict."""
    from evermap.explain.symptoms import measure_signs
    from evermap.slam.check import find_misreadings

    settings = em.Config().slam
    signs = asdict(measure_signs(result, recording, given))
    if result.verdict is not None:  # what only a solution that is sound by all else is asked
        told = {one.code: one.value for one in result.verdict.symptoms}
        signs |= {code: told[code] for code in ("held", "alternation", "adrift") if code in told}
    found = [[one.code, one.usable] for one in find_misreadings(recording, settings)]
    return {
        "signs": signs,
        "findings": found,
        "undecided": len(result.undecided),
        "changes": len(result.changes),
        "identified": int((recording.detections.landmark_id != UNKNOWN).sum()),
        "warnings": list(result.warnings),
        "levels": {one.name: one.value for one in result.parameters if not one.prior_sigma > 0.0},
        "causes": [asdict(cause) for cause in result.causes],
        "verdict": None if result.verdict is None else result.verdict.kind.value,
        "message": None if result.verdict is None else result.verdict.message,
    }


def is_bad(row: dict[str, Any]) -> bool:
    """Return whether a run is worse than odometry alone, or surer than it is right."""
    pose, alone = row.get("pose_rmse_m"), row.get("dead_reckoning_rmse_m")
    # in a map the alignment of the poses, by millimetres, is more than what landmarks are known to
    names = ("pose_nees", "landmark_nees") if row["signs"]["in_map"] is not True else ("pose_nees",)
    nees = [row.get(name) for name in names]
    worse = pose is not None and alone is not None and pose > WORSE * alone + SLACK_M
    return worse or any(one is not None and one > MOST_NEES for one in nees)


def judged(row: dict[str, Any]) -> str:
    """Return the kind of verdict on a row, by the limits as they are now; 'error' where nothing was estimated."""
    from dataclasses import fields

    from evermap.explain.symptoms import Signs
    from evermap.explain.verdict import judge_signs
    from evermap.types import Cause

    if "error" in row:
        return "error"
    names = {one.name for one in fields(Signs)}
    signs = Signs(**{name: value for name, value in row["signs"].items() if name in names})
    wrong = [code for code, usable in row["findings"] if not usable]
    off = [f"{signs.away_name}: {signs.away:.1f} sigmas"] if signs.away > em.Config().slam.check.far_off else []
    return judge_signs(signs, [*wrong, *off], [Cause(**one) for one in row["causes"]]).kind.value


def rates(rows: Sequence[dict[str, Any]]) -> str:
    """Return how often verdicts are right, where limits are set and in the worlds that are held out, and misses."""
    lines = [
        "| worlds | runs | sound | sound but bad | sound but mirrored | good, unbroken | of these not sound |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    missed = list[str]()
    for held, name in ((False, "limits set"), (True, "held out")):
        some = [(row, judged(row)) for row in rows if is_held_out(row["name"]) is held]
        sound = [row for row, kind in some if kind == "sound"]
        good = [(row, kind) for row, kind in some if not row["broken"] and kind != "error" and not is_bad(row)]
        mirrored = [row for row in sound if row["name"].startswith(MIRRORED)]
        false = [row["name"] for row in sound if is_bad(row) and row not in mirrored]
        unjust = [f"{row['name']}: {kind}" for row, kind in good if kind != "sound"]
        shares = _share(len(false), len(sound)), _share(len(unjust), len(good))
        lines.append(
            f"| {name} | {len(some)} | {len(sound)} | {shares[0]} | {len(mirrored)} | {len(good)} | {shares[1]} |"
        )
        missed += [f"sound but bad, {name}: {one}" for one in false]
        missed += [f"not sound but good, {name}: {one}" for one in unjust]
    return "\n".join([*lines, "", *missed])


def _share(count: int, of: int) -> str:
    """Return a count with its share and the interval that holds the rate with 95 % (Clopper and Pearson)."""
    if not of:
        return str(count)
    low = beta.ppf(0.025, count, of - count + 1) if count else 0.0
    high = beta.ppf(0.975, count + 1, of - count) if count < of else 1.0
    return f"{count} ({count / of:.1%}; {low:.1%} to {high:.1%})"


def compute(out: Path, cases: Sequence[Case], longest_s: int = LONGEST_S) -> None:
    """Run what is not in the file yet, a row each."""
    done = {json.loads(line)["name"] for line in out.read_text().splitlines()} if out.is_file() else set()
    with out.open("a") as file:
        for one in cases:
            if one.name in done:
                continue
            row = run(one, longest_s)
            file.write(json.dumps(row) + "\n")
            file.flush()
            print(f"{one.name}: {row.get('verdict')} {row.get('error', '')} {row['cpu_s']} s", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks.verdicts", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, metavar="ROWS.jsonl")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="beginnings of names")
    parser.add_argument("--held-out", action="store_true", help="worlds of fresh seeds")
    parser.add_argument("--first", type=int, metavar="SEED", help="worlds of seeds from this on; a multiple of 1000")
    parser.add_argument("--small", action="store_true", help="short drives at a low rate, of either seeds")
    parser.add_argument("--judge", action="store_true", help="judge the rows that are there")
    given = parser.parse_args(arguments)
    if given.judge:
        print(rates([json.loads(line) for line in given.out.read_text().splitlines()]))
        return 0
    first = (FRESH if given.held_out else 0) if given.first is None else given.first
    if given.small:
        cases = list(small_cases(first))
    else:
        cases = list(fresh_cases(first) if first else all_cases(given.data.resolve()))
    cases = [one for one in cases if not given.only or one.name.startswith(tuple(given.only))]
    cases.sort(key=lambda one: zlib.crc32(one.name.encode()))  # so that any part of them is a sample of all
    compute(given.out, cases, SMALL_LONGEST_S if given.small else LONGEST_S)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
