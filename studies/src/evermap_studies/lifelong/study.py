"""Sessions of real robots into one map, while landmarks move, leave and come back between them; MATH.md section 5.

Three questions: what five robots' sessions do to a map, by method; whether error, size and cost stay the same over a
long life; and what each part of the engine contributes, on the recordings and in a simulated building.
Each part can be run alone: what an older run left of the others stays in the tables.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evermap.errors import ConfigError
from evermap.types import Progress
from evermap_studies.frame import Stopwatch, check_least
from evermap_studies.lifelong.runs import ABLATIONS, CONTENDERS, SIMULATED, WHOLE, Contender, live
from evermap_studies.lifelong.scores import NOTHING
from evermap_studies.lifelong.table import as_markdown, verdicts
from evermap_studies.lifelong.world import DATASET, recorded_world, simulated_world
from evermap_studies.mrclam.study import find_dataset
from evermap_studies.rows import RowsFile, run_missing

Row = dict[str, Any]

SCHEMA_VERSION = "1"
EXPERIMENT = "lifelong"
SIMULATED_PART = "ablation-simulated"
PARTS = ("five", "fifty", "ablation-recorded", SIMULATED_PART)
SCORING = (
    "poses at 2 Hz and landmarks in the frame of the map, tied to the truth once, by the landmarks of the first "
    "session's map; landmarks that are there and that the map believes in (p >= 0.5), however far off; a claim is "
    "right within 0.25 m; Brier scores of 'the landmark stands where it stood last' for all that were ever detected, "
    "now and, as a forecast, in the next session; changes by landmark and kind; nothing is left out"
)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is run; the defaults are everything.

    Attributes:
        parts: of `PARTS`.
        seeds: scripts of changes for the five sessions, and for the ablation on recordings.
        short, long: sessions of a short and of a long life.
        long_contenders: names of those who live long.
        buildings, days: simulated buildings of the ablation, and how long they are visited, twice a day.
        seed: of everything random; scripts and buildings count up from it.
    """

    parts: tuple[str, ...] = PARTS
    seeds: int = 5
    short: int = 5
    long: int = 50
    long_contenders: tuple[str, ...] = (CONTENDERS[0].name, WHOLE.name, CONTENDERS[-1].name)
    buildings: int = 4
    days: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        unknown = [part for part in self.parts if part not in PARTS]
        if unknown:
            raise ConfigError(f"no part {unknown[0]}", field="part", hint=" | ".join(PARTS))
        check_least(self, seeds=1, short=2, long=5, buildings=1, days=1, seed=0)


QUICK = Settings(seeds=1, long=10, buildings=1, days=3)
"""Minutes: one script, one building, a tenth of everything."""


@dataclass(frozen=True, slots=True)
class Job:
    """Who lives in one world."""

    part: str
    seed: int
    contenders: tuple[Contender, ...]
    sessions: int

    @property
    def is_simulated(self) -> bool:
        """In a simulated building."""
        return self.part == SIMULATED_PART


def reproduce(
    data: str | Path,
    out: str | Path,
    settings: Settings | None = None,
    *,
    progress: Progress | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Run what is asked for, and write `summary.json`, `table.md` and the figures of all that is known by then.

    Args:
        data: folder with the MRCLAM recordings.
        out: folder; rows of an older run of parts that were not asked for are kept, all else is replaced. Untouched if
            this run fails, but for the rows beside it, from which it goes on.
        settings: everything where None.
        progress: told after every life of a map.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `rows` (a dictionary a session), `expected`, `settings`, `machine`; plain JSON values.

    Raises:
        InputError: a recording is missing or malformed.
        ConfigError: `out` must not be replaced.
    """
    from evermap.runs.folder import RunFolder
    from evermap_studies.frame import save_all

    settings = settings or Settings()
    if set(settings.parts) != {SIMULATED_PART}:
        find_dataset(Path(data), DATASET)
    kept, file = [row for row in _earlier(Path(out)) if row["part"] not in settings.parts], RowsFile.beside(out)
    with RunFolder(out, force=force, inputs=[data]) as folder:
        stopwatch = Stopwatch()
        rows = [*kept, *_run_all(settings, Path(data), file, progress)]
        rows.sort(key=lambda row: PARTS.index(row["part"]))
        table: dict[str, Any] = {
            **stopwatch.head(EXPERIMENT, SCHEMA_VERSION, SCORING, settings),
            "expected": verdicts(rows),
            "rows": rows,
        }
        save_all(_figures(rows), folder.path)
        folder.path("table.md").write_text(as_markdown(table) + "\n", encoding="utf-8")
        table = folder.finish(table)
    file.remove()
    return table


def jobs(settings: Settings) -> list[Job]:
    """All that the settings ask for."""
    scripts = range(settings.seed, settings.seed + settings.seeds)
    buildings = range(settings.seed, settings.seed + settings.buildings)
    long_lived = tuple(who for who in CONTENDERS if who.name in settings.long_contenders)
    planned = {
        "five": [Job("five", seed, CONTENDERS, settings.short) for seed in scripts],
        "fifty": [Job("fifty", settings.seed, long_lived, settings.long)],
        "ablation-recorded": [Job("ablation-recorded", seed, ABLATIONS, settings.short) for seed in scripts],
        SIMULATED_PART: [Job(SIMULATED_PART, seed, ABLATIONS, 2 * settings.days) for seed in buildings],
    }
    return [job for part in PARTS if part in settings.parts for job in planned[part]]


def _run_all(settings: Settings, data: Path, file: RowsFile, progress: Progress | None) -> Iterator[Row]:
    """Yield all rows; those of a life that is in the file are not run again."""
    from evermap.slam.warmup import warm_up

    warm_up()  # compiling is no part of the first session
    planned = jobs(settings)
    total, done = sum(job.sessions * len(job.contenders) for job in planned), 0
    keys = [(job.part, job.seed, job.sessions, [who.name for who in job.contenders]) for job in planned]
    of_key = {str(key): job for key, job in zip(keys, planned, strict=True)}
    for life in run_missing(file, keys, lambda missing: (_life(of_key[str(key)], data) for key in missing)):
        done += len(life["sessions"])
        if progress is not None:
            progress(done, total)
        yield from life["sessions"]


def _life(job: Job, data: Path) -> Row:
    """Return the rows of all sessions of a job."""
    if job.is_simulated:
        world = simulated_world(job.sessions // 2, job.seed)
    else:
        world = recorded_world(data, job.sessions, job.seed)
    lived = live(world, job.contenders, SIMULATED if job.is_simulated else ())
    return {"sessions": [{"part": job.part, "seed": job.seed, **row} for row in lived]}


def _figures(rows: list[Row]) -> dict[str, Any]:
    from evermap_studies.lifelong.figures import draw_errors, draw_flat

    few, many = ([row for row in rows if row["part"] == part] for part in ("five", "fifty"))
    figures = {}
    if few:
        figures["five"] = draw_errors(few)
    if many:
        figures["fifty"] = draw_errors(many)
        figures["flat"] = draw_flat(many)
    return figures


def _earlier(out: Path) -> list[Row]:
    """Rows that an older run left; none where there is none of this schema."""
    try:
        table = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    if table.get("experiment") != EXPERIMENT or table.get("schema_version") != SCHEMA_VERSION:
        return []
    return [row for row in table["rows"] if NOTHING.keys() <= row.keys()]


__all__ = ["PARTS", "QUICK", "Settings", "as_markdown", "reproduce"]
