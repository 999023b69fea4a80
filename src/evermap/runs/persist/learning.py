"""Recurrent models learned from a table of looks: one for all features, one a class, or one a feature."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from evermap.config import PersistConfig
from evermap.errors import ConfigError, DataError, NumericalError
from evermap.existence.models import KINDS, Choice, choose
from evermap.existence.protocol import Looks
from evermap.existence.rhythm import BIN_S
from evermap.io.text import quote
from evermap.runs.persist.models import ModelOfEach, some_looks
from evermap.runs.persist.table import LookTable
from evermap.types import UNKNOWN, IntArray

AUTO = "auto"
MOST_STEPS = 20_000_000
"""Steps of time that learning of run lengths goes through, hundreds of times: more would need gigabytes and days."""
MOST_BINS = 2_000_000
"""Ten minutes each, of one feature, that learning of phases goes through: 38 years."""

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class LearnedModels:
    """What was learned.

    Attributes:
        models: the model of every feature.
        per: 'all', 'class' or 'feature': whose looks were put together.
        choices: of each model, how it was chosen.
    """

    models: ModelOfEach
    per: str
    choices: tuple[Choice, ...]


def learn_models(
    table: LookTable,
    looks: Looks,
    config: PersistConfig,
    *,
    progress: Progress | None = None,
) -> LearnedModels:
    """Learn how features come and go from looks alone.

    Args:
        table: what was read; its truth is not looked at.
        looks: its looks by feature and time.
        config: `recurrent` is one of `choose.KINDS`, or 'auto', which chooses for each model by predicting looks that
            were held out. With `per`, 'all' features share a model, or those of a 'class', or every 'feature' has its
            own; 'auto': by class where the table has classes, by feature where there are few features with many looks
            each, else one for all. Of more looks than `learn_from`, whole features drawn at random are learned from, or
            the latest looks at one.
        progress: called with the part that is done.

    Raises:
        ConfigError: an unknown kind or grouping, or classes where the table has none.
        DataError: a group with too few looks to learn from, or with looks over so long a time, in steps of their
            usual gap, that no memory holds it.
    """
    kind = config.recurrent
    if kind != AUTO and kind not in KINDS:
        raise ConfigError(f"unknown kind of model '{kind}'", field="recurrent", hint=", ".join((AUTO, *KINDS)))
    grouping = _grouping(table, looks, config) if config.per == AUTO else config.per
    groups = list(_groups(table, grouping))
    of_feature = np.zeros(table.n_features, dtype=np.int64)
    choices: list[Choice] = []
    tell = progress or (lambda _: None)
    for number, (name, features) in enumerate(groups):
        part, rows = some_looks(looks, features, max(config.learn_from // len(groups), 2))

        def within(done: float, number: int = number) -> None:
            tell((number + done) / len(groups))

        _check_span(part, kind)
        try:
            choices.append(choose(part, None if kind == AUTO else [kind], progress=within))
        except DataError as error:
            raise DataError(f"{quote(name)}: {error.problem}" if name else error.problem, hint=error.hint) from error
        except NumericalError as error:
            row = None if error.row is None else int(rows[error.row])
            raise NumericalError(error.problem, hint=error.hint, row=row) from error
        of_feature[features] = number
        within(1.0)
    names = tuple(name for name, _ in groups)
    models = ModelOfEach(tuple(choice.model for choice in choices), names, of_feature)
    return LearnedModels(models, grouping, tuple(choices))


def _check_span(looks: Looks, kind: str) -> None:
    """Raise DataError for stamps between which there are more steps than can be gone through."""
    of_look = np.repeat(np.arange(looks.n_features), np.diff(looks.first))
    pause_s = np.diff(looks.stamp_s)[np.diff(of_look) == 0]
    if not np.any(pause_s > 0.0):
        return
    # phases go from ten minutes to ten minutes, run lengths from look to look
    phases = "phase" in kind or kind == "two-state"
    step_s = BIN_S if phases else float(np.median(pause_s[pause_s > 0.0]))
    steps = float(pause_s.sum()) / step_s
    if steps > (MOST_BINS * looks.n_features if phases else MOST_STEPS):
        problem = f"{steps:.2g} steps of {step_s:g} s lie between the looks, the longest pause is {pause_s.max():g} s"
        hint = "is a stamp astray? else fewer looks (`learn_from`), or `recurrent` two-state"
        raise DataError(problem, field="stamp_s", hint=hint)


def _grouping(table: LookTable, looks: Looks, config: PersistConfig) -> str:
    """By class where there are classes, by feature where each has a lot to say, else all together."""
    if table.class_names:
        return "class"
    plenty = np.diff(looks.first).min() >= config.fewest_looks_alone
    return "feature" if table.n_features <= config.most_features_alone and plenty else "all"


def _groups(table: LookTable, per: str) -> Iterator[tuple[str, IntArray]]:
    """Names and features of the groups; '' names all, or those without a class."""
    if per == "feature":
        for feature, name in enumerate(table.names):
            yield name, np.array([feature])
    elif per == "class":
        if not table.class_names:
            raise ConfigError("the table has no classes", field="per", hint="a column class_id, or `per` all")
        for index, name in enumerate(table.class_names):
            yield name, np.flatnonzero(table.class_of_feature == index)
        others = np.flatnonzero(table.class_of_feature == UNKNOWN)
        if others.size:
            yield "", others
    else:
        yield "", np.arange(table.n_features)
