"""What a session, a step and a start cost in living maps of different size, each in a process of its own.

A session of 200 landmarks of a warehouse is the same however large the rest of the warehouse is: what it costs to bring
it into the map, and to localise in the map, should not depend on the rest either. Maps are filled directly, as sessions
would have left them: every landmark a clique of its own at one site, seen a while ago.

    python -m benchmarks.scale_maps bring_in 1000
    python -m benchmarks.scale_maps history 1000    # sessions: what reading the file takes, and how it grows
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import evermap as em
from benchmarks.memory import ROOT, child_environment, peak_mb
from benchmarks.scale import Ticks, spent
from evermap.geometry import se2
from evermap.geometry.chunked import ChunkedCovariance, JointCovariance
from evermap.maps.diff import read_log
from evermap.maps.living import Members, Places, Sites, Stays
from evermap.maps.store import Provenance, RevisionKind
from evermap.maps.vicinity import in_chunks
from evermap.runs.map_dicts import landmark_dicts
from evermap.sensing.sightlines import SightLines, Views
from evermap.slam.association.assignment import density_of_unmet
from evermap.slam.association.constellation import LocalMap
from evermap.slam.association.place_index import PlaceIndex
from evermap.types import UNKNOWN, FloatArray, IntArray, Recording, rows_of
from evermap_studies.sim import BuildingConfig, WarehouseConfig, simulate_building, simulate_warehouse
from evermap_studies.sim.warehouse import warehouse_landmarks

SIZES = (1_000, 10_000, 100_000)
"""Places of the maps."""
SESSION = WarehouseConfig(n_landmarks=SIZES[0], landmarks_per_aisle=20, aisles_driven=10)
"""The drive: ten aisles of twenty landmarks, and what it sees of the eleventh."""
SMALL = WarehouseConfig(n_landmarks=60, landmarks_per_aisle=20, aisles_driven=1)
"""Warms up: the same work, small."""
LOCALISE_S = 120.0
"""Of the drive, when localising."""
START_FRAMES = 20
"""Frames in which the start pose is found, and that no step is counted in."""
LOCAL = (8, 12, 20)
TRIED = 50
"""Landmarks of local maps that are looked for without identities, and how many of each size."""
SIGMA_MAP_M = 0.03
CORRELATED_M = 30.0
"""Distance over which errors of places are correlated, half of their variance; sessions leave no two independent."""
MAP_POSE = np.array([30.0, -20.0, 0.7])
"""Of the warehouse in the map's frame: where the robot starts is nowhere near the origin."""
SEEN_S = 3_600.0
"""Seconds before the session at which the map was seen last."""
SESSIONS_PER_DAY = 27
"""Of the building: 10,000 in a year."""
BUILDING_SESSIONS = 40
"""Of the building by default; the claim is about 10,000."""
DAY_S, NEW_STAYS = 86400.0, 4
"""Between the sessions of a history, and stays that each begins."""
COMPLETE_AFTER = 10
"""Sessions after which the map of the building knows all rooms."""


def living_map(config: WarehouseConfig, seed: int = 0) -> em.LivingMap:
    """Return a map of the warehouse as sessions would have left it.

    The places are `SIGMA_MAP_M` off, with errors that those around share. Every place was seen from either side of it
    along the middle of its aisle, and the robot looked both ways from everywhere there.
    """
    landmark = warehouse_landmarks(config, seed=seed)
    rng, count = np.random.default_rng([seed, 2]), len(landmark)
    position = se2.transform(MAP_POSE, landmark) + SIGMA_MAP_M * rng.normal(size=landmark.shape)
    name, no_class = np.arange(count), np.full(count, UNKNOWN)
    most_stays = em.Config().living.decisions.most_stays  # a map keeps the newest
    seen, first = np.full(count, -SEEN_S), np.full(count, -10 * SEEN_S)
    never = np.full(count, np.inf)
    living = em.LivingMap(
        stamp_s=-SEEN_S,
        session_start_s=-SEEN_S,
        members=Members(name, no_class, name, np.zeros(count, np.bool_), np.zeros(count, np.bool_)),
        sites=Sites(name, name, np.full(count, 0.99), np.full(count, 0.99), first, seen),
        places=Places(name, name, position, np.full(count, 50), np.zeros(count, np.int64)),
        stays=Stays(name, name, no_class, position, -never, first, seen, never, np.zeros(count))[-most_stays:],
        covariance_m2=_covariance(position),
        sightlines=_lines(name, position),
        views=_views(position),
        n_cliques_ever=count,
        n_sites_ever=count,
    )
    return in_chunks(living, em.Config().living)


def _aisle(position_m: FloatArray, along_m: FloatArray) -> FloatArray:
    """(P, K, 2) points beside each place, along the middle of its aisle."""
    turn = se2.rotation(MAP_POSE[2])
    return np.asarray(position_m[:, None] + along_m[:, None] * turn[:, 0] - 0.5 * SESSION.aisle_m * turn[:, 1])


def _lines(name: IntArray, position_m: FloatArray) -> SightLines:
    """Along which every place was seen."""
    lines = SightLines.empty()
    beside = _aisle(position_m, np.arange(-4.75, 5.0, lines.cell_m))
    place, count = np.repeat(np.arange(len(name)), beside.shape[1]), beside.shape[0] * beside.shape[1]
    cell = lines.cells(beside.reshape(-1, 2), position_m[place])
    hit = np.ones(count, dtype=np.bool_)
    return lines.learned((name, name), place, cell, hit, np.full(count, 20.0))


def _views(position_m: FloatArray) -> Views:
    """From where the robot looked."""
    views = Views.empty()
    eye = _aisle(position_m, np.arange(0.0, SESSION.spacing_m, views.cell_m)).reshape(-1, 2)
    poses = [np.column_stack([eye, np.full(len(eye), heading)]) for heading in (MAP_POSE[2], MAP_POSE[2] + np.pi)]
    return views.seen_from(np.vstack(poses), -SEEN_S)


def _covariance(position_m: FloatArray) -> JointCovariance:
    """Of places with errors that are partly shared by those around, as a map of this size keeps it."""

    def joint(a: IntArray, b: IntArray) -> FloatArray:
        apart = np.linalg.norm(position_m[a][:, None] - position_m[b][None], axis=2)
        shared = 0.5 * np.exp(-apart / CORRELATED_M) + 0.5 * (a[:, None] == b[None])
        return np.asarray(np.kron(SIGMA_MAP_M**2 * shared, np.eye(2)))

    rows = np.arange(len(position_m))
    if len(rows) <= em.Config().living.whole_places:
        return joint(rows, rows)
    return ChunkedCovariance.of_points(position_m, joint)


def bring_in(n_places: int, config: WarehouseConfig = SESSION) -> dict[str, float]:
    """Measure a session that is entered into a stored map and committed; the file grows by the recording too."""
    recording = simulate_warehouse(config)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.evermap"
        _written(path, n_places, config)
        with em.open_store(path) as store:
            before_mb, file_mb = peak_mb(), _size_mb(path)
            done = spent(lambda: _entered(store, recording))
            recording_mb = sum(item.n_bytes for item in store.attachments()) / 1e6
        grown_mb = _size_mb(path) - file_mb
    return {
        "found": float(done.result.session.found),
        "changes": float(len(done.result.session.changes)),
        "wall_s": done.wall_s,
        "cpu_s": done.cpu_s,
        "grown_mb": peak_mb() - before_mb,
        "peak_mb": peak_mb(),
        "file_mb": file_mb,
        "file_grown_mb": grown_mb,
        "recording_mb": recording_mb,
    }


def localise(n_places: int, config: WarehouseConfig = SESSION) -> dict[str, float]:
    """Measure localisation from an unknown pose: the steps, and what all else takes, which is to find the start."""
    living = living_map(replace(config, n_landmarks=n_places))
    recording = _until(simulate_warehouse(config), LOCALISE_S)
    before_mb, ticks = peak_mb(), Ticks()
    done = spent(lambda: em.run_localization(recording, living, progress=ticks))
    result, ms = done.result, 1e3 * ticks.frame_s[START_FRAMES:]
    median_ms = float(np.median(ms))
    assert recording.truth is not None
    row = np.searchsorted(recording.truth.stamp_s, result.online.stamp_s - 1e-6)
    truth = se2.compose(MAP_POSE, recording.truth.pose_world_robot[row])
    return {
        "start_s": done.cpu_s - 1e-3 * (float(ms.sum()) + START_FRAMES * median_ms),
        "median_ms": median_ms,
        "p99_ms": float(np.quantile(ms, 0.99)),
        "longest_ms": float(ms.max()),
        "off_m": float(np.median(np.linalg.norm(result.online.pose_world_robot[:, :2] - truth[:, :2], axis=1))),
        "grown_mb": peak_mb() - before_mb,
    }


def constellations(n_places: int, config: WarehouseConfig = SESSION) -> dict[str, float]:
    """Measure finding local maps of landmarks without identities in a map that lacks a tenth of them.

    Local maps hold the `LOCAL` landmarks around a random one, a tenth of them new, in a frame of their own; as many are
    of a warehouse that is not in the map. Shares are of `TRIED` each.
    """
    config, rng = replace(config, n_landmarks=n_places), np.random.default_rng(n_places)
    true, foreign = warehouse_landmarks(config), warehouse_landmarks(config, seed=1)
    mapped = np.flatnonzero(rng.random(n_places) >= 0.1)
    position = true[mapped] + SIGMA_MAP_M * rng.normal(size=(len(mapped), 2))
    before_mb = peak_mb()
    built = spent(lambda: PlaceIndex(position, np.tile(SIGMA_MAP_M**2 * np.eye(2), (len(mapped), 1, 1))))
    found: dict[str, float] = {"build_s": built.cpu_s, "grown_mb": peak_mb() - before_mb}
    for count in LOCAL:
        cpu_s, right, wrong, invented = [], 0, 0, 0
        for world in (true, foreign) * TRIED:
            local, name = _local_map(rng, world, count)
            density = density_of_unmet(local.place)
            asked = spent(
                lambda local=local, density=density: built.result.pairs(local, density=density, probability=0.97)
            )
            cpu_s.append(asked.cpu_s)
            good = sum(int(name[k]) == int(mapped[m]) for k, m in asked.result)
            if world is true:
                right += good > 0
                wrong += bool(asked.result) and good == 0
            else:
                invented += bool(asked.result)
        found |= {f"median_s_{count}": float(np.median(cpu_s)), f"longest_s_{count}": max(cpu_s)}
        found |= {
            f"{who}_{count}": n / TRIED for who, n in (("found", right), ("wrong", wrong), ("invented", invented))
        }
    return found


def _local_map(rng: np.random.Generator, world: FloatArray, count: int) -> tuple[LocalMap, IntArray]:
    """The landmarks around one of them, a tenth of them new, and which they are, -1 for new."""
    name = np.argsort(np.hypot(*(world - world[rng.integers(len(world))]).T))[:count]
    place, new = world[name].copy(), rng.random(count) < 0.1
    place[new] = rng.uniform(place.min(axis=0), place.max(axis=0), (int(new.sum()), 2))
    place = se2.transform(MAP_POSE, place) + SIGMA_MAP_M * rng.normal(size=place.shape)
    order = rng.permutation(count)
    return LocalMap(place[order], SIGMA_MAP_M**2 * np.eye(2 * count)), np.where(new, -1, name)[order]


def opened(n_places: int, config: WarehouseConfig = SESSION) -> dict[str, float]:
    """Measure opening a stored map, until a localisation in it has gone on for three seconds."""
    recording = _until(simulate_warehouse(config), 3.0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.evermap"
        _written(path, n_places, config)
        before_mb = peak_mb()
        loaded = spent(lambda: _loaded(path))
        started = spent(lambda: em.run_localization(recording, loaded.result))
        return {
            "load_s": loaded.cpu_s,
            "cpu_s": loaded.cpu_s + started.cpu_s,
            "wall_s": loaded.wall_s + started.wall_s,
            "grown_mb": peak_mb() - before_mb,
            "file_mb": _size_mb(path),
        }


def _written(path: Path, n_places: int, config: WarehouseConfig) -> None:
    """Write a map in a process of its own, whose memory is not counted."""
    code = f"from benchmarks import scale_maps as s; s.write_map({str(path)!r}, {n_places}, {config!r})"
    _child("-c", f"from evermap_studies.sim import WarehouseConfig; {code}")


def write_map(path: str, n_places: int, config: WarehouseConfig = SESSION) -> None:
    """Write the map of a warehouse of so many landmarks as the first revision of a new store."""
    with em.open_store(path, create=True) as store:
        _begin(store, replace(config, n_landmarks=n_places))


def building(n_sessions: int = BUILDING_SESSIONS, patrol_s: float = 60.0) -> dict[str, Any]:
    """Measure sessions of one building, one after the other: time, growth of the file and memory of each.

    Args:
        n_sessions: 27 a day; things move, come and go.
        patrol_s: length of each; the first is a full lap of three times that.
    """
    config = BuildingConfig(
        days=-(-n_sessions // SESSIONS_PER_DAY),
        sessions_per_day=SESSIONS_PER_DAY,
        patrol_lengths_s=(patrol_s, 3.0 * patrol_s),
        change_rate=0.3,
    )
    recordings = [replace(session, truth=None) for session in simulate_building(config).sessions[:n_sessions]]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.evermap"
        with em.open_store(path, create=True) as store:
            for recording in recordings:
                file_mb = _size_mb(path)
                done = spent(lambda recording=recording: _entered(store, recording))
                minutes = float(np.ptp(recording.frames.stamp_s)) / 60.0
                grown_mb = _size_mb(path) - file_mb
                rows.append((done.wall_s, done.cpu_s, done.cpu_s / minutes, grown_mb, resident_mb()))
    return building_summary(np.array(rows))


def history(n_sessions: int, patrol_s: float = 60.0) -> dict[str, float]:
    """Measure what `evermap map` takes to read a file of so many sessions, and how many bytes a session adds.

    The map of two sessions of a building is committed over and over, a day later each, with other places,
    covariances, looks and stays: real sessions would take a thousand times as long. The file has no recordings.
    """
    first, second = simulate_building(BuildingConfig(days=2, patrol_s=patrol_s), 1).sessions
    session = em.run_session(second, em.run_session(first).living)
    living, rng, sizes = session.living, np.random.default_rng(0), list[int]()
    stays, most = living.stays, em.Config().living.decisions.most_stays
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.evermap"
        with em.open_store(path, create=True) as store:
            for day in range(n_sessions):
                shift_s = DAY_S * day
                if day:
                    new = later_stays(living.stays[np.arange(min(NEW_STAYS, len(living.stays)))], shift_s)
                    stays = stays.joined(new)
                    stays = stays[np.argsort(stays.first_s, kind="stable")[-most:]]
                moved_m = living.places.position_m + 1e-3 * rng.normal(size=living.places.position_m.shape)
                now = replace(
                    living,
                    stamp_s=living.stamp_s + shift_s,
                    session_start_s=living.session_start_s + shift_s,
                    places=replace(living.places, position_m=moved_m),
                    covariance_m2=np.asarray(living.covariance_m2) * (1.0 + 1e-3 * rng.random()),
                    stays=stays,
                )
                seen = replace(session.evidence, stamp_s=session.evidence.stamp_s + shift_s)
                told = [
                    replace(one, stamp_from_s=one.stamp_from_s + shift_s, stamp_to_s=one.stamp_to_s + shift_s)
                    for one in session.changes
                ]
                span_s = second.frames.stamp_s[[0, -1]] + shift_s
                said = Provenance(recording=f"day {day}", stamp_from_s=float(span_s[0]), stamp_to_s=float(span_s[1]))
                store.commit(now, said, told, seen, parent=day)
                sizes.append(path.stat().st_size)
        landmark = int(living.members.landmark_id[0])
        asked: dict[str, Callable[[Any], Any]] = {
            "log": read_log,
            "show": lambda store: landmark_dicts(store.load()),
            "diff": lambda store: em.diff(store, max(1, n_sessions // 2)),
            "why": lambda store: em.why(store, landmark),
        }
        found = {f"{name}_cpu_s": min(_asked(path, ask) for _ in range(2)) for name, ask in asked.items()}
    grown = np.diff(sizes)
    quarter = max(1, len(grown) // 4)
    return {**found, "first_bytes": float(np.mean(grown[:quarter])), "last_bytes": float(np.mean(grown[-quarter:]))}


def later_stays(stays: Stays, shift_s: float) -> Stays:
    """The same stays at another time, each ended after an hour."""
    ends = stays.last_s + shift_s + 3600.0
    times = (stays.elsewhere_s + shift_s, stays.first_s + shift_s, stays.last_s + shift_s, ends)
    return replace(stays, **dict(zip(("elsewhere_s", "first_s", "last_s", "gone_s"), times, strict=True)))


def _asked(path: Path, ask: Callable[[Any], Any]) -> float:
    """CPU seconds of a question to a map that is opened for it."""

    def whole() -> None:
        with em.open_store(path) as store:
            ask(store)

    return spent(whole).cpu_s


def building_summary(rows: FloatArray, complete_after: int = COMPLETE_AFTER, most: int = 100) -> dict[str, Any]:
    """Compare the first sessions after the map is complete with the last ones.

    Args:
        rows: (S, 5) wall and CPU seconds, CPU seconds a minute of the drive, MB that the file grew by, MB resident.
        complete_after: sessions that are left out.
        most: sessions at either end, at most; fewer where they would overlap.
    """
    count = max(1, min(most, (len(rows) - complete_after) // 2))
    first, last = rows[complete_after : complete_after + count].mean(axis=0), rows[-count:].mean(axis=0)
    names = ("wall_s", "cpu_s", "cpu_s_per_minute", "file_mb", "resident_mb")
    return {
        "sessions": len(rows),
        "compared": count,
        "first": dict(zip(names, first.tolist(), strict=True)),
        "last": dict(zip(names, last.tolist(), strict=True)),
        "ratio": dict(zip(names, (last / first).tolist(), strict=True)),
    }


def resident_mb() -> float:
    """Return the resident size of this process now [MB]; its peak where the system does not tell."""
    status = Path("/proc/self/statm")
    if not status.is_file():
        return peak_mb()
    return int(status.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(work: str, number: int, *, timeout_s: float | None = None) -> dict[str, Any]:
    """Return a row, measured in a process of its own; `not_run` says why where it was not.

    Args:
        work: 'bring_in', 'localise', 'opened', 'constellations' or 'building'.
        number: places of the map, or sessions.
        timeout_s: after which it is given up.
    """
    size = {"sessions" if work == "building" else "places": number}
    try:
        found: dict[str, Any] = json.loads(
            _child("-m", "benchmarks.scale_maps", work, str(number), timeout_s=timeout_s)
        )
    except subprocess.TimeoutExpired:
        return size | {"not_run": f"not done after {timeout_s:.0f} s"}
    return size | found


def run(sizes: Sequence[int] = SIZES, n_sessions: int = BUILDING_SESSIONS) -> dict[str, Any]:
    """Return all rows."""
    rows: dict[str, Any] = {work: [measure(work, n) for n in sizes] for work in ("bring_in", "localise", "opened")}
    return rows | {"building": measure("building", n_sessions)}


def _entered(store: Any, recording: Recording) -> em.Entered:
    entered = em.enter_session(store, recording)
    entered.commit(store)
    return entered


def _loaded(path: Path) -> em.LivingMap:
    with em.open_store(path) as store:
        return store.load()


def _begin(store: Any, config: WarehouseConfig) -> None:
    store.commit(living_map(config), Provenance(RevisionKind.EDIT, note="filled by a benchmark"), parent=0)


def _until(recording: Recording, seconds: float) -> Recording:
    """The first seconds of a recording."""
    frames = int(np.searchsorted(recording.frames.stamp_s, recording.frames.stamp_s[0] + seconds))
    return replace(
        recording,
        frames=rows_of(recording.frames, np.arange(frames)),
        detections=rows_of(recording.detections, recording.detections.frame < frames),
    )


def _size_mb(path: Path) -> float:
    """Of a store with what is still in its log."""
    return sum(part.stat().st_size for part in path.parent.glob(f"{path.name}*")) / 1e6


def _child(*arguments: str, timeout_s: float | None = None) -> str:
    """Standard output of this Python in the checkout."""
    done = subprocess.run(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        cwd=ROOT,
        env=child_environment(),
        timeout=timeout_s,
    )
    return done.stdout


def _main(work: str, number: int) -> None:
    """In the child: the same work on a small map first, so that nothing is compiled while the clock runs."""
    in_map = {"bring_in": bring_in, "localise": localise, "opened": opened, "constellations": constellations}
    if work in in_map:
        in_map[work](SMALL.n_landmarks, SMALL)
    of_sessions = {"building": building, "history": history}
    print(json.dumps(in_map[work](number) if work in in_map else of_sessions[work](number)))


if __name__ == "__main__":
    _main(sys.argv[1], int(sys.argv[2]))
