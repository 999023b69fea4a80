"""Kinds of presence models: read and written as JSON files, and chosen by how well they predict held-out looks.

A file holds one model, or several by the name of a class or a feature (`NamedModels`); it is written whole or not at
all. `lifetimes_of` is the way from what a user writes on a command line, a prior or such a file, to the lifetimes that
a map or a tracker takes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from evermap.errors import ConfigError, DataError, EvermapError, InputError, suggestion
from evermap.existence.lifetimes import Lifetimes
from evermap.existence.protocol import Looks, PresenceModel
from evermap.existence.rhythm import DAY_S, WEEK_S
from evermap.io.files import write_atomic
from evermap.show import Shown
from evermap.survival import never_leaves

if TYPE_CHECKING:
    from evermap.existence.run_length import RunLength

Learner = Callable[..., PresenceModel]
"""Learns from looks, and goes on from a model of its kind where one is given."""
Progress = Callable[[float], None]

HELD_OUT_PART = 0.2
WEEKS_FOR_A_RHYTHM = 2.0
WEEKS_TO_HOLD_OUT_ONE = 4.0
LOOKS_TO_HOLD_OUT = 100
"""A week with fewer looks says nothing about which kind predicts them."""
GAP_FOR_A_RHYTHM_S = 1.5 * DAY_S
"""Looks farther apart (in the median) than a day or so don't show at what hour anything came or left."""


def _learn_phases(looks: Looks, _start: PresenceModel | None = None, **settings: Any) -> PresenceModel:
    """Learn phases; these are found anew as quickly as from a model of fewer looks."""
    from evermap.existence.learn_phases import learn

    return learn(looks, **settings).model


def _learn_sojourns(looks: Looks, start: PresenceModel | None = None, **settings: Any) -> PresenceModel:
    from evermap.existence.learn_sojourns import learn

    return learn(looks, start=cast("RunLength | None", start), **settings).model


KINDS: Mapping[str, Learner] = {
    "two-state": partial(_learn_phases, phases="two-state", rhythm=False),
    "phase-type": partial(_learn_phases, rhythm=False),
    "phase-type-rhythm": partial(_learn_phases, rhythm=True),
    "run-length": partial(_learn_sojourns, rhythm=False),
    "run-length-rhythm": partial(_learn_sojourns, rhythm=True),
}
"""Kinds of recurrent models, each learned from looks alone; the simpler ones first."""


@dataclass(frozen=True, slots=True)
class Choice(Shown):
    """The chosen kind of model.

    Attributes:
        kind: one of `KINDS`.
        model: of that kind, learned from all looks.
        scores: log predictive density of the looks held out, of every kind that was tried; empty where one was named.
        held_out_s: how long the part held out is.
    """

    kind: str
    model: PresenceModel
    scores: Mapping[str, float]
    held_out_s: float


def choose(looks: Looks, kinds: Sequence[str] | None = None, *, progress: Progress | None = None) -> Choice:
    """Learn the kind of model that predicts the last part of the looks best.

    The last week is held out where there are four or more and a hundred looks in it, else the last fifth of the time.
    Rhythms are considered from two weeks on, where looks at a feature are not much more than a day apart.

    Args:
        looks: uncertain looks; no truth.
        kinds: names in `KINDS` to choose from; all that the length of the looks allows where None.
        progress: called with the part that is done.

    Raises:
        ConfigError: a kind that does not exist.
        DataError: too few looks to learn from.
    """
    if not len(looks.stamp_s):
        raise DataError("there is no look to learn from")
    first, last = float(looks.stamp_s.min()), float(looks.stamp_s.max())
    names = list(KINDS) if kinds is None else list(kinds)
    for name in names:
        if name not in KINDS:
            raise ConfigError(f"unknown kind of model '{name}'", field="kind", hint=f"one of {', '.join(KINDS)}")
    if kinds is None and not _may_show_rhythm(looks, last - first):
        names = [name for name in names if "rhythm" not in name]
    if len(names) == 1:
        return Choice(names[0], KINDS[names[0]](looks), {}, 0.0)
    held_out = HELD_OUT_PART * (last - first)
    if last - first >= WEEKS_TO_HOLD_OUT_ONE * WEEK_S and (looks.stamp_s >= last - WEEK_S).sum() >= LOOKS_TO_HOLD_OUT:
        held_out = WEEK_S
    before = looks.taken(looks.stamp_s < last - held_out)
    tell = progress or (lambda _: None)
    scores: dict[str, float] = {}
    models: dict[str, PresenceModel] = {}
    for number, name in enumerate(names):
        model = models[name] = KINDS[name](before)
        scores[name] = float(np.sum(model.track(looks).log_evidence) - np.sum(model.track(before).log_evidence))
        tell((number + 1) / (len(names) + 1))
    best = max(names, key=lambda name: scores[name])
    choice = Choice(best, KINDS[best](looks, models[best]), scores, held_out)
    tell(1.0)
    return choice


def _may_show_rhythm(looks: Looks, span_s: float) -> bool:
    """Whether the times of the looks let a rhythm of the week be known."""
    return span_s >= WEEKS_FOR_A_RHYTHM * WEEK_S and looks.median_gap_s() <= GAP_FOR_A_RHYTHM_S


SCHEMA_VERSION = 1
CLASSES = {
    "phase-type": ("evermap.existence.phase_type", "PhaseType"),
    "run-length": ("evermap.existence.run_length", "RunLength"),
    "one-stay": ("evermap.existence.one_stay", "OneStay"),
}
"""Where the class of each kind of model is; it is imported when a file asks for it."""


SEVERAL = "several"


class NamedModels(NamedTuple):
    """Models of presence by name.

    Attributes:
        models: by the name of a class or a feature; '' is for everything without a name of its own.
        per: 'all', 'class' or 'feature': what the names are of.
    """

    models: Mapping[str, PresenceModel]
    per: str = "all"

    @property
    def lifetimes(self) -> dict[str, Lifetimes]:
        """Lifetimes of stays and absences by name."""
        return {name: model.lifetimes for name, model in self.models.items()}


def save_models(models: NamedModels, path: str | Path) -> Path:
    """Write models to a JSON file and return its path.

    Raises:
        ConfigError: a lifetime that cannot be written, as a hazard that is a function.
        InputError: the file cannot be written.
    """
    if models.per == "all":
        content: dict[str, Any] = models.models[""].to_dict()
    else:
        named = {name: model.to_dict() for name, model in models.models.items()}
        content = {"kind": SEVERAL, "per": models.per, "models": named}
    content = {"schema_version": SCHEMA_VERSION, **content}
    return write_atomic(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def is_model_file(path: str | Path) -> bool:
    """Return whether a file is one of models."""
    try:
        load_models(path)
    except EvermapError:
        return False
    return True


def load_models(path: str | Path) -> NamedModels:
    """Read what `save_models` wrote: the model under '', or one for every name.

    Raises:
        InputError: no such file, no JSON, another schema, an unknown kind, or numbers that cannot be.
    """
    data = read_model_file(path)
    try:
        if data.get("kind") != SEVERAL:
            return NamedModels({"": model_of(data)})
        if not isinstance(data["models"], dict):
            raise InputError("is not a table of models", field="models")
        return NamedModels({name: model_of(model) for name, model in data["models"].items()}, str(data.get("per")))
    except KeyError as error:
        raise InputError("is missing", path=path, field=str(error.args[0])) from error
    except EvermapError as error:
        raise InputError(error.problem, path=path, field=error.field, hint=error.hint) from error


def save_lifetimes(lifetimes: Mapping[str, Lifetimes], path: str | Path) -> Path:
    """Write lifetimes by class to a file that `lifetimes_of` reads, and return its path; errors as `save_models`."""
    from evermap.existence.run_length import RunLength

    return save_models(
        NamedModels({name: RunLength.from_lifetimes(of) for name, of in lifetimes.items()}, "class"), path
    )


def lifetimes_of(source: str | Path) -> dict[str, Lifetimes]:
    """Return the lifetimes given by a user, by class; '' is for every other class.

    Args:
        source: the text of a prior as `weibull:scale=3d,shape=1.5` (absences then never end), or the path of a file of
            models, as `evermap survival learn` and `evermap survival fit` write them.

    Raises:
        ConfigError: neither an existing file nor the text of a prior.
        InputError: a file that cannot be read, or one of models by feature, which say nothing about classes.
    """
    if Path(source).suffix != ".json":
        from evermap.survival.text import parse_prior

        return {"": Lifetimes(parse_prior(str(source)), never_leaves())}
    models = load_models(source)
    if models.per == "feature":
        raise InputError("has models of features, not of classes", path=source, hint="learn with --per class or all")
    return models.lifetimes


def priors_of(common: str | None, by_class: Mapping[str, str] | None = None) -> dict[str, Lifetimes]:
    """Read lifetimes that a user gives for a map or a tracker, by class; '' is for every class that is not named.

    Args:
        common: text of a prior for all classes, as `weibull:scale=3d,shape=1.5`, or a file of models, as
            `survival fit`, `survival learn` and `map export --lifetimes` write it.
        by_class: the same for single classes; goes before what a file says of them. None for none.

    Raises:
        ConfigError: the text of no prior.
        InputError: a file that cannot be read, or that has no lifetime of the class.
    """
    try:
        found = {} if common is None else lifetimes_of(common)
        for name, source in (by_class or {}).items():
            told = lifetimes_of(source)
            if name not in told and "" not in told:
                raise InputError(f"has no lifetime of class '{name}'", path=source, hint=suggestion(name, told))
            found[name] = told[name if name in told else ""]
    except ConfigError as error:
        raise ConfigError(error.problem, field="prior", hint=error.hint) from None
    return found


def read_model_file(path: str | Path) -> dict[str, Any]:
    """Return the content of a model file; InputError for no such file, no JSON, or a version that we do not know."""
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", path=path) from error
    except UnicodeDecodeError as error:
        raise InputError("is not text", path=path) from error
    except json.JSONDecodeError as error:
        raise InputError(f"is not JSON: {error.msg}", path=path, line=error.lineno) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not JSON of a model: {error}", path=path) from error
    if not isinstance(data, dict):
        raise InputError("contains no model of presence", path=path)
    version = data.get("schema_version")
    if version != SCHEMA_VERSION:
        raise InputError(
            f"version {version!r}; this evermap reads version {SCHEMA_VERSION}",
            path=path,
            field="schema_version",
            hint="the evermap that wrote it",
        )
    return data


def model_of(data: Any) -> PresenceModel:
    """Return the model that `to_dict` wrote; InputError for an unknown kind or field, ConfigError for bad numbers."""
    kind = data.get("kind") if isinstance(data, dict) else None
    if not isinstance(kind, str) or kind not in CLASSES:
        raise InputError(f"unknown kind of model {kind!r}", field="kind", hint=", ".join(sorted(CLASSES)))
    module, name = CLASSES[kind]
    try:
        return cast("PresenceModel", getattr(import_module(module), name).from_dict(data))
    except KeyError as error:
        raise InputError("is missing", field=str(error.args[0])) from error
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError, RecursionError) as error:
        raise InputError(f"is not what a {kind} model holds: {error}") from error
