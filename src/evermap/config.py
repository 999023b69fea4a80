"""Everything that can be set: nested, frozen, every field with a default, a bound and a meaning.

A run needs no configuration. What is set comes from a TOML file, then from `--set slam.robust=false` overrides:

    config = load_config("my.toml", ["slam.seed=3"])

The configuration in force is written beside the results (`summary.json`), and `to_toml` prints it with its meanings.
This module needs pydantic and is therefore imported only by what really runs, never by `import evermap`.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from evermap.errors import ConfigError, similar
from evermap.types import Sensor

Positive = Annotated[float, Field(gt=0)]
Probability = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    """Base of all sections: frozen, no unknown keys, no infinities or nan."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class CalibrationConfig(Section):
    """Which calibration states are estimated."""

    fix: dict[str, float] = Field(
        default_factory=dict,
        description="calibration states held at a value instead of estimated, by name, e.g. odometry_delay_s = 0.0",
    )


class ModesConfig(Section):
    """Landmarks with several positions (Nielsen and Hendeby 2024): gates, switching, selectors."""

    gate_probability: Probability = Field(
        default=0.95, description="a detection outside this confidence region of all modes starts a new mode"
    )
    switch_probability: Probability = Field(
        default=1e-4, description="of a landmark to be in another mode at the next look; ignored with a lifetime"
    )
    births: Literal["evidence", "gate"] = Field(
        default="evidence",
        description="'evidence' keeps a new mode that explains more than it costs, 'gate' every one, as the paper does",
    )
    lifetime: str | None = Field(
        default=None, description="prior of how long a mode lasts, e.g. 'exponential:half-life=30d'; unset: constant"
    )
    rounds: int = Field(default=10, ge=1, le=100, description="of selecting modes and relinearising, at most")
    mcts_budget: int = Field(default=200, ge=1, description="iterations of the tree search for every decision")
    mcts_window_s: Positive | None = Field(
        default=40.0, description="the tree search looks back this far [s]; unset: to the start"
    )


class ChangesConfig(Section):
    """The joint search over changes."""

    p_moved: float = Field(default=0.01, gt=0, lt=1, description="prior probability that anything moved at all")
    move_sigma_m: Positive = Field(default=0.7, description="standard deviation of a displacement, each axis [m]")
    p_rotated: Probability = Field(default=0.1, description="share of moves that also turn the group")


class SlamConfig(Section):
    """The estimator."""

    method: Literal["nohyp", "max-mixture", "nn", "em", "mcts", "viterbi", "joint"] = Field(
        default="joint", description="how landmarks that moved are explained; 'nohyp' takes the world to be static"
    )

    sensor_model: Literal["calibrated", "plain"] = Field(
        default="calibrated",
        description="'calibrated' estimates sensor and odometry errors with the map, 'plain' believes all readings",
    )
    unknown_ids: bool = Field(
        default=False, description="ignore the identities that detections carry; associate by geometry"
    )
    solver: Literal["arrow", "gtsam"] = Field(
        default="arrow",
        description="of the steps between two batch solutions: 'arrow' is our own, 'gtsam' its iSAM2, to compare with",
    )
    robust: bool = Field(default=True, description="down-weight detections of wrong identity; off only for comparison")
    outlier_log_odds: float = Field(
        default=7.0,
        gt=0,
        le=50,
        description="an outlier is as likely as an inlier at a squared normalised residual of twice this",
    )
    estimate_noise: bool = Field(
        default=True, description="learn noise levels from the recording; off: keep the nominal ones"
    )
    odometry_noise_factor: Positive = Field(
        default=1.0,
        description="factor on the odometry noise that a run starts from, and keeps where estimate_noise is off",
    )
    seed: int = Field(default=0, ge=0, description="seed of everything random")
    calibration: CalibrationConfig = Field(
        default_factory=CalibrationConfig, description="which calibration states are estimated"
    )
    modes: ModesConfig = Field(
        default_factory=ModesConfig, description="methods 'max-mixture' to 'viterbi': landmarks with several positions"
    )
    changes: ChangesConfig = Field(
        default_factory=ChangesConfig, description="method 'joint': which landmarks moved together"
    )


class LivingConfig(Section):
    """A map that lives on from session to session; parts are switched off only to see what they contribute."""

    search: Literal["joint", "gate", "none"] = Field(
        default="joint",
        description="how a session is laid over the map: 'joint' weighs all that may have moved together, with the "
        "trajectory marginalised; 'gate' one clique after the other, at the aligned poses; 'none' nothing moves",
    )
    existence: bool = Field(default=True, description="believe less in what is not seen; off: all exists for ever")
    returns: bool = Field(default=True, description="what is away may come back; off: gone is for ever (Rosen 2016)")
    misses: bool = Field(default=True, description="learn from expected detections that did not come")
    cliques: bool = Field(default=True, description="landmarks on one body share their fate")
    clique_reach_m: Positive = Field(default=1.6, description="largest extent of a body that landmarks may share [m]")
    learn_lifetimes: bool = Field(
        default=True, description="learn from this map's history how long things stay; off: anything is possible"
    )
    learn_sight: bool = Field(
        default=True, description="learn from where to where the sensor sees; off: its nominal field of view"
    )
    most_sites: int = Field(default=3, ge=1, le=100, description="sites that are remembered of one clique, at most")


class SensorConfig(Section):
    """Corrections of what the recording says about its sensor; unset fields keep the recording's value."""

    range_min_m: float | None = Field(default=None, ge=0, description="smallest range that is reported [m]")
    range_max_m: Positive | None = Field(default=None, description="largest range that is reported [m]")
    bearing_min_rad: float | None = Field(
        default=None, ge=-3.2, le=3.2, description="right edge of the field of view [rad]"
    )
    bearing_max_rad: float | None = Field(
        default=None, ge=-3.2, le=3.2, description="left edge of the field of view [rad]"
    )
    sigma_range_m: Positive | None = Field(default=None, description="nominal range noise [m]; a starting value")
    sigma_bearing_rad: Positive | None = Field(
        default=None, description="nominal bearing noise [rad]; a starting value"
    )
    p_detect: Probability | None = Field(default=None, description="probability of detecting a landmark in view")
    p_false: Probability | None = Field(default=None, description="probability of a false detection in a frame")
    mount_robot_sensor: tuple[float, float, float] | None = Field(
        default=None, description="pose of the sensor on the robot: x [m], y [m], theta [rad]"
    )

    def applied_to(self, sensor: Sensor) -> Sensor:
        """The recording's sensor with the fields that are set here; ConfigError if then nothing can be in view."""
        merged = replace(sensor, **self.model_dump(exclude_none=True))
        for low, high in (("range_min_m", "range_max_m"), ("bearing_min_rad", "bearing_max_rad")):
            if getattr(merged, low) >= getattr(merged, high):
                problem = f"{getattr(merged, low):g} is not below {high} = {getattr(merged, high):g}"
                raise ConfigError(problem, field=f"sensor.{low}")
        return merged


class OutputConfig(Section):
    """What is written beside the numbers."""

    figures: bool = Field(default=True, description="draw the figures")
    report: bool = Field(default=True, description="write report.html")
    rerun: bool = Field(default=True, description="write scene.rrd where rerun-sdk is installed")
    score_rate_hz: float = Field(
        default=2.0, gt=0, le=1000, description="rate at which a trajectory is compared with truth"
    )


class Config(Section):
    """The whole configuration, one section a table of the TOML file."""

    slam: SlamConfig = Field(default_factory=SlamConfig, description="the estimator")
    living: LivingConfig = Field(default_factory=LivingConfig, description="a map that lives on between sessions")
    sensor: SensorConfig = Field(default_factory=SensorConfig, description="corrections of the recording's sensor")
    output: OutputConfig = Field(default_factory=OutputConfig, description="what is written beside the numbers")


def load_config(path: str | Path | None = None, overrides: Iterable[str] = ()) -> Config:
    """The configuration of a TOML file (or the defaults), then overridden key by key.

    Args:
        path: TOML file with the tables of `Config`; None for the defaults.
        overrides: `section.key=value` each; the value in TOML notation, or a bare word for a string.

    Raises:
        ConfigError: unreadable file, unknown key (the nearest known one is named), or a value out of its bounds.
    """
    source = None if path is None else Path(path)
    return _validate(_overridden(_validate(_read_toml(source), source), overrides), None)


def parse_config(text: str) -> Config:
    """The configuration that `to_toml` wrote; '' for the defaults. Keys that are no more known are left out."""
    values = tomllib.loads(text)
    known = {
        section: {name: value for name, value in table.items() if name in type(getattr(Config(), section)).model_fields}
        for section, table in values.items()
        if section in Config.model_fields and isinstance(table, dict)
    }
    return _validate(known, None)


def with_overrides(config: Config, overrides: Iterable[str]) -> Config:
    """`config` with `section.key=value` overrides; errors as `load_config`."""
    return _validate(_overridden(config, overrides), None)


def to_toml(config: Config) -> str:
    """The configuration as a commented TOML file that `load_config` reads back. Unset fields are commented out."""
    return "\n".join(_table_lines(config, ())).lstrip("\n") + "\n"


def _read_toml(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(
            "no such file", path=path, hint="print one to start from with: evermap slam --show-config"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", path=path) from None
    except RecursionError:
        raise ConfigError("not valid TOML: nested too deeply", path=path) from None
    except ValueError as error:  # of TOML, and of numbers with thousands of digits
        raise ConfigError(f"not valid TOML: {error}", path=path, hint="text values need quotes") from None


def _overridden(config: Config, overrides: Iterable[str]) -> dict[str, Any]:
    """The configuration as nested dicts, with the overrides written into them."""
    values = config.model_dump()
    for override in overrides:
        key, equals, text = override.partition("=")
        names = [name.strip() for name in key.split(".")]
        if not equals or not all(names):
            raise ConfigError(f"'{override}' is no setting", hint="section.key=value, for example slam.seed=1")
        table: Any = values
        for name in names[:-1]:
            table = table.setdefault(name, {})
            if not isinstance(table, dict):
                raise ConfigError("is a value, not a section", field=".".join(names[:-1]))
        table[names[-1]] = _toml_value(text.strip())
    return values


def _toml_value(text: str) -> Any:
    """A value in TOML notation; anything that is none is a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _validate(values: Mapping[str, Any], path: Path | None) -> Config:
    """Checked configuration; the first thing that is wrong becomes one line."""
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        names = [str(name) for name in first["loc"]]
        field = ".".join(names)
        if first["type"] == "extra_forbidden":
            raise ConfigError("unknown key", path=path, field=field, hint=_nearest_key(names)) from None
        problem = f"{first['msg'][:1].lower()}{first['msg'][1:]}, not {first['input']!r}"
        raise ConfigError(problem, path=path, field=field) from None


def _nearest_key(names: list[str]) -> str:
    """The known key that resembles an unknown one most, or the keys of its section."""
    known = list(_known_keys(Config, ()))
    meant = similar(".".join(names), known, cutoff=0.6)
    in_other_section = [key for key in known if key.rsplit(".", maxsplit=1)[-1] == names[-1]]
    if meant or in_other_section:
        return meant or in_other_section[0]
    section = max(
        (key.rpartition(".")[0] for key in known if ".".join(names).startswith(key.rpartition(".")[0])), key=len
    )
    return "one of " + ", ".join(key for key in known if key.rpartition(".")[0] == section)


def _known_keys(section: type[Section], prefix: tuple[str, ...]) -> Iterable[str]:
    for name, info in section.model_fields.items():
        yield ".".join((*prefix, name))
        if isinstance(info.annotation, type) and issubclass(info.annotation, Section):
            yield from _known_keys(info.annotation, (*prefix, name))


def _table_lines(section: Section, prefix: tuple[str, ...]) -> Iterable[str]:
    """Plain values first, then sub-tables, as TOML wants them."""
    tables: list[tuple[str, Section]] = []
    if prefix:
        yield ""
        yield f"[{'.'.join(prefix)}]"
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, Section):
            tables.append((name, value))
            continue
        yield f"# {info.description}{_choices(info.annotation)}"
        yield f"# {name} =" if value is None else f"{name} = {_toml_text(value)}"
    for name, table in tables:
        yield from _table_lines(table, (*prefix, name))


def _choices(annotation: Any) -> str:
    options = [option for option in get_args(annotation) if isinstance(option, str)]
    return f" ({' | '.join(options)})" if options else ""


def _toml_text(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml_text(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_toml_text, value)) + "]"
    return json.dumps(value)
