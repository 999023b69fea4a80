"""Choice of the presence model of a run: one stay for each feature, a model from a file, or a learned one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evermap.config import NO_RECURRENCE, PersistConfig
from evermap.errors import ConfigError, DataError, EvermapError, InputError, NumericalError
from evermap.existence import models as storage
from evermap.existence.models import KINDS, Choice, choose
from evermap.existence.one_stay import OneStay
from evermap.existence.protocol import Instants, Looks, PresenceFilter, PresenceModel, Track, firsts_of
from evermap.existence.rhythm import BIN_S
from evermap.io.text import quote
from evermap.runs.persist.table import LookTable, PartedLooks
from evermap.types import UNKNOWN, FloatArray, IntArray, json_number


@dataclass(frozen=True, slots=True)
class ModelOfEach:
    """Several models and which feature has which; itself a model of these F features.

    Attributes:
        models: the models in use.
        names: what each is for: a class, or '' for all others.
        of_feature: (F,) index into them.
    """

    models: tuple[PresenceModel, ...]
    names: tuple[str, ...]
    of_feature: IntArray

    def track(self, looks: Looks, instants: Instants | None = None) -> Track:
        """Filter every feature's looks with its own model; see `PresenceModel.track`."""
        asked = Instants.of_looks(looks) if instants is None else instants
        if len(self.models) == 1:
            return self.models[0].track(looks, asked)
        p_present = np.full(len(asked.stamp_s), np.nan)
        evidence, merged = np.zeros(looks.n_features), np.zeros(looks.n_features)
        for k, model in enumerate(self.models):
            mine = np.flatnonzero(self.of_feature == k)
            if mine.size == 0:
                continue
            part, _ = looks.at(mine)
            asked_part, rows = asked.at(mine)
            track = model.track(part, asked_part)
            p_present[rows], evidence[mine], merged[mine] = track.p_present, track.log_evidence, track.merged_mass
        return Track(p_present, evidence, merged)

    def only(self, features: IntArray) -> ModelOfEach:
        """Return the same about some of the features."""
        return ModelOfEach(self.models, self.names, self.of_feature[features])

    def never_leave(self) -> dict[str, float]:
        """Return the share of the features that never leave, by class, where the lifetime says so."""
        shares = (getattr(getattr(model, "prior", None), "p_never_leaves", 0.0) for model in self.models)
        return dict(zip(self.names, map(float, shares), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """Return the models by the name of their class."""
        return {name or "all": model.to_dict() for name, model in zip(self.names, self.models, strict=True)}


def models_for(
    config: PersistConfig, table: LookTable, looks: Looks, progress: Callable[[float], None] | None = None
) -> tuple[ModelOfEach, LearnedModels | None]:
    """Return the model of every feature, and how it was learned where it was.

    Raises:
        ConfigError: an unknown kind of model, a prior that cannot be, or choices that contradict each other.
        InputError: a model file that cannot be read.
        DataError: too few looks to learn from.
    """
    if config.stays_once:
        return _one_stay(config, table), None
    if config.class_priors:
        raise ConfigError("lifetimes are for features that stay once", field="class_priors", hint="without `recurrent`")
    if config.model:
        if config.recurrent != NO_RECURRENCE:
            raise ConfigError("a model from a file is not learned", field="recurrent", hint="without `model`")
        return load_models(config.model, table), None
    learned = learn_models(table, looks, config, progress=progress)
    return learned.models, learned


def _one_stay(config: PersistConfig, table: LookTable) -> ModelOfEach:
    texts = {"": config.prior}
    for name, text in config.class_priors.items():
        if name not in table.class_names:
            hint = f"one of {', '.join(table.class_names)}" if table.class_names else "a column class_id in the table"
            raise ConfigError(f"no feature is of class {quote(name)}", field="class_priors", hint=hint)
        texts[name] = text
    models = []
    for text in texts.values():
        try:
            models.append(OneStay.of_text(text))
        except EvermapError as error:
            raise ConfigError(error.problem, field="prior", hint=error.hint) from error
    index = {name: k for k, name in enumerate(texts)}
    of_class = np.array([index.get(name, 0) for name in table.class_names] + [0])  # the last one is for UNKNOWN = -1
    return ModelOfEach(tuple(models), tuple(texts), of_class[table.class_of_feature])


def ask(model: PresenceFilter, looks: Looks, *questions: tuple[IntArray, FloatArray]) -> tuple[list[FloatArray], Track]:
    """Return answers to several lists of (N,) features and (N,) times, in any order, in one pass over the looks: (N,)
    probabilities of presence for each list, and the track with all of them.
    """
    feature = np.concatenate([features for features, _ in questions])
    stamp_s = np.concatenate([stamps for _, stamps in questions])
    order = np.lexsort((stamp_s, feature))
    track = model.track(looks, Instants(firsts_of(feature, looks.n_features), stamp_s[order]))
    answers = np.empty(len(order))
    answers[order] = track.p_present
    ends = np.cumsum([len(features) for features, _ in questions])
    return np.split(answers, ends[:-1]), track


def some_looks(looks: Looks, features: IntArray, most: int) -> tuple[Looks, IntArray]:
    """Return looks at some features and the rows they are: of so many of these, at random, as make up at most `most`.

    Of a single feature with more looks its latest are returned.
    """
    part, rows = looks.at(features[draw_features(np.diff(looks.first)[features], most)])
    if len(rows) <= most:
        return part, rows
    return looks.taken(rows[-most:], np.array([0, most])), rows[-most:]


def draw_features(counts: IntArray, most: int) -> IntArray:
    """Return which features, with so many looks each, to learn from: all, or so many at random as have at most `most`
    looks together, but at least one.
    """
    if counts.sum() <= most:
        return np.arange(len(counts))
    drawn = np.random.default_rng(0).permutation(len(counts))
    enough = int(np.searchsorted(np.cumsum(counts[drawn]), most, side="right"))
    return np.sort(drawn[: max(enough, 1)])


AUTO = "auto"
MOST_STEPS = 20_000_000
"""Maximum time steps for learning run lengths, which iterates hundreds of times: more would need gigabytes and days."""
MOST_BINS = 2_000_000
"""Maximum ten-minute steps of one feature for learning phases: 38 years."""


@dataclass(frozen=True, slots=True)
class LearnedModels:
    """Learned models.

    Attributes:
        models: the model of every feature.
        per: 'all', 'class' or 'feature': whose looks were put together.
        choices: of each model, how it was chosen.
    """

    models: ModelOfEach
    per: str
    choices: tuple[Choice, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return, for JSON, what was grouped, and why each model is of its kind: scores of looks that were held out."""
        models = {
            name or "all": {
                "kind": choice.kind,
                "held_out_s": choice.held_out_s,
                "scores": {kind: json_number(score) for kind, score in choice.scores.items()},
            }
            for name, choice in zip(self.models.names, self.choices, strict=True)
        }
        return {"per": self.per, "models": models}


def learn_models(
    table: LookTable,
    looks: Looks,
    config: PersistConfig,
    *,
    progress: Callable[[float], None] | None = None,
) -> LearnedModels:
    """Learn presence models from looks alone.

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
    grouping = grouping_of(table, np.diff(looks.first), config)
    groups = list(groups_of(table, grouping))
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
    of_look = looks.feature
    pause_s = np.diff(looks.stamp_s)[np.diff(of_look) == 0]
    if not np.any(pause_s > 0.0):
        return
    # phases go from ten minutes to ten minutes, run lengths from look to look
    phases = "phase" in kind or kind == "two-state"
    step_s = BIN_S if phases else float(np.median(pause_s[pause_s > 0.0]))
    steps = float(pause_s.sum()) / step_s
    if steps > (MOST_BINS * looks.n_features if phases else MOST_STEPS):
        problem = f"{steps:.2g} steps of {step_s:g} s lie between the looks, the longest pause is {pause_s.max():g} s"
        hint = "check for a wrong stamp; otherwise fewer looks (`learn_from`), or `recurrent` two-state"
        raise DataError(problem, field="stamp_s", hint=hint)


def grouping_of(table: LookTable | PartedLooks, counts: IntArray, config: PersistConfig) -> str:
    """Return what is said; else 'class' where there are classes, 'feature' if each has many looks (F,), 'all'."""
    if config.per != AUTO:
        return config.per
    if table.class_names:
        return "class"
    plenty = counts.min() >= config.fewest_looks_alone
    return "feature" if table.n_features <= config.most_features_alone and plenty else "all"


def groups_of(table: LookTable | PartedLooks, per: str) -> Iterator[tuple[str, IntArray]]:
    """Yield names and features of the groups; '' names all, or those without a class."""
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


def save_models(models: ModelOfEach, per: str, path: str | Path) -> Path:
    """Write models to a JSON file; `per` ('all', 'class' or 'feature') is what they are named by. Returns the path."""
    named = dict(zip(models.names, models.models, strict=True)) if per != "all" else {"": models.models[0]}
    return storage.save_models(storage.NamedModels(named, per), path)


def load_models(path: str | Path, table: LookTable) -> ModelOfEach:
    """Read what `save_models` wrote, for the features of a table.

    Raises:
        InputError: a file that cannot be read, or that has no model for a feature of the table.
    """
    models, per = storage.load_models(path)
    names = tuple(models)
    if per == "all":
        return ModelOfEach(tuple(models.values()), names, np.zeros(table.n_features, dtype=np.int64))
    return ModelOfEach(tuple(models.values()), names, _of_feature(path, names, per, table))


def _of_feature(path: str | Path, names: tuple[str, ...], per: str, table: LookTable) -> IntArray:
    """Return the model of each feature of the table."""
    index = {name: number for number, name in enumerate(names)}
    if per == "feature":
        wanted = list(table.names)
    else:
        classes = (*table.class_names, "")
        wanted = [classes[number] if number != UNKNOWN else "" for number in table.class_of_feature]
    for feature, name in zip(table.names, wanted, strict=True):
        if name not in index:
            whose = f"feature {quote(feature)}" + (f" of class {quote(name)}" if per == "class" and name else "")
            raise InputError(f"has no model for {whose}", path=path, hint="learn one for all: --per all")
    return np.array([index[name] for name in wanted], dtype=np.int64)
