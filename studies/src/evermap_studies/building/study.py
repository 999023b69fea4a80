"""A living map in space, four weeks in a building of which a robot sees a part each day, against the truth.

Six-day drives and one walk by hand a week. Scored are existence, reported changes, displacements, lifetimes and poses;
the poses beside those of an oracle that knows the true map of each day, and all of it beside the papers' methods alone,
which are the same engine with parts switched off, and of evermap where nothing changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.maps.living import LivingMap
from evermap.types import BoolArray, ChangeKind, FloatArray, IntArray, MapChange, Progress, SlamResult, SpatialRecording
from evermap_studies.building.patrol import DAY_S, Patrol, patrolled
from evermap_studies.building.table import UNCHANGED, as_markdown
from evermap_studies.building.world import FIXED, KINDS, World, made
from evermap_studies.demo.methods import METHODS
from evermap_studies.demo.truth import observed
from evermap_studies.frame import Stopwatch, check_least
from evermap_studies.sim.looked import LookedAt
from evermap_studies.worlds.scores import NEAR_M

__all__ = ["QUICK", "Settings", "as_markdown", "reproduce"]

Row = dict[str, Any]
SCHEMA_VERSION = "1"
EXPERIMENT = "building"
COMPARED = ("evermap", UNCHANGED, "rosen2016", "bateman2020", "nielsen2024")
BY_HAND = 3
"""Day of the week on which the cameras are carried."""
AGREE_M = 0.5
"""Landmarks that never move and are farther off than this do not take part in the alignment."""
SCORING = (
    "every reported change by landmark: right where it came, left or moved within the reported interval; a true change "
    "can be known where its old state was seen and its new one looked at (5 detections to expect); existence: 'it "
    f"stands within {NEAR_M} m of where the map has it', for every landmark that the map knows, after each session; "
    "forecasts: the same a day later; poses in the frame of what never moves, root mean square; lifetimes: median by "
    "the map over the median that was drawn from"
)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is run; the defaults are everything.

    Attributes:
        worlds: simulated buildings, counted up from the seed.
        days: sessions, one a day.
        seed: of the first building.
        methods: compared beside evermap, in the first building only.
    """

    worlds: int = 2
    days: int = 28
    seed: int = 0
    methods: tuple[str, ...] = COMPARED

    def __post_init__(self) -> None:
        check_least(self, worlds=1, days=2, seed=0)


QUICK = Settings(worlds=1, days=8)
"""A minute."""


def reproduce(
    out: str | Path, settings: Settings | None = None, *, progress: Progress | None = None, force: bool = False
) -> dict[str, Any]:
    """Run everything, and write `summary.json`, `table.md` and the figures.

    Args:
        out: folder for the results; untouched if this run fails.
        settings: what to run; None for everything.
        progress: told after every session.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `runs` (a dictionary a world and method), `settings`, `machine`; plain JSON values.

    Raises:
        ConfigError: `out` must not be replaced.
    """
    from evermap.runs.folder import RunFolder
    from evermap_studies.building.figures import draw_existence, draw_map
    from evermap_studies.frame import save_all

    settings = settings or Settings()
    todo = [
        (settings.seed + k, method)
        for k in range(settings.worlds)
        for method in (settings.methods if not k else COMPARED[:1])
    ]
    with RunFolder(out, force=force) as folder:
        stopwatch, runs, shown = Stopwatch(), [], None
        for number, (seed, method) in enumerate(todo):
            story = story_of(seed, settings.days, changes=method != UNCHANGED)

            def tell(day: float, done: int = number) -> None:
                if progress is not None:
                    progress(done * settings.days + day, float(len(todo) * settings.days))

            run, living = live(story, method, tell)
            runs.append(run)
            shown = shown or (story, living, run)
        content: dict[str, Any] = {**stopwatch.head(EXPERIMENT, SCHEMA_VERSION, SCORING, settings), "runs": runs}
        assert shown is not None
        save_all({"map": draw_map(*shown), "existence": draw_existence(content)}, folder.path)
        folder.path("table.md").write_text(as_markdown(content) + "\n", encoding="utf-8")
        return folder.finish(content)


@dataclass(frozen=True, slots=True)
class Story:
    """What truly happens in D sessions, and what is recorded of it.

    Attributes:
        seed: of it.
        world: what stands where.
        position_m: (D, L, 3) of landmarks, nan while away.
        patrols: the sessions.
        knowable: (N, 4) changes that can be known, as in the demo.
        seen: (D, L) landmarks that were looked at where they stood.
    """

    seed: int
    world: World
    position_m: FloatArray
    patrols: tuple[Patrol, ...]
    knowable: IntArray
    seen: BoolArray

    def changed(self, name: int, change: MapChange, session: int) -> bool:
        """Whether a landmark came, left or moved between the sessions of a reported change."""
        path = self.position_m[self.begin(change) : session + 1, name]
        return bool(np.any(~((path[1:] == path[:-1]) | (np.isnan(path[1:]) & np.isnan(path[:-1])))))

    def begin(self, change: MapChange) -> int:
        """The last session that began before the change."""
        if not np.isfinite(change.stamp_from_s):
            return 0
        start_s = self.world.stamp_days * DAY_S
        return max(int(np.searchsorted(start_s, change.stamp_from_s, side="right")) - 1, 0)

    def alignment(self, living: LivingMap, session: int) -> FloatArray:
        """(7,) the map in the frame of the truth, by what never moves."""
        claimed = living.landmarks(p_least=0.5)
        fixed = np.isin(self.world.class_id[claimed.landmark_id % len(self.world.of)], _FIXED_ROWS)
        fixed &= claimed.landmark_id < len(self.world.of)
        mine, true = claimed.position_m[fixed], self.position_m[session, claimed.landmark_id[fixed]]
        pose = rigid(mine, true)
        for _ in range(3):
            near = np.linalg.norm(se3.transform(pose, mine) - true, axis=1) < AGREE_M
            pose = rigid(mine[near], true[near]) if near.sum() >= 3 else pose
        return np.asarray(pose)


_FIXED_ROWS = [row for row, kind in enumerate(KINDS) if kind.name in FIXED]


def story_of(seed: int, days: int, *, changes: bool = True) -> Story:
    """Make a building and record it."""
    world = made(seed, days, changes=changes)
    position_m = world.positions()
    place = {
        (name, tuple(at)): (name, day)
        for day in range(days)
        for name, at in enumerate(position_m[day].tolist())
        if at[0] == at[0]
    }
    names, first = (np.array(column) for column in zip(*sorted(place.values()), strict=True))
    at = position_m[first, names]
    patrols = tuple(patrolled(world, day, seed, names, first, day % 7 == BY_HAND) for day in range(days))
    present = np.all(position_m[:, names] == at, axis=2)
    looks = LookedAt(names, at, present, np.array([patrol.looked for patrol in patrols], dtype=np.float64))
    seen = np.zeros(position_m.shape[:2], dtype=np.bool_)
    day, row = np.nonzero(present & looks.looked_at)
    seen[day, names[row]] = True
    return Story(seed, world, position_m, patrols, observed(looks, len(world.of))[1], seen)


def live(story: Story, method: str, tell: Any = None) -> tuple[Row, LivingMap]:
    """All sessions of a building into one map by one method, and what it said after each."""
    from evermap.config import Config, LivingConfig
    from evermap.pipeline import run_session, run_slam

    engine = COMPARED[0] if method == UNCHANGED else method
    switches = next(dict(m.switches) for m in METHODS if m.name == engine)
    config = Config(living=LivingConfig.model_validate({"accept": "any", **switches}))
    living: LivingMap | None = None
    found: dict[str, list[Any]] = {key: [] for key in ("sessions", "told", "statements", "forecasts")}
    for k, patrol in enumerate(story.patrols):
        session = run_session(patrol.recording, living, config)
        living = session.living
        pose = story.alignment(living, k)
        row: Row = {
            "session": k,
            "found": session.found,
            "by_hand": patrol.recording.odometry is None,
            "known": len(living.members),
        }
        if session.found:
            row |= _pose_errors(session.slam, patrol.recording, pose)
        if engine == COMPARED[0]:
            truth = run_slam(patrol.recording, prior_map=patrol.recording.true_landmarks)
            row |= {
                f"oracle_{key}": value for key, value in _pose_errors(truth, patrol.recording, se3.identity()).items()
            }
        found["sessions"].append(row | _consistency(story, living, k, pose))
        if k:
            found["told"] += [row for change in session.changes for row in _scored(story, change, k, pose)]
        found["statements"] += _statements(story, living, k, k, pose)
        if k + 1 < len(story.patrols):
            found["forecasts"] += _statements(story, living, k, k + 1, pose)
        if tell is not None:
            tell(float(k + 1))
    assert living is not None
    run: Row = {"seed": story.seed, "method": method, **found, "changes": _knowable(story, found["told"])}
    return run | {"lifetimes": _lifetimes(living)}, living


def _pose_errors(slam: SlamResult, recording: SpatialRecording, pose: FloatArray) -> Row:
    """Root mean square errors of positions in the map and aligned by themselves, and the largest."""
    assert recording.truth is not None
    row = np.searchsorted(recording.truth.stamp_s, slam.trajectory.stamp_s - 1e-3)
    true, mine = recording.truth.pose_world_robot[row, :3], slam.trajectory.pose_world_robot[:, :3]
    error = np.linalg.norm(se3.transform(pose, mine) - true, axis=1)
    alone = np.linalg.norm(se3.transform(rigid(mine, true), mine) - true, axis=1)
    root = [float(np.sqrt(np.mean(e**2))) for e in (error, alone)]
    return {
        "pose_m": root[0],
        "aligned_m": root[1],
        "median_m": float(np.median(error)),
        "largest_m": float(error.max()),
        "located": len(row) / len(recording.frames),
    }


def _consistency(story: Story, living: LivingMap, session: int, pose: FloatArray) -> Row:
    """Errors of the landmarks that stand about where the map has them: squared, and by the map's covariances."""
    records = living.landmarks(p_least=0.5)
    own = np.flatnonzero(records.landmark_id < len(story.world.of))
    error = se3.transform(pose, records.position_m[own]) - story.position_m[session, records.landmark_id[own]]
    right = np.linalg.norm(error, axis=1) < NEAR_M
    turn = se3.rotation_of(pose)
    covariance = turn @ records.covariance_m2[own[right]] @ turn.T
    nees = np.einsum("ni,ni->n", error[right], np.linalg.solve(covariance, error[right][..., None])[..., 0])
    return {"n_errors": int(right.sum()), "squared_m2": float((error[right] ** 2).sum()), "nees": float(nees.sum())}


def _scored(story: Story, change: MapChange, session: int, pose: FloatArray) -> list[Row]:
    """A reported change by landmark."""
    names = [name for name in change.landmark_ids if name < len(story.world.of)]
    before, now = (story.position_m[k, names] for k in (story.begin(change), session))
    true = now.mean(axis=0) - before.mean(axis=0) if names else np.full(3, np.nan)
    told = se3.rotation_of(pose) @ np.array(change.displacement_m)
    error = float(np.linalg.norm(told - true)) if change.kind in (ChangeKind.MOVED, ChangeKind.ROTATED) else np.nan
    still = np.all((story.position_m == story.position_m[:1]) | np.isnan(story.position_m), axis=(0, 2))
    still &= np.isfinite(story.position_m).all(axis=(0, 2)) | np.isnan(story.position_m).all(axis=(0, 2))
    return [
        {
            "session": session,
            "since": story.begin(change),
            "landmark": name,
            "kind": change.kind.value,
            "p": change.probability,
            "true": name < len(story.world.of) and story.changed(name, change, session),
            "never": name >= len(story.world.of) or bool(still[name]),
            "looks": change.n_hits + change.n_misses,
            "error_m": error if np.isfinite(error) else None,
        }
        for name in change.landmark_ids
    ]


def _statements(
    story: Story, living: LivingMap, session: int, asked: int, pose: FloatArray
) -> list[tuple[float, bool]]:
    """P(it stands at its place in a session) of every landmark that the map knows, and whether it does."""
    at_s = float(story.world.stamp_days[asked]) * DAY_S if asked > session else None
    records = living.landmarks(at=at_s)
    own = records.landmark_id < len(story.world.of)
    gap = se3.transform(pose, records.position_m[own]) - story.position_m[asked, records.landmark_id[own]]
    near = np.linalg.norm(gap, axis=1) < NEAR_M
    false = [(float(p), False) for p in records.p_exists[~own]]
    return [(float(p), bool(b)) for p, b in zip(records.p_exists[own], near, strict=True)] + false


def _knowable(story: Story, told: list[Row]) -> list[Row]:
    """Changes that can be known, and whether they were reported."""
    found = []
    for name, first, at, until in story.knowable.tolist():
        when = [row["session"] for row in told if row["landmark"] == name and first <= row["session"] < until]
        here, before = story.seen[at, name], story.seen[:at, name].any()
        kind = "is elsewhere or again" if here and before else "is new" if here else "is gone"
        found.append(
            {"landmark": name, "kind": kind, "session": at, "told": bool(when), "at_once": any(k <= at for k in when)}
        )
    return found


def _lifetimes(living: LivingMap) -> dict[str, Row]:
    """Median stay by class, by the map and as drawn."""
    found = {}
    for kind in KINDS:
        name = list(living.class_names).index(kind.name)
        life, mine = living.lives.of(name), living.stays.class_id == name
        found[kind.name] = {
            "median_days": float(np.ravel(life.stay.quantile([0.5]))[0] / DAY_S),
            "true_days": float(np.log(2.0) * kind.stay_days) if np.isfinite(kind.stay_days) else None,
            "n_stays": int(mine.sum()),
            "n_ended": int(np.isfinite(living.stays.gone_s[mine]).sum()),
        }
    return found
