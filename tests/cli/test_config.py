"""The configuration: defaults, files, overrides, and one line for every mistake."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel, ValidationError
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.config import Config, Section, SensorConfig, load_config, to_toml, with_overrides
from evermap.errors import ConfigError
from evermap.types import Sensor


def sections(kind: type[BaseModel] = Config) -> list[type[BaseModel]]:
    nested = [info.annotation for info in kind.model_fields.values()]
    return [kind, *(s for sub in nested if isinstance(sub, type) and issubclass(sub, Section) for s in sections(sub))]


@pytest.mark.parametrize("kind", sections(), ids=lambda kind: kind.__name__)
def test_every_field_has_a_default_and_a_meaning(kind: type[BaseModel]) -> None:
    kind()
    for name, info in kind.model_fields.items():
        assert info.description, f"{kind.__name__}.{name} has no description"
        assert not info.is_required()


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
    assert SensorConfig().applied_to(sensor) == sensor
    merged = SensorConfig(range_max_m=4.0).applied_to(sensor)
    assert (merged.range_max_m, merged.sigma_range_m) == (4.0, 0.1)
    with pytest.raises(ConfigError, match="range_min_m"):
        SensorConfig(range_min_m=9.0).applied_to(sensor)


def test_command_line_shows_the_configuration_in_force() -> None:
    result = CliRunner().invoke(app, ["slam", "--show-config", "--sensor-model", "plain", "--set", "slam.seed=7"])
    assert result.exit_code == 0
    shown = tomllib.loads(result.stdout)["slam"]
    assert (shown["sensor_model"], shown["seed"]) == ("plain", 7)
