"""Things that come and go: evermap's models of presence against simple ones and against published numbers.

Two recordings: eight landmarks of a room, seen by a detector that errs, and an office door over ten weeks. All that is
learned and chosen comes from the training files; the test files are only scored.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from evermap import __version__
from evermap.errors import ConfigError
from evermap.existence.protocol import Instants
from evermap.types import FloatArray, Progress
from evermap_studies.presence import models
from evermap_studies.presence.figures import draw_all
from evermap_studies.presence.models import Contender
from evermap_studies.presence.scores import (
    SURE,
    beliefs,
    choose_by_looks,
    choose_for_week,
    door_scores,
    kept,
    mean_scores,
    room_scores,
    week_scores,
)
from evermap_studies.presence.table import PUBLISHED, as_markdown, judged
from evermap_studies.presence.tasks import (
    NOISE_SEEDS,
    P_FALSE,
    P_MISS,
    TASKS,
    Door,
    RoomFeature,
    Task,
    Trial,
    read_door,
    read_home,
    read_room,
)

SCHEMA_VERSION = "1"


@dataclass(slots=True)
class Found:
    """Beliefs that the figures show.

    Attributes:
        trials: the test weeks of the door under each task.
        door: (R, N) beliefs of each week, by task and contender.
        room: (N,) beliefs by contender, of each landmark.
    """

    trials: dict[str, list[Trial]] = field(default_factory=dict)
    door: dict[tuple[str, str], list[FloatArray]] = field(default_factory=dict)
    room: dict[str, list[FloatArray]] = field(default_factory=dict)


def reproduce(
    data: str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Learn, choose, predict and score; write `summary.json`, `table.md` and the figures as PNG and SVG.

    Args:
        data: folder with `room_train.csv.gz`, `room_test.csv.gz` and `door_2016_*.csv.gz`.
        out: folder; replaced if it holds an older reproduction, untouched if this one fails.
        seed: of the errors in the robot's looks at the door.
        progress: told as models are learned.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `door` and `room` (a dictionary each row), `targets`, `settings`, `processing_s`; plain JSON values.

    Raises:
        InputError: a recording is missing or malformed.
        ConfigError: a negative seed, or `out` must not be replaced.
    """
    from evermap.runs.folder import RunFolder
    from evermap.runs.summary import versions

    if seed < 0:
        raise ConfigError(f"must not be negative, not {seed}", field="seed")
    with RunFolder(out, force=force, inputs=[data]) as folder:
        start = time.perf_counter()
        room, door, home = read_room(Path(data)), read_door(Path(data)), read_home(Path(data))
        steps = _Steps(
            progress, len(models.ROOM) * len(room) + len(TASKS) * (len(models.DOOR) + len(models.HOME) * len(home))
        )
        found = Found()
        room_rows = [_room(contender, room, found, steps) for contender in models.ROOM]
        door_rows = list(_door(models.DOOR, door, seed, found, steps))
        home_rows = _home(home, seed, steps)
        table: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "evermap": __version__,
            "experiment": "presence",
            "settings": {
                "seed": seed, "noise_seeds": NOISE_SEEDS, "p_miss": P_MISS, "p_false": P_FALSE, "clipped_at": SURE,
            },
            "versions": versions(),
            "processing_s": time.perf_counter() - start,
            "targets": judged(room_rows, door_rows),
            "room": room_rows,
            "door": door_rows,
            "home": home_rows,
            "published": PUBLISHED,
        }  # fmt: skip
        draw_all(room, found, folder.path)
        folder.path("table.md").write_text(as_markdown(table) + "\n", encoding="utf-8")
        return folder.finish(table)


class _Steps:
    """Counts what is done."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def one_more(self) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total)


def _room(contender: Contender, room: Sequence[RoomFeature], found: Found, steps: _Steps) -> dict[str, Any]:
    """One row: means over all landmarks, and over those that leave."""
    scores, said, learn_s = [], [], 0.0
    for landmark in room:
        option = choose_by_looks(contender, landmark.train)
        start = time.perf_counter()
        learned = contender.learn(landmark.train)
        learn_s += time.perf_counter() - start
        instants = Instants.same_for_all(1, landmark.stamp_s)
        belief = kept(contender.believe(learned, option)(landmark.test, instants))
        scores.append(room_scores(belief, landmark.present, landmark.stamp_s))
        said.append(contender.says(learned, option))
        found.room.setdefault(contender.name, []).append(belief)
        steps.one_more()
    leaving = [one for one, landmark in zip(scores, room, strict=True) if not landmark.present.all()]
    return {
        "contender": contender.name,
        "label": contender.label,
        "default": contender is models.ROOM_DEFAULT,
        "learn_s": learn_s,
        "chosen": said,
        "all": mean_scores(scores),
        "semi_static": _plain(mean_scores(leaving)) if leaving else None,
        "landmarks": [_plain(one) for one in scores],
    }


def _door(
    contenders: Sequence[Contender], door: Door, seed: int, found: Found, steps: _Steps
) -> Iterator[dict[str, Any]]:
    """One row a task and contender."""
    found.trials = {task.name: door.trials(task, seed) for task in TASKS}
    for contender in contenders:
        start = time.perf_counter()
        learned = contender.learn(door.train.certain_looks())
        learn_s = time.perf_counter() - start
        early = (
            None if len(contender.options) == 1 else contender.learn(door.train.without_last_week()[0].certain_looks())
        )
        for task in TASKS:
            option = choose_for_week(contender, early, door.rehearsal(task, seed))
            believe = contender.believe(learned, option)
            weeks = [beliefs(believe, week) for week in found.trials[task.name]]
            found.door[task.name, contender.name] = weeks
            yield _door_row(contender, task, door_scores(weeks, found.trials[task.name])) | {
                "weeks": week_scores(weeks, found.trials[task.name]),
                "learn_s": learn_s,
                "chosen": contender.says(learned, option),
            }
            steps.one_more()


def _home(home: Mapping[str, Door], seed: int, steps: _Steps) -> list[dict[str, Any]]:
    """One row a task and contender: means over the rooms, and each room's scores."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    names = ("brier", "log_loss", "calibration_error", "mae", "balanced_accuracy")
    for room, door in home.items():
        for row in _door(models.HOME, door, seed, Found(), steps):
            mean = rows.setdefault(
                (row["task"], row["contender"]),
                {name: row[name] for name in ("task", "contender", "label", "default")} | {"rooms": {}},
            )
            mean["rooms"][room] = {name: row[name] for name in (*names, "chosen", "learn_s")}
    for row in rows.values():
        for name in names:
            known = [room[name] for room in row["rooms"].values() if room[name] is not None]
            row[name] = sum(known) / len(known) if known else None
    return list(rows.values())


def _door_row(contender: Contender, task: Task, scores: dict[str, float]) -> dict[str, Any]:
    return {
        "task": task.name,
        "contender": contender.name,
        "label": contender.label,
        "default": contender is models.DOOR_DEFAULT,
        **_plain(scores),
    }


def _plain(scores: dict[str, float]) -> dict[str, float | None]:
    """Scores that JSON can hold: null where there is none."""
    return {name: value if math.isfinite(value) else None for name, value in scores.items()}


__all__ = ["as_markdown", "reproduce"]
