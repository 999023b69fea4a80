"""What goes with a release: changelog, citation and type markers agree with the package."""

from __future__ import annotations

import configparser
import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

import evermap
from evermap.cli.main import app

REPOSITORY = Path(__file__).resolve().parents[2]


def test_the_changelog_has_unreleased_changes_and_this_version() -> None:
    headings = re.findall(r"^## \[([^\]]+)\]", (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert evermap.__version__ in headings


def test_the_citation_is_valid_and_of_this_version() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)  # what the format requires
    assert citation["version"] == evermap.__version__
    assert [reference["year"] for reference in citation["references"]] == [2016, 2020, 2024]
    for reference in citation["references"]:
        assert {"type", "title", "authors"} <= set(reference)
        assert all("family-names" in author for author in reference["authors"])


@pytest.mark.parametrize(
    "package", ["src/evermap", "studies/src/evermap_studies", "packages/evermap-score/src/evermap_score"]
)
def test_a_package_says_that_it_is_typed(package: str) -> None:
    assert (REPOSITORY / package / "py.typed").is_file()


def test_the_service_and_the_container_start_what_exists() -> None:
    """Options, extras and files of the examples, and that they are stopped with more patience than entering takes."""
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(REPOSITORY / "examples" / "evermap-live.service", encoding="utf-8")
    assert unit.sections() == ["Unit", "Service", "Install"]
    binary, verb, *started = shlex.split(unit["Service"]["ExecStart"])
    assert Path(binary).name == "evermap"
    assert unit["Service"]["WorkingDirectory"] == f"/var/lib/{unit['Service']['StateDirectory']}"
    assert int(unit["Service"]["TimeoutStopSec"]) >= 120
    container = (REPOSITORY / "examples" / "Containerfile").read_text(encoding="utf-8")
    lists = dict(re.findall(r"^(ENTRYPOINT|CMD) (.*)$", container, re.MULTILINE))
    assert json.loads(lists["ENTRYPOINT"]) == ["evermap", "live"]
    shown = CliRunner().invoke(app, [verb, "--help"], terminal_width=200).stdout
    for arguments in (started, json.loads(lists["CMD"])):
        options = [one for one in arguments if one.startswith("--")]
        assert options
        assert all(re.search(rf"{one}\b", shown) for one in options)
        assert dict(zip(arguments[1::2], arguments[2::2], strict=True))["--sensor"] == "sensor.toml"
    for copied in re.findall(r"^COPY (.*) \S+$", container, re.MULTILINE):
        assert all((REPOSITORY / name).exists() for name in copied.split())
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for text in (container, (REPOSITORY / "examples" / "evermap-live.service").read_text(encoding="utf-8")):
        named = re.findall(r"(?:evermap|/src)\[(\w+)\]", text)
        assert named
        assert set(named) <= extras["optional-dependencies"].keys()


def test_the_examples_of_a_server_start_what_exists() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(REPOSITORY / "examples" / "evermap-serve.service", encoding="utf-8")
    services = yaml.safe_load((REPOSITORY / "examples" / "compose.yaml").read_text(encoding="utf-8"))["services"]
    started = [
        shlex.split(unit["Service"]["ExecStart"]),
        *(services[name]["entrypoint"] for name in ("server", "worker")),
    ]
    for binary, verb, *arguments in started:
        assert Path(binary).name == "evermap"
        shown = CliRunner().invoke(app, [verb, "--help"], terminal_width=200).stdout
        assert all(re.search(rf"{one}\b", shown) for one in arguments if one.startswith("--"))
    assert services["server"]["environment"]["EVERMAP_STORE"].startswith("postgresql://")
    assert "EVERMAP_STORE" in shown
