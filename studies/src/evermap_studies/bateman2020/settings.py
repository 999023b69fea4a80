"""What the experiment is run with: `settings.toml`, which gives a reason for every value."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, fields, replace
from importlib import resources
from typing import Any

from evermap.errors import ConfigError
from evermap.sensing.profile import Field
from evermap_studies.frame import check_least
from evermap_studies.worlds.cliques import CliqueWorld, named_world
from evermap_studies.worlds.sensors import CAMERA, LIDAR

SENSORS: dict[str, Field] = {"lidar": LIDAR, "camera": CAMERA}
NOMINAL = "nominal"
UNIFORM = "uniform-lifetimes"
"""The thesis' objects vanish "similar to" Rosen 2016, whose lifetimes are uniform; how similar, it does not say."""
READINGS = (NOMINAL, UNIFORM)
"""Worlds that may be the thesis'."""
WORLDS = (*READINGS, "angle60", "range04", "occlusion", "false-alarms", "pose-noise")

SUPPRESSION = "+suppression"
"""Appended to the name of a filter that leaves out looks by the thesis' rule."""
OF_THE_THESIS = ("iff", "jff", "jcf", "jcfr")
IN_THE_TABLE = (*OF_THE_THESIS, *(name + SUPPRESSION for name in OF_THE_THESIS))
OTHER_READINGS = tuple(name + tail for name in ("iff-observable", "jff-mixture") for tail in ("", SUPPRESSION))
"""Of what the thesis leaves open about its baselines."""
TUNED, ORACLE, LEARNED, WARM = "jcf-tuned", "oracle", "learned", "learned-warm"
BEYOND = (TUNED, TUNED + SUPPRESSION, ORACLE, LEARNED, WARM)
REMOVING = ("jcfr" + SUPPRESSION, TUNED, ORACLE, LEARNED, WARM)
"""Whose removals are drawn over the threshold."""
IN_ALL_WORLDS = ("jcf" + SUPPRESSION, "jcfr" + SUPPRESSION, *BEYOND)
FILTERS = (*IN_THE_TABLE, *OTHER_READINGS, *BEYOND)


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """What the filters assume; names as in the file.

    Attributes:
        p_miss, p_false: of every landmark whose clique is in view.
        prior_mean_steps: of the exponential lifetime.
        rho_high: belief from which on a measurement is used.
        rho_low: belief below which a clique is removed.
        suppression_share: delta.
        observed_m: s_obs.
        degradation_factor: length scale of JCFR's miss rate, over s_obs.
        degraded_p_miss: its least and most.
        pairwise_own, pairwise_neighbours, pairwise_reach_m: of the pairwise Joint Feature Filter.
        mixture_weight: of the mixture form.
        tuned_p_false: of the tuned clique filter.
        own_rho_high, own_rho_low: the two decisions of who takes a belief for what it says.
    """

    p_miss: float
    p_false: float
    prior_mean_steps: float
    rho_high: float
    rho_low: float
    suppression_share: float
    observed_m: float
    degradation_factor: float
    degraded_p_miss: tuple[float, float]
    pairwise_own: float
    pairwise_neighbours: int
    pairwise_reach_m: float
    mixture_weight: float
    tuned_p_false: float
    own_rho_high: float
    own_rho_low: float


@dataclass(frozen=True, slots=True)
class Settings:
    """Everything that can be varied; `default_settings` is the file.

    Attributes:
        world: the nominal world but for its sensor, names as in the file.
        filters: what the filters assume.
        sweep: values of single parameters, by section (`world`, `filters`) and name.
        runs: simulated for every world and sensor.
        tuning_runs: of other seeds, for the miss rate of `jcf-tuned`.
        known_runs: of other seeds, in which the sensor of `learned-warm` has been learned.
        sweep_runs: for every value of the sweep; no more than `runs`.
        bootstrap_draws: for every standard error.
        seed: of everything random.
        worlds: of `WORLDS`.
        chosen: of `FILTERS`, in all these worlds. None: all of them in `READINGS`, `IN_ALL_WORLDS` in the others, and
            the sweep.
    """

    world: dict[str, Any]
    filters: FilterSettings
    sweep: dict[str, dict[str, list[float]]]
    runs: int
    tuning_runs: int
    known_runs: int
    sweep_runs: int
    bootstrap_draws: int
    seed: int
    worlds: tuple[str, ...] = WORLDS
    chosen: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        for name, given, known in (("world", self.worlds, WORLDS), ("filters", self.chosen or (), FILTERS)):
            unknown = [item for item in given if item not in known]
            if unknown:
                raise ConfigError(f"there is no {unknown[0]!r}", field=name, hint=", ".join(known))
        check_least(self, runs=2, tuning_runs=1, known_runs=1, sweep_runs=2, bootstrap_draws=2, seed=0)

    def filters_in(self, world: str) -> tuple[str, ...]:
        """What is run in a world, in the order of the tables."""
        wanted = self.chosen or (FILTERS if world in READINGS else IN_ALL_WORLDS)
        return tuple(name for name in FILTERS if name in wanted)

    def world_of(self, name: str, sensor: str) -> CliqueWorld:
        """The nominal world as the file has it, with what makes the named one harsher."""
        plain, harsher = (named_world(which, SENSORS[sensor]) for which in (NOMINAL, name))
        changed = {
            f.name: getattr(harsher, f.name)
            for f in fields(CliqueWorld)
            if getattr(harsher, f.name) != getattr(plain, f.name)
        }
        return CliqueWorld(**(_world_arguments(self.world) | {"field": SENSORS[sensor]} | changed))

    def varied(self, section: str, name: str, value: float) -> Settings:
        """With one parameter of the sweep at another value."""
        if section == "world":
            return replace(self, world=self.world | {name: value})
        changes: dict[str, Any] = {name: value}
        return replace(self, filters=replace(self.filters, **changes))

    def value_of(self, section: str, name: str) -> float:
        """A parameter of the sweep, at its place in the file."""
        return float(self.world[name] if section == "world" else getattr(self.filters, name))


def _world_arguments(table: dict[str, Any]) -> dict[str, Any]:
    """Keys and values of the file as `CliqueWorld` has them."""
    given: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in table.items()}
    if "viewing_angle_deg" in given:
        given["viewing_angle_rad"] = math.radians(given.pop("viewing_angle_deg"))
    return given


def default_settings(**changes: Any) -> Settings:
    """`settings.toml`, with fields of `Settings` that are to differ.

    Raises:
        ConfigError: a world or filter that does not exist, or a number out of range.
    """
    text = resources.files("evermap_studies.bateman2020").joinpath("settings.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)
    filters = table["filters"] | {"degraded_p_miss": tuple(table["filters"]["degraded_p_miss"])}
    given = {"world": table["world"], "filters": FilterSettings(**filters), "sweep": table["sweep"], **table["runs"]}
    return Settings(**(given | changes))
