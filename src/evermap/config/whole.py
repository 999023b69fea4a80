"""The whole configuration: of files, overrides and Python, and back into a file."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from evermap.config.living import LivingConfig
from evermap.config.section import Section, _words_of, config_error, find_rule, is_rule, part
from evermap.config.sensor import SensorConfig
from evermap.config.slam import SlamConfig
from evermap.config.track import TrackConfig
from evermap.config.verbs import LiveConfig, OutputConfig, PersistConfig, SurvivalConfig
from evermap.errors import ConfigError

UNREAD_IN_THE_PLANE = ("slam.space", "slam.association.space", "track", "living.boxes")
UNREAD_IN_SPACE = (
    "slam.method", "slam.sensor_model", "slam.outlier_log_odds", "slam.rejected_in_a_row",
    "slam.narrowing", "slam.odometry_noise_factor", "slam.calibration", "slam.modes",
    "slam.changes", "slam.noise", "slam.odometry", "slam.ranges", "slam.localize", "slam.cleaning", "slam.check",
    "slam.association.particles", "living.metre",
)  # fmt: skip
UNREAD_WITHOUT_BOXES = ("track", "living.boxes", "slam.space.traffic", "slam.space.range_scale")
UNREAD_WITHOUT_MAP = ("living.search", "living.metre", "living.lifetimes", "living.boxes", "living.prior_stays")
"""Keys and sections that `evermap slam` does not read for some recordings: setting one is refused."""


class Config(Section):
    """The whole configuration, one section a table of the TOML file."""

    slam: SlamConfig = part(SlamConfig, "the estimator")
    living: LivingConfig = part(LivingConfig, "a living map")
    sensor: SensorConfig = part(SensorConfig, "overrides of the recording's sensor")
    output: OutputConfig = part(OutputConfig, "additional outputs")
    persist: PersistConfig = part(PersistConfig, "a table of looks")
    track: TrackConfig = part(TrackConfig, "a table of detections")
    survival: SurvivalConfig = part(SurvivalConfig, "a table of lifetimes")
    live: LiveConfig = part(LiveConfig, "a live session")


def load_config(
    path: str | Path | None = None,
    overrides: Iterable[str] = (),
    values: Mapping[str, Any] | None = None,
    *,
    within: str = "",
) -> Config:
    """Return the configuration of a TOML file (or the defaults), then overridden key by key.

    Args:
        path: TOML file with the tables of `Config`; None for the defaults.
        overrides: `section.key=value` each; the value in TOML notation, or a bare word for a string.
        values: further overrides by key, as values; None leaves a key as it is.
        within: section that keys without a dot are taken to be of.

    Raises:
        ConfigError: unreadable file, unknown key (the nearest known one is named), or a value out of its bounds.
    """
    source = None if path is None else Path(path)
    content = _read_toml(source)
    _refuse_rules(content, (), source)
    return _overridden(_validate(content, source), overrides, values or {}, within)


def with_rules(config: Config, rules: Mapping[str, Any]) -> Config:
    """Return `config` with values of rules and keys, by their dotted names: for experiments with the method itself.

    None leaves one as it is.
    """
    return _overridden(config, (), rules, "")


def _refuse_rules(content: Mapping[str, Any], prefix: tuple[str, ...], path: Path | None) -> None:
    """Refuse rules among values that a user gave, before their types are checked."""
    for name, value in content.items():
        names = (*prefix, name)
        if find_rule(Config, names):
            raise _rule_error(names, path)
        if isinstance(value, Mapping):
            _refuse_rules(value, names, path)


RETIRED = (
    "living.lifetimes.prior_quantiles", "living.lifetimes.prior_shortest_s", "living.lifetimes.prior_longest_s",
    "living.overlay.turn_m", "living.overlay.p_split", "slam.calibration.p_needed_mount",
)  # fmt: skip
"""Keys of earlier versions which nothing reads any more; maps keep them with the settings of their sessions."""


def parse_config(text: str) -> Config:
    """Return the configuration that `to_toml` wrote, of this version or of an earlier one; '' for the defaults.

    Raises:
        ConfigError: a key or a value that this version does not know.
    """
    content = tomllib.loads(text)
    for key_path in RETIRED:
        *sections, name = key_path.split(".")
        section: Any = content
        for each in sections:
            section = section.get(each, {})
        section.pop(name, None)
    return _validate(content, None)


def with_overrides(config: Config, overrides: Iterable[str]) -> Config:
    """Return `config` with `section.key=value` overrides; errors as `load_config`."""
    return _overridden(config, overrides, {}, "")


def refuse_unread(overrides: Iterable[str], unread: Mapping[str, Iterable[str]], *, within: str = "") -> None:
    """Refuse overrides of what is not read, which would change nothing.

    Args:
        overrides: as of `load_config`.
        unread: keys and sections, by why they are not read.
        within: as of `load_config`.

    Raises:
        ConfigError: names the first such key.
    """
    for override in overrides:
        key = _complete_key(override.partition("=")[0], within)
        for why, names in unread.items():
            if any(f"{key}.".startswith(f"{name}.") for name in names):
                raise ConfigError(f"would change nothing: not read {why}", field=key, hint="leave it out")


def to_toml(config: Config) -> str:
    """Return a commented TOML file that `parse_config` reads back, and `load_config` if no rule was changed.

    Unset fields are commented out.
    """
    return "\n".join(_table_lines(config, ())).lstrip("\n") + "\n"


def _read_toml(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError("no such file", path=path, hint="print a template with: evermap slam --show-config") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", path=path) from None
    except RecursionError:
        raise ConfigError("not valid TOML: nested too deeply", path=path) from None
    except ValueError as error:  # of TOML, and of numbers with thousands of digits
        raise ConfigError(f"not valid TOML: {error}", path=path, hint="text values need quotes") from None


def _overridden(config: Config, overrides: Iterable[str], values: Mapping[str, Any], within: str) -> Config:
    content = config.model_dump()
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not all(name.strip() for name in key.split(".")):
            raise ConfigError(f"invalid setting '{override}'", hint="section.key=value, for example slam.seed=1")
        names = _complete_key(key, within).split(".")
        if find_rule(Config, names):
            raise _rule_error(names, None)
        _set(content, key, _toml_value(text.strip()), within)
    for key, value in values.items():
        if value is not None:
            _set(content, key, value, within)
    return _validate(content, None)


def _set(content: dict[str, Any], key: str, value: Any, within: str) -> None:
    """Write a value into nested dicts by its dotted key; one without a dot is of the section `within`."""
    names = _complete_key(key, within).split(".")
    table: Any = content
    for name in names[:-1]:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise ConfigError("is a value, not a section", field=".".join(names[:-1]))
    table[names[-1]] = value


def _complete_key(key: str, within: str) -> str:
    if within and "." not in key and key.strip() not in Config.model_fields:
        key = f"{within}.{key}"
    return ".".join(name.strip() for name in key.split("."))


def _toml_value(text: str) -> Any:
    """A value in TOML notation; anything that is none is a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _rule_error(names: Iterable[str], path: Path | None) -> ConfigError:
    hint = "evermap slam --show-config lists the keys; the rules of the method come with evermap"
    return ConfigError("is no key that can be set", path=path, field=".".join(names), hint=hint)


def _validate(values: Mapping[str, Any], path: Path | None) -> Config:
    """Return the checked configuration; the first thing that is wrong becomes one line."""
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        raise config_error(Config, error, path) from None


def _table_lines(section: Section, prefix: tuple[str, ...]) -> Iterable[str]:
    """Plain values first, then sub-tables, as TOML wants them; of rules, those that were changed."""
    tables, lines = list[str](), list[str]()
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, Section):
            tables += _table_lines(value, (*prefix, name))
            continue
        if is_rule(info) and value == info.default:
            continue
        words = " | ".join(_words_of(info.annotation))
        said = f"# {name} =" if value is None else f"{name} = {_toml_text(value)}"
        lines.append(f"{said}  # {info.description}{f' ({words})' if words else ''}")
    head = ["", f"[{'.'.join(prefix)}]"] if prefix and lines else []
    return [*head, *lines, *tables]


def _toml_text(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml_text(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_toml_text, value)) + "]"
    return json.dumps(value)
