"""Which model of presence a run uses: one stay for each feature, a model from a file, or one learned from the looks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.config import PersistConfig
from evermap.config.tables import NO_RECURRENCE
from evermap.errors import ConfigError, EvermapError
from evermap.existence.one_stay import OneStay
from evermap.existence.protocol import Instants, Looks, PresenceFilter, PresenceModel, Track
from evermap.io.text import quote
from evermap.runs.persist.table import LookTable
from evermap.types import FloatArray, IntArray

if TYPE_CHECKING:
    from evermap.runs.persist.learning import LearnedModels


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
            part, _ = looks_at(looks, mine)
            asked_part, rows = instants_at(asked, mine)
            track = model.track(part, asked_part)
            p_present[rows], evidence[mine], merged[mine] = track.p_present, track.log_evidence, track.merged_mass
        return Track(p_present, evidence, merged)

    def only(self, features: IntArray) -> ModelOfEach:
        """The same about some of the features."""
        return ModelOfEach(self.models, self.names, self.of_feature[features])

    def to_dict(self) -> dict[str, Any]:
        """The models by the name of their class."""
        return {name or "all": model.to_dict() for name, model in zip(self.names, self.models, strict=True)}


def models_for(
    config: PersistConfig, table: LookTable, looks: Looks, progress: Callable[[float], None] | None = None
) -> tuple[ModelOfEach, LearnedModels | None]:
    """The model of every feature, and how it was learned where it was.

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
        from evermap.runs.persist.modelfile import load_models

        return load_models(config.model, table), None
    from evermap.runs.persist.learning import learn_models

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
    """Answers to several lists of (feature, time) in one pass over the looks.

    Args:
        model: of the features.
        looks: at F features.
        questions: (N,) features and (N,) times each, in any order.

    Returns:
        (N,) probabilities of presence for each list, and the track with all of them.
    """
    feature = np.concatenate([features for features, _ in questions])
    stamp_s = np.concatenate([stamps for _, stamps in questions])
    order = np.lexsort((stamp_s, feature))
    first = np.concatenate([[0], np.cumsum(np.bincount(feature, minlength=looks.n_features))]).astype(np.int64)
    track = model.track(looks, Instants(first, stamp_s[order]))
    answers = np.empty(len(order))
    answers[order] = track.p_present
    ends = np.cumsum([len(features) for features, _ in questions])
    return np.split(answers, ends[:-1]), track


def some_looks(looks: Looks, features: IntArray, most: int) -> tuple[Looks, IntArray]:
    """Return looks at some features and the rows they are: of so many of these, at random, as make up at most `most`.

    Of a single feature with more looks its latest are returned.
    """
    part, rows = looks_at(looks, features)
    if len(rows) <= most:
        return part, rows
    drawn = np.random.default_rng(0).permutation(part.n_features)
    enough = int(np.searchsorted(np.cumsum(np.diff(part.first)[drawn]), most, side="right"))
    part, rows = looks_at(looks, features[np.sort(drawn[: max(enough, 1)])])
    if len(rows) <= most:
        return part, rows
    latest = rows[-most:]
    columns = (looks.stamp_s, looks.detected, looks.p_miss, looks.p_false)
    return Looks(np.array([0, most]), *(column[latest] for column in columns)), latest


def looks_at(looks: Looks, features: IntArray) -> tuple[Looks, IntArray]:
    """The looks at some features, and the rows they are."""
    first, rows = _rows_of(looks.first, features)
    columns = (looks.stamp_s, looks.detected, looks.p_miss, looks.p_false)
    return Looks(first, *(column[rows] for column in columns)), rows


def instants_at(instants: Instants, features: IntArray) -> tuple[Instants, IntArray]:
    """The instants of some features, and the rows they are."""
    first, rows = _rows_of(instants.first, features)
    return Instants(first, instants.stamp_s[rows]), rows


def _rows_of(first: IntArray, features: IntArray) -> tuple[IntArray, IntArray]:
    """The rows of some features behind each other: where each feature starts, and the rows."""
    length = first[features + 1] - first[features]
    begin = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
    rows = np.arange(begin[-1]) - np.repeat(begin[:-1] - first[features], length)
    return begin, rows
