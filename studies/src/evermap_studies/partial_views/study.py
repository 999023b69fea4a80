"""Maps of robots that see only part of the site on a patrol: what they tell as changed, and whether it is so.

Simulated buildings times lengths of patrols times sessions, all brought into one living map a world; and harder worlds,
with routes of their own, doors that block sight, a wing that opens and clutter. Scored is every change that is told,
landmark by landmark, against the truth; whether changes that the robot really looked at were told; existence, forecasts
for the next session, and how consistent the map's covariances are.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap.maps.living import LivingMap
from evermap.types import BoolArray, ChangeKind, FloatArray, IntArray, Landmarks, MapChange, Progress
from evermap_studies.frame import Stopwatch, check_least
from evermap_studies.partial_views.table import as_markdown
from evermap_studies.rows import RowsFile, run_missing
from evermap_studies.sim import (
    CLUTTER,
    DEFAULT_CLASSES,
    ROOM_DOORS,
    BuildingConfig,
    BuildingSimulation,
    LookedAt,
    looked_at,
    simulate_building,
)
from evermap_studies.worlds.scores import stands_at

__all__ = ["QUICK", "Settings", "as_markdown", "reproduce"]

Row = dict[str, Any]

SCHEMA_VERSION = "1"
EXPERIMENT = "partial-views"
PARTS = ("changing", "still")
HARD = 0
"""Stands for the length of patrols in a harder world."""
HARD_LENGTHS_S = (20.0, 40.0, 60.0, 90.0, 165.0)
OUTLIER_M = 0.5
"""Landmarks that stand where they were seen last, but farther off than this, are wrong: they are counted, and left out
of errors and of their consistency."""
SCORING = (
    "every change that is told, counted by landmark; it is true where the landmark came, left or moved within the "
    "interval that is told, and 'never' where it stood still in all sessions; a true change was really looked at where "
    "its place was looked at before and after through a clear line, and is found if something was told of the landmark "
    "by the end of the session that looked first, or of any later one before its next change; claims are right within "
    "0.25 m, the map being aligned rigidly; forecasts: 'it stands at this place in the next session', against the "
    "constant that is right on average; NEES: squared Mahalanobis error a landmark over its expectation 2"
)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is run; the defaults are everything.

    Attributes:
        buildings: simulated buildings, counted up from the seed.
        patrols_s: lengths of patrols; 0 stands for the harder world.
        sessions: of each building and length, one a day.
        change_rate: factor on how often things move; 0 is a world in which nothing ever changes.
        seed: of the first building.
        processes: worlds at a time.
        parts: 'changing' worlds, and 'still' ones, the same in which nothing ever changes.
    """

    buildings: int = 20
    patrols_s: tuple[int, ...] = (20, 40, 60, 90, 165, HARD)
    sessions: int = 10
    change_rate: float = 1.0
    seed: int = 1000
    processes: int = 1
    parts: tuple[str, ...] = PARTS

    def __post_init__(self) -> None:
        for part in self.parts:
            if part not in PARTS:
                raise ConfigError(f"no such part: {part!r}", field="--part", hint=", ".join(PARTS))
        check_least(self, buildings=1, sessions=2, seed=0, processes=1)


QUICK = Settings(buildings=2, sessions=6)
"""Minutes instead of an hour."""


def reproduce(
    out: str | Path, settings: Settings | None = None, *, progress: Progress | None = None, force: bool = False
) -> dict[str, Any]:
    """Run everything, and write `summary.json`, `table.md` and the figures.

    Args:
        out: folder for the results; untouched if this run fails, but for the rows beside it, from which it goes on.
        settings: what to run; None for everything.
        progress: told after every world.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `worlds` (a dictionary a world), `still` (the same of worlds in which nothing changes), `settings`, `machine`;
        plain JSON values.

    Raises:
        ConfigError: `out` must not be replaced.
    """
    from evermap.runs.folder import RunFolder
    from evermap_studies.frame import save_all
    from evermap_studies.partial_views.figures import draw_false_changes, draw_reliability

    settings, kept = settings or Settings(), RowsFile.beside(out)
    worlds = [(settings.seed + k, patrol) for patrol in settings.patrols_s for k in range(settings.buildings)]
    total = float(len(worlds) * settings.sessions * len(settings.parts))
    with RunFolder(out, force=force) as folder:
        stopwatch = Stopwatch()
        found: dict[str, list[Row]] = {part: [] for part in PARTS}
        for part in settings.parts:
            of_part = settings if part == "changing" else replace(settings, change_rate=0.0)
            runs = [(part, *world, settings.sessions, of_part.change_rate) for world in worlds]
            for row in run_missing(kept, runs, partial(_each_world, of_part)):
                found[part].append(row)
                if progress is not None:
                    progress(float(sum(map(len, found.values())) * settings.sessions), total)
        content: dict[str, Any] = {
            **stopwatch.head(EXPERIMENT, SCHEMA_VERSION, SCORING, settings),
            "worlds": found["changing"],
            "still": found["still"],
        }
        if found["changing"]:
            figures = {"reliability": draw_reliability(content), "false-changes": draw_false_changes(content)}
            save_all(figures, folder.path)
        folder.path("table.md").write_text(as_markdown(content) + "\n", encoding="utf-8")
        content = folder.finish(content)
    kept.remove()
    return content


def _each_world(settings: Settings, runs: list[tuple[str, int, int, int, float]]) -> Iterable[Row]:
    worlds = [(seed, patrol_s) for _, seed, patrol_s, *_ in runs]
    if settings.processes == 1:
        yield from (live(settings, *world) for world in worlds)
        return
    with ProcessPoolExecutor(settings.processes) as pool:
        yield from pool.map(live, [settings] * len(worlds), *zip(*worlds, strict=True))


def building_of(settings: Settings, seed: int, patrol_s: int) -> BuildingSimulation:
    """The world of one seed and one length of patrols, or the harder one."""
    config = BuildingConfig(days=settings.sessions, change_rate=settings.change_rate)
    if patrol_s == HARD:
        config = replace(
            config,
            patrol_lengths_s=HARD_LENGTHS_S,
            doors=ROOM_DOORS,
            wing_opens_day=settings.sessions // 2,
            classes=(*DEFAULT_CLASSES, CLUTTER),
        )
    else:
        config = replace(config, patrol_s=float(patrol_s))
    return simulate_building(config, seed)


def live(settings: Settings, seed: int, patrol_s: int) -> Row:
    """All sessions of one world into one map, and what it said after each."""
    from evermap.config import Config, LivingConfig
    from evermap.pipeline import run_session

    config = Config(living=LivingConfig(accept="any"))  # the map goes on whatever the verdict
    building = building_of(settings, seed, patrol_s)
    truth = _Truth.of(building)
    living: LivingMap | None = None
    told: list[Row] = []
    after: list[Row] = []
    beliefs: list[tuple[float, bool, bool]] = []
    forecasts: list[tuple[float, bool]] = []
    for k, recording in enumerate(building.sessions):
        session = run_session(recording, living, config)
        living = session.living
        pose = truth.alignment(living, k)
        told += [
            {
                "session": k,
                "landmark": name,
                "kind": change.kind.value,
                "p": change.probability,
                "true": truth.changed_within(name, change.stamp_from_s, k),
                "never": bool(truth.never[name]),
                "looks": change.n_hits + change.n_misses,
                **truth.displacement_scores(change, name, k, pose),
            }
            for change in session.changes
            for name in change.landmark_ids
        ]
        after.append({"session": k, "found": session.found, **truth.map_scores(living, k, pose)})
        beliefs += truth.beliefs(living, k, pose)
        if k + 1 < len(building.sessions):
            forecasts += truth.forecasts(living, k, pose)
    return {
        "seed": seed,
        "patrol_s": patrol_s,
        "told": told,
        "after": after,
        "changes": truth.looked_at_changes(told),
        "forecasts": forecasts,
        "beliefs": beliefs,
    }


@dataclass(frozen=True, slots=True)
class _Truth:
    """S sessions of L landmarks.

    Attributes:
        start_s: (S,) begin of the sessions.
        position_m: (S, L, 2), nan while away.
        never: (L,) stood still all the time.
        looks: of every place.
    """

    start_s: FloatArray
    position_m: FloatArray
    never: BoolArray
    looks: LookedAt

    @classmethod
    def of(cls, building: BuildingSimulation) -> _Truth:
        from evermap_studies.demo.truth import truth_of

        truth = truth_of(building)
        still = np.all(truth.position_m == truth.position_m[:1], axis=(0, 2))
        start_s = np.array([session.start_s for session in building.truths])
        return cls(start_s, truth.position_m, still, looked_at(building))

    def changed_within(self, name: int, from_s: float, session: int) -> bool:
        """Whether a landmark changed between the session that begins before a stamp and another."""
        path = self.position_m[self._session_at(from_s) : session + 1, name]
        return bool(np.any(~_same(path[1:], path[:-1])))

    def _session_at(self, stamp_s: float) -> int:
        """The newest session that begins by a stamp; the first where there is none."""
        return max(int(np.searchsorted(self.start_s, stamp_s, side="right")) - 1, 0) if np.isfinite(stamp_s) else 0

    def displacement_scores(self, change: MapChange, name: int, session: int, pose: FloatArray) -> Row:
        """By how much a landmark moved that is told to have moved, how far off that is [m], and how many squared
        standard deviations; nothing of another change, and of what was not there before and after.
        """
        if change.kind is not ChangeKind.MOVED or not change.displacement_covariance_m2:
            return {}
        path = self.position_m[self._session_at(change.stamp_from_s) : session + 1, name]
        moved, told = path[-1] - path[0], se2.rotation(float(pose[2])) @ np.asarray(change.displacement_m)
        error, turn = told - moved, se2.rotation(float(pose[2]))
        if len(change.landmark_ids) > 1 or not np.isfinite(moved).all():  # of a body it is that of its middle
            return {}
        spread = turn @ np.array(change.displacement_covariance_m2) @ turn.T
        squared = float(error @ np.linalg.solve(spread, error))
        return {"moved_m": float(np.hypot(*moved)), "error_m": float(np.hypot(*error)), "squared": squared}

    def beliefs(self, living: LivingMap, session: int, pose: FloatArray) -> list[tuple[float, bool, bool]]:
        """For every landmark that the map knows: P(exists) at a session, whether it stands at one of its known places,
        and whether this session saw it. Left out is what has no place where its body stands most probably.

        The map of a session that is not found in it is that of the one before, so it is asked about now; and what was
        moved by less than an outlier has left its place, though it stands near.
        """
        places, members = living.places, living.members
        known = living.place_row(members.landmark_id, living.site_of()) >= 0
        stands = self.position_m[session, places.landmark_id]
        gap = np.hypot(*(se2.transform(pose, places.position_m) - stands).T)
        seen_s = living.sites.seen_s[np.searchsorted(living.sites.site_id, places.site_id)]
        when = np.clip(np.searchsorted(self.start_s, seen_s, side="right") - 1, 0, session)
        stayed = _same(self.position_m[when, places.landmark_id], stands)
        right = np.isin(members.landmark_id, places.landmark_id[stayed & (gap < OUTLIER_M)])  # False for nan
        seen = np.isin(members.landmark_id, places.landmark_id[seen_s >= self.start_s[session]])
        p = living.p_exists(max(living.stamp_s, float(self.start_s[session])))
        return list(zip(p[known].tolist(), right[known].tolist(), seen[known].tolist(), strict=True))

    def alignment(self, living: LivingMap, session: int) -> FloatArray:
        """(3,) the map in the frame of the truth, by the landmarks that lie where they stand."""
        from evermap.align.candidates import Matches, find_consensus

        claimed = living.landmarks(p_least=0.5)
        still = self._still(claimed, session)
        at = self.position_m[session, claimed.landmark_id]
        pose, agree = find_consensus(Matches.of(claimed.position_m[still], at[still]))
        return pose if agree.any() else np.zeros(3)

    def _still(self, claimed: Landmarks, session: int) -> BoolArray:
        """(C,) which landmarks of a map stand where they stood when it saw them last."""
        seen = np.clip(np.searchsorted(self.start_s, claimed.last_seen_s, side="right") - 1, 0, session)
        then = self.position_m[seen, claimed.landmark_id]
        now = self.position_m[session, claimed.landmark_id]
        return np.asarray(np.isfinite(now[:, 0]) & _same(then, now))

    def map_scores(self, living: LivingMap, session: int, pose: FloatArray) -> Row:
        """Claims that are made with 0.9 or more, and errors of what stands about where the map has it."""
        claimed = living.landmarks(p_least=0.5)
        sure = claimed.p_exists >= 0.9
        there = np.flatnonzero(np.isfinite(self.position_m[session, :, 0]))
        now = Landmarks.at(there, self.position_m[session, there])
        error = se2.transform(pose, claimed.position_m) - self.position_m[session, claimed.landmark_id]
        still = self._still(claimed, session)
        right = still & (np.hypot(*error.T) < OUTLIER_M)  # False for nan
        turn = se2.rotation(float(pose[2]))
        covariance = turn @ claimed.covariance_m2[right] @ turn.T
        squared = np.einsum("ni,ni->n", error[right], np.linalg.solve(covariance, error[right][..., None])[..., 0])
        centred = error[right] - error[right].mean(axis=0) if right.any() else error[right]
        arm = claimed.position_m[right] - claimed.position_m[right].mean(axis=0) if right.any() else error[right]
        turned = arm @ turn.T
        size = float((turned * centred).sum() / max((turned**2).sum(), 1e-9)) if right.any() else 0.0
        rest = centred - size * turned
        return {
            "n_sure": int(sure.sum()),
            "n_sure_right": int((sure & stands_at(claimed, now, pose, 0.5)).sum()),
            "n_errors": int(right.sum()),
            "n_wrong": int((still & ~right).sum()),
            "squared_error_m2": float((error[right] ** 2).sum()),
            "squared_shape_error_m2": float((rest**2).sum()),
            "size_error": size,
            "nees": float(squared.sum()),
        }

    def forecasts(self, living: LivingMap, session: int, pose: FloatArray) -> list[tuple[float, bool]]:
        """For every landmark that the map knows: P(it stands at its place in the next session), and whether it did."""
        from evermap.config import LivingConfig
        from evermap.maps.sessions.believe import aged

        next_s = float(self.start_s[session + 1])
        if next_s < living.stamp_s or not len(living.sites):
            return []
        p_next = aged(living, LivingConfig(), next_s).p_here
        records = living.landmarks()
        row = living.place_row(records.landmark_id, _site_of(living, records.landmark_id))
        p = p_next[np.searchsorted(living.sites.site_id, living.places.site_id[row])]
        gap = se2.transform(pose, records.position_m) - self.position_m[session + 1, records.landmark_id]
        return [(float(a), bool(b)) for a, b in zip(p, np.hypot(*gap.T) < OUTLIER_M, strict=True)]

    def looked_at_changes(self, told: list[Row]) -> list[Row]:
        """True changes of landmarks that were looked at before and after, and whether they were told."""
        n = len(self.start_s)
        places = {name: np.flatnonzero(self.looks.landmark_id == name) for name in range(len(self.never))}
        seen = self.looks.looked_at
        when: dict[int, list[int]] = {}
        for row in told:
            when.setdefault(row["landmark"], []).append(row["session"])
        found: list[Row] = []
        for name in np.flatnonzero(~self.never).tolist():
            path = self.position_m[:, name]
            events = [k for k in range(n - 1) if not _same(path[k], path[k + 1])]
            for at, k in enumerate(events):
                until = events[at + 1] + 1 if at + 1 < len(events) else n
                since = events[at - 1] + 1 if at else 0
                old, new = (_place(self.looks, places[name], path[j]) for j in (k, k + 1))
                # before: it was seen where it stood, or its new place was seen empty
                before = range(since, k + 1)
                known = any(seen[j, old] for j in before) if old >= 0 else any(seen[j, new] for j in before)
                after = [j for j in range(k + 1, until) if (new >= 0 and seen[j, new]) or (old >= 0 and seen[j, old])]
                if old < 0:  # it came: it must be seen there
                    after = [j for j in range(k + 1, until) if seen[j, new]]
                if not known or not after:
                    continue
                sessions = [j for j in when.get(name, []) if k < j < until]
                kind = "came" if old < 0 else "left" if new < 0 else "moved"
                at_once = any(j <= after[0] for j in sessions)
                found.append({"landmark": name, "kind": kind, "at_once": at_once, "told": bool(sessions)})
        return found


def _same(a: FloatArray, b: FloatArray) -> BoolArray:
    """Whether positions (..., 2) are the same, nan for nan."""
    return np.asarray(np.all((a == b) | (np.isnan(a) & np.isnan(b)), axis=-1))


def _place(looks: LookedAt, rows: IntArray, position_m: FloatArray) -> int:
    """The row of the place at a position; -1 while it is away."""
    if np.isnan(position_m[0]) or not len(rows):
        return -1
    return int(rows[np.argmin(np.hypot(*(looks.position_m[rows] - position_m).T))])


def _site_of(living: LivingMap, names: IntArray) -> IntArray:
    return np.asarray(living.site_of()[np.searchsorted(living.members.landmark_id, names)])
