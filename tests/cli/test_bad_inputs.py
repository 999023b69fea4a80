"""What users get wrong, as a table: command, what was done to its input, exit code, and what is told."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.io import write_template

Files = dict[str, str]
Spoil = Callable[[Files], None]


class Case(NamedTuple):
    """One row of the table."""

    command: str
    name: str
    spoil: Spoil
    code: int
    words: str


def column(file: str, name: str, change: Callable[[str], str], row: int | range | None = None) -> Spoil:
    """Change a column of a table, in every row, in one or in some of them."""

    def apply(files: Files) -> None:
        lines = files[file].splitlines()
        head = next(number for number, line in enumerate(lines) if not line.startswith("#"))
        place = lines[head].split(",").index(name)
        chosen = [row] if isinstance(row, int) else range(len(lines)) if row is None else row
        for number in [head + 1 + one for one in chosen if head + 1 + one < len(lines)]:
            cells = lines[number].split(",")
            cells[place] = change(cells[place])
            lines[number] = ",".join(cells)
        files[file] = "\n".join(lines) + "\n"

    return apply


def header(file: str, old: str, new: str) -> Spoil:
    """Rename a column."""

    def apply(files: Files) -> None:
        lines = files[file].splitlines()
        head = next(number for number, line in enumerate(lines) if not line.startswith("#"))
        lines[head] = ",".join(new if cell == old else cell for cell in lines[head].split(","))
        files[file] = "\n".join(lines) + "\n"

    return apply


def text(file: str, content: str) -> Spoil:
    return lambda files: files.update({file: content})


def missing(file: str) -> Spoil:
    def apply(files: Files) -> None:
        del files[file]

    return apply


def toml(section: str, line: str) -> Spoil:
    """A line of `sensor.toml` in place of the one with the same key."""

    def apply(files: Files) -> None:
        key = line.partition("=")[0].strip()
        kept = [old for old in files["sensor.toml"].splitlines() if old.partition("=")[0].strip() != key]
        kept.insert(kept.index(next(old for old in kept if old.startswith(f"[{section}]"))) + 1, line)
        files["sensor.toml"] = "\n".join(kept) + "\n"

    return apply


def scaled(factor: float) -> Callable[[str], str]:
    return lambda cell: repr(float(cell) * factor)


def shifted(by: float) -> Callable[[str], str]:
    return lambda cell: repr(float(cell) + by)


# every numeric column
NUMBERS = (
    ("odometry.csv", "stamp_s"),
    ("odometry.csv", "forward_mps"),
    ("odometry.csv", "angular_radps"),
    ("detections.csv", "stamp_s"),
    ("detections.csv", "range_m"),
    ("detections.csv", "bearing_rad"),
    ("frames.csv", "stamp_s"),
    ("truth.csv", "stamp_s"),
    ("truth.csv", "x_m"),
    ("truth.csv", "y_m"),
    ("truth.csv", "theta_rad"),
    ("landmarks.csv", "x_m"),
    ("landmarks.csv", "y_m"),
)
NOT_NUMBERS = {
    "a word": ("far", "'far' is not a number"),
    "nothing": ("", "is empty"),
    "nan": ("nan", "nan where a finite number is needed"),
    "infinity": ("inf", "inf where a finite number is needed"),
    "minus infinity": ("-inf", "-inf where a finite number is needed"),
    "two points": ("1.2.3", "'1.2.3' is not a number"),
    "a unit": ("3 m", "'3 m' is not a number"),
    "huge": ("1e300", r"1e\+300 is outside"),
    "grouped digits": ("1_0", "'1_0' is not a number"),
    "hexadecimal": ("0x10", "'0x10' is not a number"),
}
MANY = range(2, 60)
"""Rows, more than the few bad ones that are left out."""
TABLES = ("odometry.csv", "detections.csv", "frames.csv", "truth.csv", "landmarks.csv")


def of_files() -> Iterator[Case]:
    """Mistakes in single cells, lines and files of a recording: refused with file, line and field."""
    for file, name in NUMBERS:
        for what, (cell, words) in NOT_NUMBERS.items():
            if name == "bearing_rad" and what in ("nothing", "nan"):  # only the range is known
                continue
            if what == "nothing" and file == "frames.csv":
                continue  # its only column: an empty line, which is skipped
            yield Case(
                "check",
                f"{file} {name} {what}",
                column(file, name, lambda _, new=cell: new, row=MANY),
                2,
                rf"{file}:\d+: field '{name}': {words}",
            )
            if file in ("odometry.csv", "detections.csv"):
                one = column(file, name, lambda _, new=cell: new, row=2)
                yield Case("check", f"{file} {name} once {what}", one, 0, f"1 of .* rows left out: {name}: {words}")
        yield Case("check", f"{file} without {name}", header(file, name, "whatever"), 2, f"{file}:.*column")
        yield Case("check", f"{file} {name} twice", header(file, name, name + "," + name), 2, f"{file}:.*(twice|cells)")
    for file in TABLES:
        yield Case("check", f"{file} empty", text(file, ""), 2, f"{file}: is empty")
        yield Case("check", f"{file} with NUL", text(file, "stamp_s\n\0\n"), 2, "is not plain text")
        yield Case("check", f"{file} of another kind", text(file, "1,2,3\n4,5,6\n"), 2, "must name the columns")
        yield Case("check", f"{file} with semicolons", text(file, "stamp_s;x\n1;2\n"), 2, "separated by commas")
        yield Case("check", f"{file} with a lone quote", text(file, 'stamp_s,x\n"1,2\n3,4\n'), 2, "quotation marks")
    for file in ("odometry.csv", "detections.csv", "frames.csv", "truth.csv"):
        yield Case(
            "check",
            f"{file} back in time",
            column(file, "stamp_s", lambda cell: repr(-float(cell)), row=MANY),
            2,
            rf"{file}:\d+: field 'stamp_s': time runs backwards",
        )
        yield Case("check", f"{file} in milliseconds", column(file, "stamp_s", shifted(1.7e12)), 2, "not in milli")
        yield Case("check", f"{file} in nanoseconds", column(file, "stamp_s", shifted(1.7e18)), 2, "not in milli")
        yield Case(
            "check",
            f"{file} half of dates",
            column(file, "stamp_s", lambda _: "2026-03-01T12:00Z", row=MANY),
            2,
            f"{file}:.*not a number",
        )
    for file in ("odometry.csv", "detections.csv"):
        yield Case("check", f"no {file}", missing(file), 2, f"{file}: file is missing")
    yield Case(
        "check", "no row of odometry", text("odometry.csv", "stamp_s,forward_mps,angular_radps\n"), 2, "no odometry"
    )
    yield Case(
        "check",
        "one row of odometry",
        text("odometry.csv", "stamp_s,forward_mps,angular_radps\n0,1,0\n"),
        2,
        "at least two rows",
    )
    yield Case(
        "check", "nothing seen", text("detections.csv", "stamp_s,landmark_id,range_m,bearing_rad\n"), 2, "no landmark"
    )
    yield Case("check", "another clock", column("odometry.csv", "stamp_s", shifted(1e6)), 2, "do not overlap in time")
    for what, cell, words in (
        ("a fraction", "1.5", "not a whole number"),
        ("negative", "-7", "outside"),
        ("a bell", "a\a", "cannot be printed"),
        ("beyond float", "1e30", "outside"),
    ):
        yield Case(
            "check",
            f"identity {what}",
            column("detections.csv", "landmark_id", lambda _, c=cell: c, row=1),
            2,
            rf"detections.csv:\d+: field 'landmark_id': .*{words}",
        )
    for what, cell in (("zero", "0"), ("negative", "-1")):
        yield Case(
            "check", f"range {what}", column("detections.csv", "range_m", lambda _, c=cell: c, row=MANY), 2, "no return"
        )
    yield Case(
        "check", "bearing in degrees", column("detections.csv", "bearing_rad", scaled(57.29578)), 2, "not degrees"
    )
    yield Case(
        "check", "turn rate in 1e5", column("odometry.csv", "angular_radps", scaled(1e6)), 2, "radians per second"
    )
    yield Case("check", "landmark twice", column("landmarks.csv", "landmark_id", lambda _: "1"), 2, "is listed twice")
    yield Case(
        "check", "detection of no frame", column("detections.csv", "stamp_s", shifted(0.01)), 2, "have no row in"
    )
    for key, value, words in (
        ("limits", "range_max_m = -1", "outside"),
        ("limits", "range_max_m = 0.05", "greater than range_min_m"),
        ("limits", "range_max_m = nan", "outside"),
        ("limits", 'range_max_m = "6"', "must be a number"),
        ("limits", "bearing_max_rad = 90", "angles in radians"),
        ("limits", "bearing_max_rad = -3", "greater than bearing_min"),
        ("limits", "range_maximum_m = 6", "unknown key"),
        ("noise", "sigma_range_m = 0", "outside"),
        ("noise", "sigma_range_m = -1", "outside"),
        ("noise", "sigma_bearing_rad = nan", "outside"),
        ("mount", "x_m = inf", "outside"),
        ("mount", "theta_rad = 90", "angles in radians"),
        ("mount", "z_m = 1", "unknown key"),
        ("detection", "p_detect = 1.5", "outside"),
        ("detection", "p_false = -0.1", "outside"),
        ("detection", "p_detect = true", "must be a number"),
        ("recording", 'clock = "gps"', "unknown clock"),
        ("recording", "format_version = 99", "newer evermap"),
        ("recording", 'frames_complete = "yes"', "must be a bool"),
        ("recording", "class_names = [1]", "list of names"),
        ("recording", 'class_names = ["a", "a"]', "appears twice"),
        ("recording", 'class_names = ["chair"]', "class names"),
        ("recording", "name = 7", "must be a str"),
        ("recording", "name = ", "TOML"),
    ):
        yield Case("check", f"sensor.toml {value}", toml(key, value), 2, words)


def of_units() -> Iterator[Case]:
    """Valid numbers that mean something else: `check` and `slam` name them, and exit with 3."""
    ranges, bearings = ("detections.csv", "range_m"), ("detections.csv", "bearing_rad")
    speeds, turns = ("odometry.csv", "forward_mps"), ("odometry.csv", "angular_radps")
    for what, (file, name), factor, words in (
        ("mm", ranges, 1e3, "ranges seem to be in millimetres"),
        ("cm", ranges, 1e2, "ranges seem to be in centimetres"),
        ("feet", ranges, 3.28084, "ranges seem to be in feet"),
        ("inches", ranges, 39.3701, "ranges seem to be in inches"),
        ("half a mistake", ranges, 7.0, "[67][.0-9]* times too long"),
        ("flipped bearings", bearings, -1.0, "wrong sign"),
        ("km/h", speeds, 3.6, "speeds seem to be in km/h"),
        ("mm/s", speeds, 1e3 - 1, "millimetres per second"),
        ("cm/s", speeds, 1e2, "centimetres per second"),
        ("mph", speeds, 2.23694, "miles an hour"),
        ("flipped speeds", speeds, -1.0, "drive in the opposite direction"),
        ("deg/s", turns, 57.29578, "turn rates seem to be in deg"),
        ("flipped turns", turns, -1.0, "wrong sign"),
    ):
        for command in ("check", "slam"):
            yield Case(command, what, column(file, name, scaled(factor)), 3, words)
    for what, by in (("left", -1.5708), ("right", 1.5708)):
        yield Case("check", f"bearings from the {what}", column(*bearings, shifted(by)), 3, "from another axis")
    own = iter(range(10_000))
    own_ids = column("detections.csv", "landmark_id", lambda _: str(next(own)))
    for command in ("check", "slam"):
        yield Case(command, "every detection its own id", own_ids, 2, "must identify the landmark")
    stopped, straight = column(*speeds, lambda _: "0"), column(*turns, lambda _: "0")
    yield Case("check", "zero odometry", both(stopped, straight), 3, "zero throughout")
    yield Case("check", "turn rates of zero", straight, 3, "seem")
    yield Case("check", "beyond the limits", toml("limits", "range_max_m = 3.0"), 0, r"\d+ of \d+ ranges lie beyond")
    yield Case("check", "out of view", toml("limits", "bearing_max_rad = 0.5"), 0, r"\d+ of \d+ bearings lie outside")
    yield Case(
        "check",
        "a text as identity",
        column("detections.csv", "landmark_id", lambda c: f"tag:{c}"),
        0,
        "no problems found",
    )
    yield Case("check", "nothing", lambda _: None, 0, "no problems found")


def both(*spoils: Spoil) -> Spoil:
    def apply(files: Files) -> None:
        for spoil in spoils:
            spoil(files)

    return apply


LOOKS = "stamp_s,feature_id,detected,p_miss,p_false,class_id\n" + "".join(
    f"{stamp},{name},{int(stamp != 30)},0.1,0.05,cart\n" for stamp in range(0, 60, 10) for name in "ab"
)


def of_looks() -> Iterator[Case]:
    """Tables of looks for `evermap persist`."""
    file = "looks.csv"
    for name in ("stamp_s", "p_miss", "p_false"):
        for what, (cell, words) in NOT_NUMBERS.items():
            if (what == "nothing" and name != "stamp_s") or (what == "nan" and name != "stamp_s"):
                continue
            yield Case(
                "persist",
                f"{name} {what}",
                column(file, name, lambda _, new=cell: new, row=2),
                2,
                rf"looks.csv:4: field '{name}': {words}",
            )
        yield Case("persist", f"{name} renamed", header(file, name, name + "x"), 2, "looks.csv:1: field .* column")
    for rates in (("0.6", "0.6"), ("0.5", "0.5"), ("1", "0"), ("0", "1"), ("0.9", "0.2"), ("0.99", "0.99")):
        spoil = both(column(file, "p_miss", lambda _, p=rates[0]: p), column(file, "p_false", lambda _, p=rates[1]: p))
        yield Case("persist", f"inverted {rates}", spoil, 2, "looks.csv:2: field 'p_miss': .* make 1 or more")
        yield Case(
            f"persist --set p_miss={rates[0]} --set p_false={rates[1]}",
            f"inverted by option {rates}",
            lambda _: None,
            2,
            "field 'p_miss': .* make 1 or more",
        )
    for cell in ("2", "yes", "-1", "0.5", "x"):
        yield Case(
            "persist", f"detected {cell}", column(file, "detected", lambda _, c=cell: c, row=1), 2, "neither 1 nor 0"
        )
    yield Case("persist", "nobody looked", column(file, "detected", lambda _: ""), 2, "no row is a look")
    yield Case(
        "persist",
        "no name",
        column(file, "feature_id", lambda _: "", row=3),
        2,
        "looks.csv:5: field 'feature_id': is empty",
    )
    yield Case("persist", "a bell", column(file, "feature_id", lambda _: "\a", row=3), 2, "cannot be printed")
    yield Case(
        "persist",
        "two classes",
        column(file, "class_id", lambda _: "wall", row=3),
        2,
        "is 'wall' here and 'cart' above",
    )
    yield Case("persist", "no rows", text(file, "stamp_s,feature_id,detected\n"), 2, "has no rows")
    yield Case("persist", "empty", text(file, ""), 2, "is empty")
    yield Case(
        "persist", "not even a date", column(file, "stamp_s", lambda _: "2026-02-30T00:00"), 2, "is not a number"
    )
    for option, words in (
        ("--set p_miss=2", "p_miss.*less than or equal to 1"),
        ("--set p_false=nan", "p_false.*finite"),
        ("--set confidence=0.3", "confidence.*greater than 0.5"),
        ("--set step_s=-1", "step_s.*greater than 0"),
        ("--set horizon_s=soon", "horizon_s"),
        ("--prior exponentiel:mean=1d", "expon"),
        ("--prior exponential:mean=-1d", "prior|mean"),
        ("--set query=sometimes", "query"),
        ("--set learn_from=1", "learn_from.*greater than or equal to 2"),
        ("--set recurrent=perhaps", "recurrent.*perhaps"),
        ("--set figures=-1", "figures"),
        ("--set step_s=1e-9 --set query=grid", "instants"),
        ("--model nowhere.json", "nowhere.json"),
        ("--truth nowhere.csv", "no such file"),
        ("--clock sundial", "clock"),
    ):
        yield Case(f"persist {option}", option, lambda _: None, 2, words)


def of_tracks() -> Iterator[Case]:
    """Tables of detections for `evermap track`."""
    file = "objects.csv"
    for name in ("stamp_s", "x_m", "y_m", "z_m", "score", "sigma_m"):
        for what, (cell, words) in NOT_NUMBERS.items():
            if what in ("nothing", "nan") and name != "stamp_s":
                continue
            yield Case(
                "track",
                f"{name} {what}",
                column(file, name, lambda _, new=cell: new, row=1),
                2,
                rf"objects.csv:3: field '{name}': {words}",
            )
    yield Case(
        "track", "half a position", column(file, "y_m", lambda _: "", row=1), 2, "objects.csv:3: field 'y_m': is empty"
    )
    yield Case("track", "no rows", text(file, "stamp_s,x_m,y_m,z_m\n"), 2, "has no rows")
    yield Case("track", "only two axes", text(file, "stamp_s,x_m,y_m\n0,1,2\n"), 2, "'z_m': missing column")


CASES = [*of_files(), *of_units(), *of_looks(), *of_tracks()]
QUICK = ["--set", "output.figures=false", "--set", "output.report=false"]
DRAWN = ("half a mistake", "flipped turns")
"""Of the cases that `slam` solves, those whose figures and report are made, too."""
OBJECTS = "stamp_s,x_m,y_m,z_m,score,sigma_m\n" + "".join(f"{k},1,2,0,0.9,0.1\n" for k in range(5))


def is_solved_again(case: Case) -> bool:
    """Whether `slam` solves it to end as `check` does, which is asked of the same mistake; of two it is quick."""
    return case.command == "slam" and case.code == 3 and case.name not in ("mm/s", "flipped turns")


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = write_template(tmp_path_factory.mktemp("bad") / "template")
    return {file.name: file.read_text() for file in folder.iterdir()}


def test_there_are_at_least_300_rows_and_none_is_twice() -> None:
    assert len(CASES) >= 300
    assert len({(case.command, case.name) for case in CASES}) == len(CASES)


@pytest.mark.parametrize(
    "case",
    [pytest.param(one, marks=pytest.mark.slow) if is_solved_again(one) else one for one in CASES],
    ids=lambda case: f"{case.command}: {case.name}".encode("ascii", "replace").decode(),
)
def test_bad_input_ends_with_one_line(case: Case, template: Files, tmp_path: Path) -> None:
    verb, *options = case.command.split()
    files = {"persist": {"looks.csv": LOOKS}, "track": {"objects.csv": OBJECTS}}.get(verb, dict(template))
    case.spoil(files)
    folder = tmp_path / "recording"
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_text(content, newline="")
    given = {"persist": folder / "looks.csv", "track": folder / "objects.csv"}.get(verb, folder)
    arguments = [verb, str(given), *options] + ([] if verb == "check" else ["--out", str(tmp_path / "out")])
    arguments += [] if verb != "slam" or case.name in DRAWN else QUICK
    result = CliRunner().invoke(app, arguments)
    told = [line for line in result.stderr.splitlines() if line.startswith("evermap: ")]
    assert result.exit_code == case.code, result.stderr
    assert "defect" not in result.stderr
    assert re.search(case.words, "\n".join(told)), result.stderr
    if case.code == 2 or (case.code and verb == "check"):
        assert any(line.startswith("evermap: error: ") for line in told)
        assert not (tmp_path / "out").exists()
