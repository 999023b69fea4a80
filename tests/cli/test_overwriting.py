"""No command replaces a file that it did not write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer
from click.testing import Result
from typer.testing import CliRunner

from evermap.cli.main import app

FOREIGN = b"mine\n"
WRITES = {
    "map export --out": ("map", "export", "MAP", "--out", "FILE.csv"),
    "map export --lifetimes": ("map", "export", "MAP", "--lifetimes", "FILE.json"),
    "map nav2 --out": ("map", "nav2", "MAP", "--out", "FILE.yaml"),
    "map nav2, image": ("map", "nav2", "MAP", "--out", "IMAGE.yaml"),
    "map show --figure": ("map", "show", "MAP", "--figure", "FILE.png"),
    "map why --figure": ("map", "why", "MAP", "1", "--figure", "FILE.svg"),
    "survival plot --out": ("survival", "plot", "exponential:half-life=2d", "--out", "FILE.png"),
    "survival learn --out": ("survival", "learn", "LOOKS", "--set", "recurrent=two-state", "--out", "FILE.json"),
    "survival learn --figure": ("survival", "learn", "LOOKS", "--out", "other.json", "--figure", "FILE.png"),
    "survival fit --out": ("survival", "fit", "LIVES", "--out", "FILE.json"),
    "survival fit --figure": ("survival", "fit", "LIVES", "--figure", "FILE.svg"),
    "convert": ("convert", "REC", "FILE.zip", "--format", "session"),
    "view --save": ("view", "MAP", "--save", "FILE.mcap"),
    "audit --write": ("audit", "SURVEY", "REC", "--out", "audited", "--write", "FILE.csv"),
    "init looks": ("init", "looks", "FILE.csv"),
    "init detections": ("init", "detections", "FILE.csv"),
}
FORCED = {"map export --out", "map export --lifetimes", "convert", "view --save", "audit --write"}
"""What replaces a foreign file with --force."""
AGAIN = set(WRITES) - FORCED - {"init looks", "init detections"} | {"map export --lifetimes"}
"""What replaces its own file without."""


FOLDERS = {"audit", "bench", "learn", "localize", "map enter", "map reenter", "persist", "slam", "together", "track"}


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, a map of it, its survey, looks and lifetimes."""
    folder = tmp_path_factory.mktemp("place")
    assert run("init", "recording", folder / "rec").exit_code == 0
    assert run("init", "looks", folder / "looks.csv").exit_code == 0
    entered = run("map", "enter", folder / "site.evermap", folder / "rec", "--out", folder / "entered")
    assert entered.exit_code == 0, entered.output
    rows = (f"{100 + 7 * k},{100 + 7 * k if k % 2 else ''}\n" for k in range(20))
    (folder / "lives.csv").write_text("left,right\n" + "".join(rows))
    return folder


def words_of(name: str, place: Path, folder: Path) -> tuple[list[str], Path]:
    """The command line, and the file that is in its way."""
    given = {
        "MAP": "site.evermap",
        "REC": "rec",
        "LOOKS": "looks.csv",
        "LIVES": "lives.csv",
        "SURVEY": "rec/survey.csv",
    }
    words = [str(place / given[word]) if word in given else word for word in WRITES[name]]
    out = ("FILE", "IMAGE", "other", "audited")
    words = [str(folder / word) if word.startswith(out) else word for word in words]
    file = next(Path(word) for word in words if Path(word).stem in ("FILE", "IMAGE"))
    return words, file.with_suffix(".pgm") if file.stem == "IMAGE" else file


@pytest.mark.parametrize("name", WRITES)
def test_what_evermap_did_not_write_stays(name: str, place: Path, tmp_path: Path) -> None:
    words, file = words_of(name, place, tmp_path)
    file.write_bytes(FOREIGN)
    done = run(*words)
    assert done.exit_code == 2, done.output
    assert "Traceback" not in done.output
    assert file.read_bytes() == FOREIGN
    if name in FORCED:
        done = run(*words, "--force")
        assert done.exit_code in (0, 4), done.output  # 4: an audit that found something
        assert file.read_bytes() != FOREIGN


@pytest.mark.parametrize("name", sorted(AGAIN))
def test_what_it_wrote_is_replaced(name: str, place: Path, tmp_path: Path) -> None:
    words, file = words_of(name, place, tmp_path)
    for _ in range(2):
        done = run(*words)
        assert done.exit_code == 0, done.output
        assert file.exists()


def test_a_survey_beside_a_recording_is_not_replaced(place: Path, tmp_path: Path) -> None:
    """As it was by the map of the recording."""
    survey = place / "rec" / "survey.csv"
    before = survey.read_bytes()
    done = run("map", "export", place / "site.evermap", "--out", survey)
    assert done.exit_code == 2
    assert "is there already" in done.output
    assert survey.read_bytes() == before


def options_that_write(command: Any = None, words: tuple[str, ...] = ()) -> set[str]:
    """Options of verbs of ours that name a file to write."""
    command = typer.main.get_command(app) if command is None else command
    found = set()
    for name, verb in getattr(command, "commands", {}).items():
        found |= options_that_write(verb, (*words, name))
    for one in command.params:
        if not one.hidden and set(one.opts) & {"--out", "--write", "--figure", "--save", "--lifetimes"}:
            found.add(" ".join((*words, one.opts[0])))
    return found


def test_all_options_that_write_a_file_are_asked() -> None:
    """But for folders, which `RunFolder` protects."""
    folders = set[str]()
    for one in options_that_write():
        if one not in WRITES:
            verb, _, option = one.rpartition(" ")
            assert option == "--out", one
            folders.add(verb)
    assert folders == FOLDERS
