"""What can be chosen about a run of `evermap track`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from evermap.errors import ConfigError, suggestion
from evermap.io.text import quote
from evermap.survival.base import LifetimePrior
from evermap.survival.text import parse_prior
from evermap.tracking.settings import TrackerSettings

DEFAULT_PRIOR = "unknown:1min..10y"
"""As `evermap persist`: every order of magnitude of the mean stay is equally likely."""


@dataclass(frozen=True, slots=True)
class TrackConfig:
    """Choices of a run.

    Attributes:
        settings: of the tracker.
        class_speed_mps: speed above which objects of a class are dynamic, where it is not that of all.
        prior: how long objects at rest stay, as `survival.text` writes it.
        class_priors: the same for single classes.
        range_m: the sensor's reach; None where nothing is known of what should be seen.
        min_score: detections of a lower score were left out.
        gap_s: a longer time between two frames is a time at which nobody looked; None: ten times the usual.

    Raises:
        ConfigError: a value that cannot be.
    """

    settings: TrackerSettings = field(default_factory=TrackerSettings)
    class_speed_mps: Mapping[str, float] = field(default_factory=dict)
    prior: str = DEFAULT_PRIOR
    class_priors: Mapping[str, str] = field(default_factory=dict)
    range_m: float | None = None
    min_score: float = 0.0
    gap_s: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("--range-m", self.range_m), ("--gap-s", self.gap_s)):
            if value is not None and not 0.0 < value < float("inf"):
                raise ConfigError(f"must be positive and finite, not {value:g}", field=name)
        if not 0.0 <= self.min_score <= 1.0:
            raise ConfigError(f"must lie between 0 and 1, not {self.min_score:g}", field="--min-score")

    def priors(self, class_names: Sequence[str]) -> tuple[LifetimePrior, ...]:
        """The prior of every class.

        Raises:
            ConfigError: text that is no prior, or a class that no detection has.
        """
        _known(self.class_priors, class_names, "--prior")
        try:
            return tuple(parse_prior(self.class_priors.get(name, self.prior)) for name in class_names)
        except ConfigError as error:
            raise ConfigError(error.problem, field="--prior", hint=error.hint) from error

    def speeds(self, class_names: Sequence[str]) -> tuple[float, ...]:
        """The speed of every class above which it is dynamic [m/s].

        Raises:
            ConfigError: a class that no detection has.
        """
        _known(self.class_speed_mps, class_names, "--speed")
        common = self.settings.class_speeds(len(class_names)).tolist()
        return tuple(self.class_speed_mps.get(name, speed) for name, speed in zip(class_names, common, strict=True))

    def to_dict(self) -> dict[str, Any]:
        """For `summary.json`."""
        plain = {name: getattr(self, name) for name in ("prior", "range_m", "min_score", "gap_s")}
        settings = {item.name: getattr(self.settings, item.name) for item in fields(self.settings)}
        by_class = {"class_priors": dict(self.class_priors), "class_speed_mps": dict(self.class_speed_mps)}
        return plain | by_class | {"settings": settings}


def parse_settings(texts: Sequence[str]) -> TrackerSettings:
    """`NAME=VALUE` each.

    Raises:
        ConfigError: no setting has this name, or the value is none.
    """
    known: dict[str, Any] = {item.name: item.default for item in fields(TrackerSettings)}
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise ConfigError(f"{quote(text)} is no NAME=VALUE", field="--set", hint="max_missed=20")
        if name not in known:
            raise ConfigError(f"no setting is called {quote(name)}", field="--set", hint=suggestion(name, known))
        kind = type(known[name])
        try:
            values[name] = kind(value)
        except ValueError:
            what = {int: "whole number", float: "number"}.get(kind, "value")
            raise ConfigError(f"{quote(value)} is no {what}", field=name, hint=f"{name}={known[name]}") from None
    return TrackerSettings(**values)


def parse_speeds(texts: Sequence[str]) -> dict[str, float]:
    """`CLASS=MPS` each.

    Raises:
        ConfigError: no speed, or a class named twice.
    """
    speeds: dict[str, float] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.rpartition("="))
        try:
            speed = float(value)
        except ValueError:
            speed = -1.0
        if not equals or not 0.0 < speed < float("inf"):
            raise ConfigError(f"{quote(text)} is no CLASS=SPEED", field="--speed", hint="pallet=0.2")
        if name in speeds:
            raise ConfigError(f"given twice for class {quote(name)}", field="--speed")
        speeds[name] = speed
    return speeds


def _known(by_class: Mapping[str, object], class_names: Sequence[str], option: str) -> None:
    for name in by_class:
        if name not in class_names:
            hint = f"one of {', '.join(class_names)}" if any(class_names) else "a column class_id in the table"
            raise ConfigError(f"no detection is of class {quote(name)}", field=option, hint=hint)
