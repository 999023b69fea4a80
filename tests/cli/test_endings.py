"""However a run ends: the exit code, and one line on stderr that says why."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from typer.testing import CliRunner, Result

import evermap
from evermap.cli.main import app
from evermap.errors import InputError

VERBS = [
    "demo", "simulate", "init", "check", "info", "slam", "localize", "together", "audit", "live", "play", "persist",
    "track", "view", "convert", "score", "work", "learn", "bench",
]  # fmt: skip
GROUPS = {
    "map": [
        "log",
        "show",
        "diff",
        "enter",
        "export",
        "nav2",
        "why",
        "verify",
        "gc",
        "compact",
        "reenter",
        "revert",
        "pin",
        "unpin",
        "delete",
        "undelete",
        "rename",
    ],
    "serve": ["token", "doctor"],
    "survival": ["plot", "fit", "learn"],
}


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


@pytest.fixture
def failing_read(monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], None]:
    """Makes `evermap convert` end with an exception of our choice."""

    def install(error: BaseException) -> None:
        def read_recording(*_: Any, **__: Any) -> None:
            raise error

        monkeypatch.setattr("evermap.io.read_recording", read_recording)

    return install


def assert_one_line(result: Result, code: int) -> str:
    assert result.exit_code == code
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("evermap: ")
    return result.stderr.strip()


def test_mistake_of_the_user_is_one_line_and_2(failing_read: Callable[..., None], tmp_path: Any) -> None:
    failing_read(InputError("not a number: 'a'\n", path="x.csv", line=7, field="range_m", hint="1.0"))
    line = assert_one_line(run("convert", "x.csv", str(tmp_path / "out")), 2)
    assert line == "evermap: error: x.csv:7: field 'range_m': not a number: 'a' (try: 1.0)"


def test_defect_is_one_line_and_1(failing_read: Callable[..., None], tmp_path: Any) -> None:
    failing_read(KeyError("oh"))
    line = assert_one_line(run("convert", "x.csv", str(tmp_path / "out")), 1)
    assert "KeyError: 'oh'" in line
    assert "evermap --debug" in line


def test_debug_shows_the_traceback_of_a_defect(failing_read: Callable[..., None], tmp_path: Any) -> None:
    failing_read(KeyError("oh"))
    result = run("--debug", "convert", "x.csv", str(tmp_path / "out"))
    assert isinstance(result.exception, KeyError)


@pytest.mark.parametrize(("kept", "said"), [("", "no result was written"), ("3 of 6 are in out", "3 of 6 are in out")])
def test_interrupt_says_what_was_kept_and_130(
    failing_read: Callable[..., None], tmp_path: Any, kept: str, said: str
) -> None:
    failing_read(KeyboardInterrupt(kept) if kept else KeyboardInterrupt())
    assert assert_one_line(run("convert", "x.csv", str(tmp_path / "out")), 130) == f"evermap: interrupted: {said}"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["slm"], "'slam'"),
        (["slam", "--nope"], "--nope"),
        (["slam", "--robot", "one"], "--robot"),
        (["slam", "--set", "sensor_model=magic"], "calibrated"),
        (["convert", "only-one"], "OUT"),
        (["reproduce", "rosen1999"], "rosen2016"),
        (["slam"], "INPUT"),
        (["init", "rosbag", "x"], "flight"),
        (["slam", "--set", "slam.sed=1", "x"], "slam.seed"),
        (["slam", "--config", "no-such.toml", "x"], "no-such.toml"),
        (["slam", "no/such/recording"], "no/such/recording"),
    ],
)
def test_wrong_command_line_is_one_line_and_2(arguments: list[str], named: str) -> None:
    line = assert_one_line(run(*arguments), 2)
    assert line.startswith("evermap: error: ")
    assert named in line
    assert "try: " in line


def test_results_never_mix_with_what_is_there(tmp_path: Any) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for arguments in (["demo", "--out"], ["simulate"], ["slam", "x", "--out"], ["convert", "x"], ["init", "flight"]):
        line = assert_one_line(run(*arguments, str(tmp_path)), 2)
        assert str(tmp_path) in line
    for arguments in (["demo", "--out"], ["simulate"], ["slam", "x", "--out"]):
        line = assert_one_line(run(*arguments, str(tmp_path / "notes.txt")), 2)
        assert "is a file" in line
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_every_verb_has_an_example(verb: str) -> None:
    result = run(verb, "--help")
    assert result.exit_code == 0
    assert f"  evermap {verb}" in result.stdout.partition("Example")[2]
    assert "--json" in result.stdout


def test_help_lists_every_verb_and_nothing_is_cut_short() -> None:
    result = run("--help")
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.stdout.partition("Commands:")[2].splitlines() if line.strip()][:-1] == [
        *VERBS,
        *GROUPS,
        "reproduce",
    ]
    assert "..." not in result.stdout.partition("Commands:")[2]


@pytest.mark.parametrize("group", GROUPS)
def test_groups_list_their_verbs_with_an_example_each(group: str) -> None:
    listed = run(group, "--help").stdout.partition("Commands:")[2]
    assert [line.split()[0] for line in listed.splitlines() if line.strip()] == GROUPS[group]
    assert "..." not in listed
    for verb in GROUPS[group]:
        shown = run(group, verb, "--help").stdout
        assert f"  evermap {group} {verb}" in shown.partition("Example")[2]
        assert "--json" in shown


def test_version() -> None:
    result = run("--version")
    assert (result.exit_code, result.stdout) == (0, f"evermap {evermap.__version__}\n")


def test_completion_script_knows_the_command() -> None:
    result = CliRunner().invoke(app, [], prog_name="evermap", env={"_EVERMAP_COMPLETE": "source_bash"})
    assert "complete" in result.stdout
    assert "evermap" in result.stdout
