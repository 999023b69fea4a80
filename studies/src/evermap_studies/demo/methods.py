"""What is compared: one engine with parts of it switched off, so that every method sees the same recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evermap.config import Config, LivingConfig


@dataclass(frozen=True, slots=True)
class Method:
    """One way to live with a map.

    Attributes:
        name: key in `summary.json`.
        label: in figures and tables.
        says: what it does about change, half a sentence.
        switches: fields of `LivingConfig` that differ from the defaults.
        is_told: before every session it is told which landmarks changed since the last one, and forgets them.
        asks_causes: whether a session that contradicts the map is asked for causes other than changes.
    """

    name: str
    label: str
    says: str
    switches: tuple[tuple[str, str | bool], ...] = ()
    is_told: bool = False
    asks_causes: bool = False

    def config(self) -> Config:
        """Settings: the defaults but for the switches, the simulated sensor's true metre, and a map that goes on
        whatever the verdict.
        """
        from evermap.config import CalibrationConfig, Config, ExplainConfig, LivingConfig, SlamConfig

        slam = SlamConfig(
            calibration=CalibrationConfig(fix={"range_slope": 0.0}), explain=ExplainConfig(on=self.asks_causes)
        )
        living: LivingConfig = LivingConfig.model_validate({"accept": "any", **dict(self.switches)})
        return Config(slam=slam, living=living)


_STATIC = (("search", "none"), ("existence", False))
_UNLEARNED = (("cliques", False), ("learn_lifetimes", False), ("learn_sight", False))

METHODS: tuple[Method, ...] = (
    Method("static", "static SLAM", "what was mapped stands there for ever; outliers are rejected", _STATIC),
    Method(
        "rosen2016",
        "Rosen 2016",
        "every landmark has a persistence filter; what is gone is gone for ever",
        (("search", "none"), ("returns", False), *_UNLEARNED),
    ),
    Method(
        "bateman2020",
        "Bateman 2020",
        "landmarks on one body share a filter; lifetimes and lines of sight are learned",
        (("search", "none"), ("returns", False)),
    ),
    Method(
        "nielsen2024",
        "Nielsen 2024",
        "every landmark has several places, of which hits and misses choose one",
        (("search", "gate"), ("existence", False), *_UNLEARNED),
    ),
    Method("evermap", "evermap", "all of it in one model, and a joint search over what moved", asks_causes=True),
    Method("oracle", "oracle", "static SLAM that is told the truth about every change", _STATIC, is_told=True),
)


def method_named(name: str) -> Method:
    """The method with this key.

    Raises:
        KeyError: there is none.
    """
    for method in METHODS:
        if method.name == name:
            return method
    raise KeyError(name)
