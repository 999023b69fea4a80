"""What is learned about lifetimes, beside the truth (Bateman 2020, chapter 4 and section 5.2).

Four questions: does a tracker in the thesis' simulation learn for how long things park; do the bands of what is
learned from months of irregular patrols hold the truth as often as they say; how far are bands and forecasts from those
of who knows the law, under six unlike ones, with and without truncation; and what remains of real stays, known to
the minute, if somebody looks only now and then.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from evermap import __version__
from evermap.errors import ConfigError
from evermap.types import Progress
from evermap_studies.lifetimes import figures, laws
from evermap_studies.lifetimes.moving import TrackedRun, study
from evermap_studies.lifetimes.rooms import as_values, study_rooms
from evermap_studies.lifetimes.table import as_markdown
from evermap_studies.lifetimes.truth import ESTIMATORS, coverage, judge
from evermap_studies.presence.tasks import HOME
from evermap_studies.worlds.moving import MovingWorld
from evermap_studies.worlds.patrol_lifetimes import PatrolWorld, simulate_patrols

SCHEMA_VERSION = "1"
ROOMS = HOME
"""File with the recording of rooms."""
EXPECTED_COVERAGE = 0.93
RECORDED_EVERY = 5
"""Frames between two in the recording."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What is simulated.

    Attributes:
        moving: the thesis' simulation.
        moving_runs: of it, whose stays are learned from together.
        patrols: months of patrols.
        repetitions: of them.
        law_repetitions: samples of each size that are drawn from each of the six laws.
        law_counts: these sizes.
        seed: of everything random.
    """

    moving: MovingWorld = field(default_factory=MovingWorld)
    moving_runs: int = 6
    patrols: PatrolWorld = field(default_factory=PatrolWorld)
    repetitions: int = 10
    law_repetitions: int = 20
    law_counts: tuple[int, ...] = (30, 100, 400)
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("moving_runs", "repetitions", "law_repetitions"):
            if getattr(self, name) < 1:
                raise ConfigError(f"must be positive, not {getattr(self, name)}", field=name)
        if self.seed < 0:
            raise ConfigError(f"must not be negative, not {self.seed}", field="seed")


def reproduce(
    out: str | Path,
    settings: Settings | None = None,
    *,
    data: str | Path | None = None,
    progress: Progress | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Compute all values, and write `summary.json`, `table.md`, the figures as PNG and SVG, and a recording.

    Args:
        out: folder; replaced if it holds an older reproduction, untouched if this one fails.
        settings: the defaults where None.
        data: folder with the recording of rooms; None leaves the rooms out.
        progress: told as runs are done.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `moving`, `truth`, `laws` and `rooms` (a dictionary a row each), `coverage` by estimator; plain JSON values.

    Raises:
        InputError: the recording of rooms is missing or malformed.
        ConfigError: `out` must not be replaced.
    """
    from evermap.runs.folder import RunFolder
    from evermap.runs.summary import versions
    from evermap_studies.frame import save_all

    settings = settings or Settings()
    total = settings.moving_runs + settings.repetitions + 2.0

    def tell(done: float) -> None:
        if progress is not None:
            progress(done, total)

    with RunFolder(out, force=force, inputs=[data]) as folder:
        start = time.perf_counter()
        rooms = [] if data is None else study_rooms(Path(data))
        tracked, moving, learned = study(settings.moving, settings.moving_runs, settings.seed, tell)
        truth = judge(
            settings.patrols, settings.repetitions, settings.seed, lambda done: tell(settings.moving_runs + done)
        )
        by_law = laws.judge(settings.law_counts, settings.law_repetitions, settings.seed)
        tell(total - 1.0)
        table: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "evermap": __version__,
            "experiment": "lifetimes",
            "settings": {
                "seed": settings.seed,
                "moving_runs": settings.moving_runs,
                "repetitions": settings.repetitions,
                "law_repetitions": settings.law_repetitions,
                "objects": settings.patrols.objects,
                "duration_s": settings.patrols.duration_s,
                "p_detect": settings.patrols.p_detect,
            },
            "versions": versions(),
            "expected_coverage": EXPECTED_COVERAGE,
            "coverage": {name: coverage(truth, name) for name in ESTIMATORS},
            "moving": moving,
            "truth": truth,
            "laws": by_law,
            "rooms": as_values(rooms),
        }
        example = simulate_patrols(settings.patrols, np.random.SeedSequence(settings.seed).spawn(1)[0])
        drawn = {
            "tracks": figures.draw_scene(tracked),
            "moving": figures.draw_moving(tracked, learned),
            "truth": figures.draw_truth(example),
            "coverage": figures.draw_coverage(truth, example),
        }
        if rooms:
            drawn["rooms"] = figures.draw_rooms(rooms)
        save_all(drawn, folder.path)
        _record(tracked, folder.path("tracks.rrd"))
        table["processing_s"] = time.perf_counter() - start
        folder.path("table.md").write_text(as_markdown(table) + "\n", encoding="utf-8")
        table = folder.finish(table)
        tell(total)
    return table


def _record(tracked: TrackedRun, path: Path) -> None:
    """The first run, if rerun-sdk is installed."""
    from evermap.errors import MissingExtraError
    from evermap.viz.rerun_scene import log_tracks

    kept = slice(None, None, RECORDED_EVERY)
    followed = tracked.followed[kept]
    try:
        log_tracks(
            path,
            stamp_s=tracked.run.stamp_s[kept],
            track_id=[now.track_id for now in followed],
            position_m=[now.position_m for now in followed],
            static=[now.static for now in followed],
            resting_m=tracked.resting_m[kept],
            sensor_m=tracked.run.sensor_m[kept],
            reach_m=tracked.run.world.reach_m,
        )
    except MissingExtraError:
        return


__all__ = ["ROOMS", "Settings", "as_markdown", "reproduce"]
