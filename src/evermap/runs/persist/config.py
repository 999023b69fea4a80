"""What can be chosen about a run of `evermap persist`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from evermap.errors import ConfigError

DEFAULT_PRIOR = "unknown:1min..10y"
"""From a cup that is put down to a wall: every order of magnitude of the mean stay is equally likely."""
QUERIES = ("times", "grid")
NO_RECURRENCE = "none"


@dataclass(frozen=True, slots=True)
class PersistConfig:
    """Choices of a run.

    Attributes:
        prior: lifetime of features that stay once, as `survival.text` writes it.
        class_priors: the same for single classes.
        recurrent: how features come back: 'none' for features that stay once, a kind of model to learn, or 'auto'.
        per: whose looks are put together to learn: 'all' features, each 'class', each 'feature', or 'auto'.
        model: file of a model that was learned before, '' to learn it from the table.
        learn_from: at most so many looks are learned from: all those at some of the features, drawn at random.
        query: 'times' asks for the belief at the time of every row, 'grid' at regular times.
        step_s: step of the grid, and of the forecasts; None chooses.
        horizon_s: how far the forecasts reach beyond the latest look; None: a quarter of their span.
        confidence: belief from which on a change is called one.

    Raises:
        ConfigError: a value that cannot be.
    """

    prior: str = DEFAULT_PRIOR
    class_priors: Mapping[str, str] = field(default_factory=dict)
    recurrent: str = NO_RECURRENCE
    per: str = "auto"
    model: str = ""
    learn_from: int = 100_000
    query: str = "times"
    step_s: float | None = None
    horizon_s: float | None = None
    confidence: float = 0.9

    def __post_init__(self) -> None:
        if self.query not in QUERIES:
            raise ConfigError(f"'{self.query}' is no query", field="--query", hint=" or ".join(QUERIES))
        for name, value in (("--step-s", self.step_s), ("--horizon", self.horizon_s)):
            if value is not None and not 0.0 < value < float("inf"):
                raise ConfigError(f"must be positive and finite, not {value:g} s", field=name)
        if self.learn_from < 2:
            raise ConfigError(f"{self.learn_from} looks teach nothing", field="--learn-from", hint="100000")
        if not 0.5 < self.confidence < 1.0:
            problem = f"must lie above 0.5 and below 1, not {self.confidence:g}"
            raise ConfigError(problem, field="--confidence", hint="0.9")

    @property
    def stays_once(self) -> bool:
        """Whether features have one lifetime and never return."""
        return self.recurrent == NO_RECURRENCE and not self.model

    @property
    def learns(self) -> bool:
        """Whether a model is learned from the looks."""
        return self.recurrent != NO_RECURRENCE and not self.model

    def to_dict(self) -> dict[str, Any]:
        """For `summary.json`."""
        return {name: getattr(self, name) for name in self.__slots__ if name != "class_priors"} | {
            "class_priors": dict(self.class_priors)
        }


def split_priors(texts: Sequence[str]) -> tuple[str | None, dict[str, str]]:
    """`--prior` may be given once for all features and once for each class: `door=exponential:half-life=2d`.

    Returns:
        The prior without a class, or None, and those of the classes.

    Raises:
        ConfigError: the same class twice.
    """
    common: str | None = None
    by_class: dict[str, str] = {}
    for text in texts:
        found = re.fullmatch(r"\s*([^:=*]+?)\s*=(.+)", text)  # in a prior, a colon or a star comes before any '='
        name = found[1] if found else ""
        if (name in by_class) if found else (common is not None):
            whose = f"class '{name}'" if found else "all features"
            raise ConfigError(f"given twice for {whose}", field="--prior", hint="CLASS=PRIOR for a single class")
        if found:
            by_class[name] = found[2].strip()
        else:
            common = text.strip()
    return common, by_class
