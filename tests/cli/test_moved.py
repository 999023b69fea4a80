"""Verbs of at most ten options; old spellings do what the new ones do, and a last line names these."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner, Result

from evermap import plugins
from evermap.cli import reproduce
from evermap.cli.main import app
from evermap.cli.moved import MOVED, options_of, renew, write_number, write_text
from evermap.cli.options import workers_of
from evermap.errors import ConfigError

ROOT = typer.main.get_command(app)
MOST = 10
"""Options of a verb."""
QUICK = ["--set", "output.figures=false", "--set", "output.report=false"]


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def verbs(command: Any = ROOT, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """All verbs of ours, groups too; not those that studies bring."""
    yield " ".join(words), command
    for name in getattr(command, "commands", ()):
        yield from verbs(command.commands[name], (*words, name))


def options(verb: str) -> dict[str, Any]:
    return options_of(dict(verbs())[verb])


def list_shown(verb: str) -> set[str]:
    """Options that the help of a verb lists."""
    return {one.opts[0] for one in options(verb).values() if not one.hidden} - {"--help"}


@pytest.mark.parametrize("verb", [name for name, _ in verbs()])
def test_a_verb_has_at_most_ten_options(verb: str) -> None:
    assert len(list_shown(verb)) <= MOST


@pytest.mark.parametrize("group", ["evermap.verbs", "evermap.studies"])
def test_so_has_one_of_another_package(group: str) -> None:
    assert plugins.found(group)
    for name in plugins.found(group):
        found = options_of(reproduce.command(group, name))
        assert len({one.opts[0] for one in found.values() if not one.hidden} - {"--help"}) <= MOST, name


def test_options_of_another_package_move_by_its_own_table(tmp_path: Path) -> None:
    lines = []
    for name, given in (("old", ["--standing", "--plane"]), ("new", ["--with", "standing", "--with", "plane"])):
        result = run("simulate", "yard", tmp_path / name, "--days", "1", "--moving", "1", *given)
        assert result.exit_code == 0, result.stderr
        lines.append(result.stderr.splitlines()[-1])
    made = shlex.join(["simulate", "yard", str(tmp_path / "old"), "--days", "1", "--moving", "1"])
    assert lines[0] == f"evermap: --standing and --plane are now: evermap {made} --with standing --with plane"
    assert " now: " not in lines[1]
    files = [sorted(file.relative_to(tmp_path / name) for file in (tmp_path / name).rglob("*") if file.is_file())
             for name in ("old", "new")]  # fmt: skip
    assert files[0] == files[1]
    for file in files[0]:
        if not file.name.startswith("."):
            assert (tmp_path / "old" / file).read_bytes() == (tmp_path / "new" / file).read_bytes(), file


def test_rows_of_a_study_are_chosen_by_one_option() -> None:
    moved = {"reproduce nielsen2024": plugins.load("evermap.studies", "nielsen2024").moved}
    found = options_of(reproduce.command("evermap.studies", "nielsen2024"))
    old = "reproduce nielsen2024 --dataset 6 --robot 1 --method joint --sensor ours --quick"
    new = "reproduce nielsen2024 --quick --only dataset=6 --only robot=1 --only method=joint --only sensor=ours"
    assert renew(old.split(), lambda _: found, moved)[0] == new.split()
    for wrong in ("dataset=six", "size=1", "joint"):
        assert "names no rows" in run("reproduce", "nielsen2024", "--only", wrong).stderr


NEW = {
    # evermap slam
    "slam rec --method nn": "slam rec --set slam.method=nn",
    "slam rec --sensor-model plain --set seed=3": "slam rec --set seed=3 --set slam.sensor_model=plain",
    "slam rec --method nn --method em": "slam rec --set slam.method=em",
    "slam rec --empty-ids": "slam rec --set slam.unknown_ids=empty",
    "slam rec --map m --out o": "map enter m rec --out o",
    "slam a b --map=m --prior cart=never-leaves": "map enter m a b --prior cart=never-leaves",
    "slam rec --map m --start 2026-11-29": "map enter m rec --start 2026-11-29",
    "slam rec --map m --unknown-ids": "map enter m rec --set slam.unknown_ids=true",
    "slam rec --map m --prior-map truth --prior-sigma 0.1": "map enter m rec --prior-map truth,sigma=0.1",
    "slam --localize --map m rec --realtime": "localize m rec --realtime",
    "slam --map m --localize --show-config --set seed=1": "slam --show-config --set seed=1",
    "slam rec --prior-sigma .3 --prior-map f.csv": "slam rec --prior-map f.csv,sigma=.3",
    "slam a b --together --json": "together a b --json",
    "slam --init mine": "init recording mine",
    "slam --init mine --3d": "init flight mine",
    "slam --init-bag m.mcap": "init bag m.mcap",
    "slam --map m -- -odd": "map enter -- m -odd",
    "check rec --empty-ids": "check rec --set slam.unknown_ids=empty",
    # evermap live
    "live --map m --replay rec --localize": "live m rec --localize",
    "live --map m --sensor s.toml --zenoh z": "live m --sensor s.toml --zenoh z",
    "live --replay rec --zenoh z --realtime": "play rec --zenoh z",
    # evermap persist
    "persist t.csv --recurrent auto --per all": "persist t.csv --set persist.recurrent=auto --set persist.per=all",
    "persist t.csv --model ./m.json": "persist t.csv --set persist.model=m.json",
    "persist t.csv --learn-from 500": "persist t.csv --set persist.learn_from=500",
    "persist t.csv --query grid --step-s .5": "persist t.csv --set persist.query=grid --set persist.step_s=0.5",
    "persist t.csv --horizon 3d": "persist t.csv --set persist.horizon_s=259200",
    "persist t.csv --p-miss .2 --p-false 0.1": "persist t.csv --set persist.p_miss=0.2 --set persist.p_false=0.1",
    "persist t.csv --confidence 0.8": "persist t.csv --set persist.confidence=0.8",
    "persist t.csv --figures 3": "persist t.csv --set persist.figures=3",
    "persist t.csv --cluster tcp://h:1": "persist t.csv --workers tcp://h:1",
    "persist --init t.csv": "init looks t.csv",
    # evermap track
    "track t.csv --speed a=0.2 --speed b=1": """track t.csv --set 'track.speeds_mps={"a" = 0.2, "b" = 1.0}'""",
    "track t.csv --min-score 1e-1 --gap-s 60": "track t.csv --set track.min_score=0.1 --set track.gap_s=60",
    "track t.csv --scene": "track t.csv --set output.rerun=true",
    "track t.csv --no-scene": "track t.csv --set output.rerun=false",
    "track --init t.csv": "init detections t.csv",
    # maps
    "learn m --cluster tcp://h:1": "learn m --workers tcp://h:1",
    "map reenter m --cluster tcp://h:1": "map reenter m --workers tcp://h:1",
    "map export m --out k.yaml": "map nav2 m --out k.yaml",
    "map export m --out k.yaml --cell-m 0.1 --radius-m 1": "map nav2 m --out k.yaml --cell-m 0.1 --radius-m 1",
    "map export m --out s.yaml --speed-mask --ahead 2d": "map nav2 m --out s.yaml --speed-mask --ahead 2d",
    "map export m --out o.geojson --route-graph g": "map nav2 m --out o.geojson --route-graph g",
    "map export m --out m.csv --cell-m 0.1": "map export m --out m.csv",
}
"""Old command lines and their new spelling."""
STILL = {
    "slam rec --start 2026-11-29": "and convert",
    "slam rec --realtime": "an option of evermap localize",
    "slam rec --offline-session s.zip": "evermap convert INPUT FILE.zip --format session",
    "slam rec --shift 1:1 --prior-map truth": "evermap.io.shifted",
    "map export m --out k.yaml --lifetimes l.json": "evermap map export, without --out",
}
"""Lines with hidden options that are read where they were, and what they are to be."""


@pytest.mark.parametrize("old", NEW)
def test_an_old_line_is_the_new_one(old: str) -> None:
    words, line = renew(shlex.split(old), options)
    assert shlex.join(words) == shlex.join(shlex.split(NEW[old]))
    assert line is not None
    assert line.endswith(f" now: evermap {shlex.join(words)}")
    again, left = renew(words, options)
    assert (again, left) == (words, None)  # nothing of the new line is old


@pytest.mark.parametrize("old", STILL)
def test_a_hidden_option_names_what_is_instead(old: str) -> None:
    words, line = renew(shlex.split(old), options)
    assert line is not None
    assert STILL[old] in line
    assert shlex.split(old)[-2] in words or old.endswith("--realtime")


def test_every_old_option_has_a_line_here_and_is_hidden() -> None:
    for verb, moved in MOVED.items():
        lines = [shlex.split(line.replace("=", " ", 1)) for line in [*NEW, *STILL] if line.startswith(verb)]
        assert {name for name in moved if not any(name in line for line in lines)} == set(), verb
        kept = {"--lifetimes", "--prior"}  # of export itself, and of map enter
        assert not moved.keys() & list_shown(verb) - kept, verb


def test_new_lines_are_left_as_they_are() -> None:
    for line in ("slam rec --set slam.method=nn", "live m rec", "map export m --out m.csv", "map show m", "slam -h"):
        assert renew(line.split(), options) == (line.split(), None)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("slam rec --localize", "'--localize': needs a map (try: evermap localize MAP INPUT)"),
        ("slam rec --prior never-leaves", "'--prior': is for a session of a map (try: evermap map enter MAP INPUT"),
        ("slam rec --map m --localize --prior never-leaves", "'--prior': is for a session of a map"),
        ("slam rec --map m --localize --prior-map truth", "'--prior-map': a living map cannot be combined"),
        ("slam rec --map m --method nn", "'--method': a living map finds changes by itself"),
        ("slam rec --map m --realtime", "'--realtime': a session is solved when it ends"),
        ("slam rec --prior-sigma 0.1", "'--prior-sigma': there is no prior map"),
        ("slam rec --shift 1:1", "'--shift': there is no prior map"),
        ("slam rec --map m --shift 1:1", "'--shift': there is no prior map"),
        ("slam rec --together --map m", "'--map': is for one robot at a time"),
        ("slam rec --together --realtime", "'--realtime': is for one robot at a time"),
        ("slam rec --empty-ids --unknown-ids", "'--unknown-ids': ignores the ids that --empty-ids keeps"),
        ("check rec --empty-ids --unknown-ids", "'--unknown-ids': ignores the ids that --empty-ids keeps"),
        ("slam rec --init mine", "'INPUT': is for a run"),
        ("slam --init mine --out o", "'--out': is for a run"),
        ("slam --init mine --init-bag b", "'--init-bag': is for a bag"),
        ("slam --3d", "'--3d': is for a template"),
        ("slam --init --3d", "'--init': needs a folder, not --3d"),
        ("slam --method", "'--method': requires a value"),
        ("persist t.csv --workers 2 --cluster tcp://h:1", "'--workers': are the cluster's"),
        ("persist t.csv --horizon soon", "'--horizon'"),
        ("track t.csv --speed fast", "'--speed': 'fast' is not CLASS=SPEED"),
        ("track t.csv --speed a=1 --speed a=2", "'--speed': given twice for class 'a'"),
        ("live --replay rec", "'MAP': a living map is needed"),
        ("live --replay rec --zenoh z --localize", "'--localize': needs a map"),
    ],
)
def test_mistakes_in_old_lines_are_one_line_and_2(line: str, said: str) -> None:
    result = run(*line.split())
    assert result.exit_code == 2
    assert said in result.stderr
    assert result.stderr.count("\n") == 1


def test_values_are_written_for_set() -> None:
    assert [write_text(text) for text in ("auto", "a b.json", "1", "true", " x")] == [
        "auto", "a b.json", '"1"', '"true"', '" x"',
    ]  # fmt: skip
    assert [write_number(text) for text in ("3", ".5", "1_000", "1e-3", "x")] == ["3", "0.5", "1000", "0.001", "x"]


def test_workers_are_a_number_or_an_address() -> None:
    assert workers_of(None) == (None, None)
    assert workers_of("4") == (4, None)
    assert workers_of("tcp://host:8786") == (None, "tcp://host:8786")
    for wrong in ("0", "1025", "-1", "many", "1.5"):
        with pytest.raises(ConfigError, match="is no number of processes"):
            workers_of(wrong)


def test_passwords_are_not_shown() -> None:
    _, line = renew(["slam", "rec", "--map", "postgresql://me:secret@host/fleet/hall"], options)
    assert line is not None
    assert "secret" not in line
    assert "postgresql://me:***@host/fleet/hall" in line


# What both lines write, with OUT for their folders: without stamps, times and the command line itself.


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, a map of it, and tables."""
    home = tmp_path_factory.mktemp("home")
    for kind, name in (("recording", "rec"), ("looks", "looks.csv"), ("detections", "seen.csv")):
        assert run("init", kind, home / name).exit_code == 0
    assert run("map", "enter", home / "site.evermap", home / "rec", "--out", home / "run", *QUICK).exit_code == 0
    return home


VOLATILE = ("command", "created_at", "timing", "versions", "outputs")


def content(file: Path) -> Any:
    """What a run of another hour would write again."""
    if file.name == "summary.json":
        return {key: value for key, value in json.loads(file.read_text()).items() if key not in VOLATILE}
    return (
        file.name
        if file.name == ".evermap-run.json" or file.suffix in (".html", ".evermap", ".pdf", ".svg")
        else file.read_bytes()
    )


@pytest.mark.parametrize(
    "old",
    [
        "slam H/rec --out OUT --sensor-model plain --method nohyp --empty-ids",
        pytest.param(
            "slam H/rec --out OUT --prior-map truth --prior-sigma 0.5 --shift 1:0.3 --start 2026-11-29T09:30Z",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "slam H/rec --map OUT/new.evermap --out OUT/run --prior exponential:half-life=2d --start 2026-11-29T09:30Z",
            marks=pytest.mark.slow,
        ),
        "slam H/rec --map H/site.evermap --localize --out OUT",
        pytest.param("slam H/rec H/rec --together --out OUT", marks=pytest.mark.slow),
        pytest.param("slam H/rec --out OUT/run --offline-session OUT/rec.zip", marks=pytest.mark.slow),
        "slam --init OUT/new",
        "slam --init OUT/new --3d",
        "persist H/looks.csv --out OUT --figures 0 --query grid --step-s 300 --confidence 0.8 --horizon 2h --p-miss .2",
        pytest.param(
            "persist H/looks.csv --out OUT --recurrent two-state --per all --learn-from 900 --figures 1",
            marks=pytest.mark.slow,
        ),
        "persist --init OUT/looks.csv",
        "track H/seen.csv --out OUT --range-m 12 --gap-s 100 --speed cart=0.4 --no-scene",
        "track --init OUT/seen.csv",
        "map export H/site.evermap --out OUT/k.yaml --cell-m 0.2 --radius-m 0.4 --p-least 0.1",
        "map export H/site.evermap --out OUT/s.yaml --speed-mask --ahead 3d --lifetimes OUT/l.json",
        "map export H/site.evermap --out OUT/m.csv --cell-m 0.2",
    ],
)
def test_the_old_line_writes_what_the_new_one_writes(home: Path, tmp_path: Path, old: str) -> None:
    old = old.replace("H/", f"{home}/") + (" " + shlex.join(QUICK) if old.startswith("slam H") else "")
    new = ""
    for name in ("old", "new"):
        out = tmp_path / name
        out.mkdir()
        result = run(*shlex.split((old if name == "old" else new).replace("OUT", str(out))), *(["--force"] * (
            " OUT " in f"{old} ")))  # fmt: skip
        assert result.exit_code == 0, result.stderr
        if name == "old":
            last = result.stderr.splitlines()[-1]
            assert last.startswith("evermap: --")
            told = last.partition(" now: evermap ")[2].partition("; --")[0].replace(" --force", "")
            new = told.replace(str(out), "OUT") if renew(shlex.split(old), options)[0] != shlex.split(old) else old
    files = [sorted(file.relative_to(tmp_path / name) for file in (tmp_path / name).rglob("*") if file.is_file())
             for name in ("old", "new")]  # fmt: skip
    assert files[0] == files[1] != []
    for file in files[0]:
        one, other = (content(tmp_path / name / file) for name in ("old", "new"))
        assert one == other, file


def test_the_line_is_the_last_one_and_not_in_json(home: Path, tmp_path: Path) -> None:
    result = run("slam", home / "rec", "--out", tmp_path / "out", "--method", "nohyp", "--json", *QUICK)
    assert json.loads(result.stdout)["config"]["slam"]["method"] == "nohyp"
    words = ["slam", home / "rec", "--out", tmp_path / "out", "--json", *QUICK, "--set", "slam.method=nohyp"]
    assert result.stderr.splitlines()[-1] == f"evermap: --method is now: evermap {shlex.join(map(str, words))}"


def test_a_run_that_is_not_to_be_trusted_names_it_too(home: Path, tmp_path: Path) -> None:
    """Exit code 3 as before."""
    other = tmp_path / "other.csv"
    other.write_text("id,x,y\n7001,0,0\n7002,1,0\n")
    given = ("slam", home / "rec", "--out", tmp_path / "out", "--prior-map", other, *QUICK)
    new, old = run(*given), run(*given, "--force", "--prior-sigma", "0.1")
    assert (new.exit_code, old.exit_code) == (3, 3)
    assert " is now: " not in new.stderr
    assert old.stderr.splitlines()[-1].startswith("evermap: --prior-sigma is now: evermap slam ")
