"""The configuration: defaults, files, overrides, and one line for every mistake."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel, ValidationError
from typer.testing import CliRunner

import evermap
from evermap.cli.main import app
from evermap.config import (
    Config,
    Section,
    SensorConfig,
    load_config,
    parse_config,
    to_toml,
    with_overrides,
    with_rules,
)
from evermap.config.section import find_rule
from evermap.errors import ConfigError
from evermap.slam.calibration import NAMES, CalibrationPrior
from evermap.types import Sensor

SOURCE = Path(evermap.__file__).parent
UNBOUNDED = {"score_midpoint", "min_score"}
"""Scores of detectors, of any scale."""


def sections(kind: type[BaseModel] = Config) -> list[type[BaseModel]]:
    nested = [info.annotation for info in kind.model_fields.values()]
    return [kind, *(s for sub in nested if isinstance(sub, type) and issubclass(sub, Section) for s in sections(sub))]


@pytest.mark.parametrize("kind", sections(), ids=lambda kind: kind.__name__)
def test_every_field_has_a_default_and_a_meaning(kind: type[BaseModel]) -> None:
    kind()
    for name, info in kind.model_fields.items():
        assert info.description, f"{kind.__name__}.{name} has no description"
        assert not info.is_required()


@pytest.mark.parametrize("kind", sections(), ids=lambda kind: kind.__name__)
def test_every_number_has_bounds(kind: type[BaseModel]) -> None:
    for name, info in kind.model_fields.items():
        alone = {float, int, float | None, int | None} & {info.annotation}
        assert not alone or info.metadata or "Gt(" in str(info.annotation) or name in UNBOUNDED, (
            f"{kind.__name__}.{name}"
        )


def leaves(section: Section, prefix: str = "") -> Iterator[tuple[str, object]]:
    for name in type(section).model_fields:
        value = getattr(section, name)
        yield from leaves(value, f"{prefix}{name}.") if isinstance(value, Section) else [(prefix + name, value)]


@pytest.mark.parametrize("name", Config.model_fields)
def test_every_key_is_set_by_its_name_and_written_as_it_is(name: str) -> None:
    """One by one, as `--set` and `summary.json` name them; the printed file has each with its meaning."""
    config, shown = Config(), to_toml(Config())
    for key, value in leaves(getattr(config, name), f"{name}."):
        *path, last = key.split(".")
        of_run = config.to_dict()
        for part in path:
            of_run = of_run[part]
        assert of_run[last] == json.loads(json.dumps(value))
        if find_rule(Config, key.split(".")):
            assert with_rules(config, {key: value}) == config
            continue
        assert f"{last} =" in shown
        if value is not None and not isinstance(value, dict):
            assert with_overrides(config, [f"{key}={json.dumps(value)}"]) == config


def test_keys_are_what_a_user_sets_with_sense_and_fit_on_three_screens() -> None:
    names = [name for name, _ in leaves(Config())]
    assert sum(not find_rule(Config, name.split(".")) for name in names) <= 150
    shown = to_toml(Config()).splitlines()
    assert len(shown) <= 3 * 75
    assert [line for line in shown if " = " in line and "  # " not in line] == []
    assert "[slam.votes]" not in shown, "a section of rules alone"
    assert "[slam.explain]" in shown


@pytest.mark.parametrize(
    ("content", "override", "named"),
    [
        ("[living.looks]\nsticky = 3.0", "living.looks.sticky=3", "living.looks.sticky"),
        ("[slam]\nnarrowing = 'no'", "slam.narrowing=no", "slam.narrowing"),
        ("[slam.votes]\ngate = 1.0", "slam.votes.gate=1", "slam.votes"),
        ("[slam]\nvotes = {}", "slam.votes={}", "slam.votes"),
    ],
)
def test_rules_of_the_method_are_no_keys(content: str, override: str, named: str, tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    path.write_text(content, encoding="utf-8")
    for attempt in (lambda: load_config(path), lambda: load_config(None, [override])):
        with pytest.raises(ConfigError, match="is no key that can be set") as caught:
            attempt()
        assert named in str(caught.value)
        assert "--show-config lists the keys" in str(caught.value)


def test_an_experiment_may_change_rules_and_maps_keep_what_it_changed() -> None:
    config = with_rules(Config(), {"living.looks.sticky": 3.0, "slam.seed": 5})
    assert (config.living.looks.sticky, config.slam.seed) == (3.0, 5)
    written = to_toml(config)
    assert "sticky = 3.0" in written
    assert "witnesses" not in written, "a rule as it comes"
    assert parse_config(written) == config
    with pytest.raises(ConfigError, match=r"living\.looks\.sticky"):
        with_rules(Config(), {"living.looks.sticky": 0.0})
    with pytest.raises(ConfigError, match="unknown key"):
        with_rules(Config(), {"living.looks.stiky": 3.0})


def test_every_key_is_read_by_the_code() -> None:
    own = sorted((SOURCE / "config").glob("*.py"))
    modules = [path for path in SOURCE.rglob("*.py") if path not in own]
    of_itself = re.findall(r"self\.\w+", "".join(path.read_text("utf-8") for path in own))
    read = set(re.findall(r"(?:\.|getattr\(\w+, \")(\w+)", "".join(path.read_text("utf-8") for path in modules)))
    read |= {name.removeprefix("self.") for name in of_itself}
    keys = [key for key, _ in leaves(Config()) if not key.startswith("slam.modes.")]  # of methods in other packages
    assert [key for key in keys if key.rpartition(".")[2] not in read] == []


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("slam.calibration.sigma.range_slop", 0.1),
        ("slam.calibration.kinds.sonar", [1, 1, 1, 1, 1]),
        ("slam.changes.most_groups", 0),
        ("slam.votes.gate", 0),
        ("slam.space.map.p_moved", 1),
        ("living.boxes.found_pairs", 1),
        ("track.shape.misplaced", 0.5),
        ("live.beliefs_s", 0),
    ],
)
def test_values_out_of_bounds_are_refused(name: str, value: object) -> None:
    for attempt in (with_rules, lambda config, values: load_config(None, values=values)):
        with pytest.raises(ConfigError):
            attempt(Config(), {name: value})


def test_priors_of_calibration_are_set_one_by_one() -> None:
    config = load_config(None, ["slam.calibration.sigma.range_slope=0.5", "slam.calibration.kinds.laser=[1,1,1,1,1]"])
    prior = CalibrationPrior.from_settings(config.slam.calibration, calibrated=True)
    usual = CalibrationPrior.from_settings(calibrated=True)
    assert [name for name, one, other in zip(NAMES, prior.sigma, usual.sigma, strict=True) if one != other] == [
        "range_slope"
    ]
    assert config.slam.calibration.kinds["camera"] == Config().slam.calibration.kinds["camera"]


def test_configuration_is_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Config().slam.seed = 1  # type: ignore[misc]


def test_file_then_overrides(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    path.write_text("[slam]\nseed = 3\nrobust = false\n[sensor]\nrange_max_m = 8\n", encoding="utf-8")
    config = load_config(path, ["slam.seed=4", "slam.sensor_model=plain", "slam.calibration.fix.odometry_delay_s=0.25"])
    assert (config.slam.seed, config.slam.robust, config.slam.sensor_model) == (4, False, "plain")
    assert config.slam.calibration.fix == {"odometry_delay_s": 0.25}
    assert config.sensor.range_max_m == 8.0
    assert with_overrides(config, ["slam.seed=3"]).slam.seed == 3
    assert load_config() == Config()


def test_printed_configuration_reads_back_as_it_was(tmp_path: Path) -> None:
    config = load_config(
        None,
        ["slam.robust=false", "sensor.mount_robot_sensor=[0.1, 0, -3e-9]", "slam.calibration.fix={a = 1.5, b = -2.0}"],
    )
    path = tmp_path / "printed.toml"
    path.write_text(to_toml(config), encoding="utf-8")
    assert load_config(path) == config
    assert tomllib.loads(to_toml(Config()))["slam"]["robust"] is True


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("[slam]\nrobst = true", ["slam.robst", "unknown key", "try: slam.robust"]),
        ("[slam.calibraton]\n", ["slam.calibraton", "try: slam.calibration"]),
        ("robust = true", ["'robust'", "try: slam.robust"]),
        ("[odometry]\nsigma_askew_rad = 0.1", ["'odometry'", "try: sensor.sigma_askew_rad"]),
        ("[colour]\nx = 1", ["'colour'", "one of slam, living, sensor"]),
        ("[slam]\nseed = -1", ["slam.seed", "greater than or equal to 0", "-1"]),
        ("[slam]\nseed = 1.5", ["slam.seed", "1.5"]),
        ("[slam]\nsensor_model = 'magic'", ["slam.sensor_model", "'calibrated' or 'plain'", "magic"]),
        ("[sensor]\nsigma_range_m = nan", ["sensor.sigma_range_m", "finite"]),
        ("[slam.calibration.fix]\ndelay = 'x'", ["slam.calibration.fix.delay", "'x'"]),
        ("slam = 3", ["'slam'", "3"]),
        ("[slam\n", ["not valid TOML", "line 1"]),
    ],
)
def test_mistake_in_a_file_names_file_and_field(tmp_path: Path, content: str, named: list[str]) -> None:
    path = tmp_path / "my.toml"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    for part in (str(path), *named):
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("slam.sed=1", "try: slam.seed"),
        ("odometry.sigma_askew_rad=0.1", "try: sensor.sigma_askew_rad"),
        ("calibration.fix.range_slope=0", "try: slam.calibration.fix"),
        ("persist.rest_for_s=1", "try: track.rest_for_s"),
        ("slam.seed", "section.key=value"),
        ("=1", "section.key=value"),
        ("slam..seed=1", "section.key=value"),
        ("slam.seed.deeper=1", "'slam.seed': is a value"),
        ("sensor.p_detect=1.5", "less than or equal to 1"),
        ("slam.seed=[1", "[1"),
    ],
)
def test_mistake_in_an_override_names_the_field(override: str, named: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(None, [override])
    assert named in str(caught.value)


def test_unreadable_files(tmp_path: Path) -> None:
    (tmp_path / "latin.toml").write_bytes(b"# caf\xe9\n")
    for path, problem in (
        (tmp_path / "no.toml", "no such file"),
        (tmp_path / "latin.toml", "read"),
        (tmp_path, "read"),
    ):
        with pytest.raises(ConfigError, match=problem):
            load_config(path)


def test_sensor_section_corrects_only_what_it_sets() -> None:
    sensor = Sensor(range_max_m=9.0, sigma_range_m=0.1)
    assert SensorConfig().apply_to(sensor) == sensor
    merged = SensorConfig(range_max_m=4.0).apply_to(sensor)
    assert (merged.range_max_m, merged.sigma_range_m) == (4.0, 0.1)
    with pytest.raises(ConfigError, match="range_min_m"):
        SensorConfig(range_min_m=9.0).apply_to(sensor)


def test_command_line_shows_the_configuration_in_force() -> None:
    result = CliRunner().invoke(app, ["slam", "--show-config", "--set", "sensor_model=plain", "--set", "slam.seed=7"])
    assert result.exit_code == 0
    shown = tomllib.loads(result.stdout)["slam"]
    assert (shown["sensor_model"], shown["seed"]) == ("plain", 7)
