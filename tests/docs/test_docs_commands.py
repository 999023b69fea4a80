"""What the documents tell people to type works, and what they link to is there.

Every fenced `console` block (lines that start with `$ `) and every `python` block of a page runs, in order, in one
fresh folder a page. A comment on the line above a block changes that:

    <!-- not run: why -->           the block is skipped
    <!-- needs: SOME.zip -->        runs only where that recording is on this machine; it is put into the folder
    <!-- nightly: takes 40 s -->    runs in `make test-slow` and `make test-all` only; may end with `; needs: SOME.zip`
    <!-- printed: by what -->       of a `text` block: the commands above it print its lines, '...' for any end of one

Commands with which several pages begin run once: the other pages get a copy of the folder.
"""

from __future__ import annotations

import ast
import fcntl
import hashlib
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import typer

from evermap.cli.main import app
from evermap.cli.moved import options_of, renew

from .warm_commands import warm_commands

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
SOURCES = ("src", "studies/src", "packages/evermap-score/src")
GENERATED = "reference/"
"""Pages that exist only in the site; `mkdocs build --strict` checks what leads there."""
TIMEOUT_S = 300
NUMBER = re.compile(r"([-+]?\d+(?:\.\d+)?)")
COST = {
    r"evermap (?:slam|map enter|localize|live|check|track|survival fit|persist) ": 1,
    r"evermap map enter .*\*/": 2,
    r"evermap demo": 8,
    r"unknown_ids|unknown-ids|\.zip|\.bag\.bz2": 4,
    r"\b(?:learn|run_\w+|Engine)\(": 2,
}
"""How many times a short solution what matches takes, roughly, beyond what else matches it."""


@dataclass(frozen=True)
class Block:
    """One fenced block: its language, the comment above it, and what is to run."""

    line: int
    language: str
    note: str
    text: str

    @property
    def skipped(self) -> bool:
        return self.note.startswith("not run:")

    @property
    def nightly(self) -> bool:
        return self.note.startswith("nightly:")

    @property
    def needs(self) -> str | None:
        return self.note.partition("needs:")[2].strip() or None

    @property
    def printed(self) -> bool:
        return self.note.startswith("printed:")

    def commands(self) -> list[list[str]]:
        if self.language == "python":
            return [["python", "-c", self.text]]
        lines = self.text.replace("\\\n", " ").splitlines()
        return [["bash", "-euo", "pipefail", "-c", line[2:]] for line in lines if line.startswith("$ ")]


def blocks(page: Path) -> Iterator[Block]:
    """The runnable blocks of a page."""
    lines = page.read_text(encoding="utf-8").splitlines()
    start = None
    for number, line in enumerate(lines):
        if start is None and line.startswith("```"):
            start = number
        elif start is not None and line.strip() == "```":
            language = lines[start][3:].strip()
            note = re.fullmatch(r"<!--\s*(.*?)\s*-->", lines[start - 1].strip()) if start else None
            if language in ("console", "python") or (note and note[1].startswith("printed:")):
                yield Block(start + 1, language, note[1] if note else "", "\n".join(lines[start + 1 : number]))
            start = None
    assert start is None, f"{page}:{(start or 0) + 1}: block without an end"


def environment() -> dict[str, str]:
    """As after activating the environment that runs the tests: `evermap` and `python` are those of this checkout."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    source = os.pathsep.join(
        filter(None, [*(str(REPOSITORY / each) for each in SOURCES), os.environ.get("PYTHONPATH", "")])
    )
    return {**os.environ, "PATH": path, "PYTHONPATH": source, "MPLBACKEND": "agg", "NO_COLOR": "1"}


def longest_first(pages: list[Path]) -> list[Path]:
    """By their solutions, which take most of the time; with the long ones last a process would wait."""
    text = {page: "\n".join(block.text for block in blocks(page) if runs(block)) for page in pages}
    cost = {page: sum(times * len(re.findall(what, text[page])) for what, times in COST.items()) for page in pages}
    return sorted(pages, key=lambda page: -cost[page] * (2 if page.name == "README.md" else 1))


def runs(block: Block, nightly: bool = False) -> bool:
    return not (block.skipped or block.printed or (block.nightly and not nightly))


def after(before: str, needs: str | None, command: list[str]) -> str:
    """A digest of all that was typed in a folder, to its last command."""
    return hashlib.sha256(repr((before, needs, command)).encode()).hexdigest()


def beginnings(page: Path) -> Iterator[str]:
    """The digest after each command of a page."""
    typed = ""
    for block in filter(runs, blocks(page)):
        for command in block.commands():
            typed = after(typed, block.needs, command)
            yield typed


SHARED = {typed for typed, pages in Counter(typed for page in PAGES for typed in beginnings(page)).items() if pages > 1}
"""What several pages begin with."""


@pytest.fixture(scope="session")
def together(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of all processes of the run."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture(scope="session")
def warm(together: Path) -> Iterator[dict[str, str]]:
    """The environment in which `evermap` is ready, see there; one for all processes of the run."""
    with warm_commands(environment(), together) as ready:
        yield ready


def type_in(command: list[str], folder: Path, typed_in: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, cwd=folder, env=typed_in, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )


def type_in_once(
    command: list[str], folder: Path, typed_in: dict[str, str], kept: Path
) -> subprocess.CompletedProcess[str]:
    """What it printed and left in the folder, from the page that was first here; if that failed, it runs again."""
    with kept.with_suffix(".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if kept.exists():
            shutil.rmtree(folder)
            shutil.copytree(kept, folder, symlinks=True)
            return subprocess.CompletedProcess(command, 0, kept.with_suffix(".txt").read_text(encoding="utf-8"), "")
        done = type_in(command, folder, typed_in)
        if done.returncode == 0:
            kept.with_suffix(".txt").write_text(done.stdout, encoding="utf-8")
            shutil.copytree(folder, kept, symlinks=True)
        return done


def type_page(page: Path, folder: Path, warm: dict[str, str], together: Path, nightly: bool = False) -> None:
    """Run what a page tells to type, and compare what it says is printed.

    The README's first commands start as a newcomer's do, all others in a process that is ready.
    """
    recordings = {path.name: path for path in (REPOSITORY.parent / "shared" / "data").rglob("*") if path.is_file()}
    typed, printed, fresh = "", None, page.name == "README.md"
    for block in blocks(page):
        where = f"{os.path.relpath(page, REPOSITORY)}:{block.line}"
        if block.printed:
            for line in block.text.splitlines() if printed is not None else ():
                assert any(is_printed(line, other) for other in printed), f"{where}: not printed: {line}"
            continue
        if not runs(block, nightly) or (block.needs is not None and block.needs not in recordings):
            printed = None
            continue
        if block.needs is not None and not (folder / block.needs).exists():
            (folder / block.needs).symlink_to(recordings[block.needs])
        printed = list[str]()
        for command in block.commands():
            typed = after(typed, block.needs, command)
            if typed in SHARED and not fresh:
                done = type_in_once(command, folder, warm, together / typed)
            else:
                done = type_in(command, folder, environment() if fresh else warm)
            assert done.returncode == 0, f"{where}: exit {done.returncode}\n{command[-1]}\n{done.stdout}\n{done.stderr}"
            printed += done.stdout.splitlines()
        fresh = False


@pytest.mark.slow
@pytest.mark.parametrize("page", longest_first(PAGES), ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_what_a_page_tells_to_type_works(page: Path, tmp_path: Path, together: Path, warm: dict[str, str]) -> None:
    type_page(page, tmp_path, warm, together)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if any(block.nightly for block in blocks(page))],
    ids=lambda page: str(page.relative_to(REPOSITORY)),
)
def test_what_a_page_tells_to_type_works_with_what_takes_long(
    page: Path, tmp_path: Path, together: Path, warm: dict[str, str]
) -> None:
    type_page(page, tmp_path, warm, together, nightly=True)


PAGE = """
```console
$ echo always | tee always
$ printf "%s\\n" in \\
    two-lines
```
<!-- printed: by that -->
```text
always
two-...
```
<!-- nightly: takes 40 s -->
```console
$ echo nightly > nightly
```
<!-- printed: by that, nightly -->
```text
nothing
```
<!-- not run: never -->
```console
$ touch never
```
<!-- nightly: takes 40 s; needs: no-such-recording.zip -->
```console
$ touch no-such-recording
```
```python
from pathlib import Path

Path("python").touch()
```
"""


def test_what_a_page_marks_as_nightly_runs_then(tmp_path: Path) -> None:
    """And is compared with what it is to have printed; without it, nothing is to be printed."""
    page, folder = tmp_path / "page.md", tmp_path / "folder"
    page.write_text(PAGE, encoding="utf-8")
    folder.mkdir()
    type_page(page, folder, environment(), tmp_path)
    assert sorted(path.name for path in folder.iterdir()) == ["always", "python"]
    with pytest.raises(AssertionError, match="not printed: nothing"):
        type_page(page, folder, environment(), tmp_path, nightly=True)
    page.write_text(PAGE.replace("> nightly", "| tee nightly").replace("nothing", "nightly"), encoding="utf-8")
    type_page(page, folder, environment(), tmp_path, nightly=True)
    assert sorted(path.name for path in folder.iterdir()) == ["always", "nightly", "python"]
    page.write_text(PAGE.replace("two-...", "three"), encoding="utf-8")
    with pytest.raises(AssertionError, match="not printed: three"):
        type_page(page, folder, environment(), tmp_path)
    page.write_text(PAGE.replace("tee always", "tee always; false"), encoding="utf-8")
    with pytest.raises(AssertionError, match=r"page\.md:2: exit 1"):
        type_page(page, folder, environment(), tmp_path)


def test_commands_that_several_pages_begin_with_are_typed_once(tmp_path: Path) -> None:
    """What they print and leave is as if they had been typed again; one that failed is typed again."""
    count, kept = tmp_path / "count", tmp_path / "kept"
    for name, code in (("first", 1), ("second", 0), ("third", 0)):
        folder = tmp_path / name
        (folder / "of another command").mkdir(parents=True)
        command = ["bash", "-c", f"echo . >> {count}; rmdir *; ln -s nowhere link; echo said; exit {code}"]
        done = type_in_once(command, folder, dict(os.environ), kept)
        assert (done.returncode, done.stdout) == (code, "said\n")
        assert [path.name for path in folder.iterdir()] == ["link"]
        assert (folder / "link").readlink() == Path("nowhere")
    assert count.read_text() == ".\n.\n"


def test_a_folder_is_another_after_another_command() -> None:
    """Also where the same one was typed before, or in a folder with another recording."""
    command = ["bash", "-c", "ls"]
    first = after("", None, command)
    assert (
        len({first, after(first, None, command), after("", "a.zip", command), after("", None, [*command, "-l"])}) == 4
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_names_of_the_package_in_a_page_are_exported(page: Path) -> None:
    """In a process that is ready all modules are attributes of their packages, in a reader's only what is imported."""
    import evermap

    for block in blocks(page):
        if block.language != "python" or block.skipped:
            continue
        tree = ast.parse(block.text)
        imported = [name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names]
        assert not [
            one.name
            for one in imported
            if one.name.startswith("evermap") and (one.name, one.asname) != ("evermap", "em")
        ]
        used = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)]
        assert {node.attr for node in used if node.value.id == "em"} <= set(evermap.__all__)


def is_printed(line: str, other: str) -> bool:
    """Whether a line of a page is the printed one, but for numbers that differ by a twentieth of a unit or a hundredth
    of themselves: processors round differently.
    """
    cut = line.endswith("...")
    mine, theirs = NUMBER.split(line.removesuffix("...").rstrip()), NUMBER.split(other.rstrip())
    if cut and len(theirs) >= len(mine):
        theirs = [*theirs[: len(mine) - 1], theirs[len(mine) - 1][: len(mine[-1])]]
    if mine[::2] != theirs[::2]:
        return False
    pairs = zip(map(float, mine[1::2]), map(float, theirs[1::2]), strict=True)
    return all(abs(a - b) <= max(0.05, 0.01 * abs(a)) for a, b in pairs)


def test_a_printed_line_is_the_same_but_for_rounding() -> None:
    told = "landmark 62 moved by (-18.31, +1.22) m, probability > 99 % (28 hits)"
    assert is_printed(told, told)
    assert is_printed(told, told.replace("1.22", "1.25"))
    assert is_printed("landmark 62 moved by (-18.31, +1.20) m, probability > 99 % ...", told)
    for other in (told.replace("1.22", "1.29"), told.replace("moved", "turned"), told.replace("> 99", "97"), ""):
        assert not is_printed(told, other)
        assert not is_printed("landmark 62 moved by (-18.31, +1.22) m, probability > 99 % ...", other)


def test_the_truth_in_the_readme_is_that_of_its_world() -> None:
    """Of the world that its commands simulate."""
    from evermap_studies.sim import BuildingConfig, simulate_building

    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    world = re.search(r"evermap simulate building --days (\d+) --patrol-s (\d+) --seed (\d+)", text)
    assert world is not None
    days, patrol_s, seed = map(int, world.groups())
    sessions = simulate_building(BuildingConfig(days=days, patrol_s=float(patrol_s)), seed).sessions
    first, last = (one.true_landmarks for one in (sessions[0], sessions[-1]))
    assert first is not None
    assert last is not None
    place = [dict(zip(one.landmark_id.tolist(), one.position_m, strict=True)) for one in (first, last)]
    rows = re.findall(r"^\| (\d+), (?:a|of a) (\w+) \| (.*?) \| (.*?) \| (.*?) \|$", text, re.MULTILINE)
    assert len(rows) == 3
    for name, kind, *cells in rows:
        row = first.landmark_id.tolist().index(int(name))
        assert first.class_names[first.class_id[row]] == kind
        was, now, by = ([float(number) for number in NUMBER.findall(cell)] for cell in cells)
        assert was == pytest.approx(place[0][int(name)], abs=0.005)
        if now:
            assert now == pytest.approx(place[1][int(name)], abs=0.005)
            told = re.search(rf"^landmark {name} moved by \((.*?), (.*?)\) \+- (.*?) m", text, re.MULTILINE)
            assert told is not None
            assert by[0] == pytest.approx(math.dist(was, now), abs=0.01)
            x, y, sigma = map(float, told.groups())
            assert by[1] == pytest.approx(math.hypot(x, y), abs=0.006)
            assert by[1] == pytest.approx(by[0], abs=3.0 * sigma)
        else:
            assert int(name) not in place[1]
            assert re.search(rf"^landmarks (\d+, )*{name}(, \d+)* vanished", text, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        "evermap slam missing --out out",
        "evermap slam --no-such-option",
        "evermap --version",
        "evermap map log",
        "python -c 'import sys; print(__name__, sys.argv, sys.path[0]); sys.exit(2)'",
        "python -c 'import sys; print(input, file=sys.stderr)' --version",
    ],
)
def test_a_command_that_is_ready_ends_as_the_installed_one(line: str, tmp_path: Path, warm: dict[str, str]) -> None:
    """Exit code and streams; above all, what fails does fail."""
    ends = [
        subprocess.run(["bash", "-c", f"cat | {line} | cat; exit ${{PIPESTATUS[1]}}"], cwd=tmp_path, env=env,
                       input="", capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
        for env in (environment(), warm)
    ]  # fmt: skip
    fresh, ready = ((end.returncode, end.stdout, end.stderr) for end in ends)
    assert ready == fresh
    assert ready[0] == (0 if line.endswith("--version") else 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "code", "out", "err"),
    [
        ("def f():\n    raise KeyError('missing')\nprint('said')\nf()", 1, "said\n", "KeyError: 'missing'\n"),
        ("import atexit\natexit.register(print, __name__)\nraise SystemExit('why')", 1, "__main__\n", "why\n"),
        ("print('said')\nraise SystemExit(3)", 3, "said\n", ""),
        ("raise SystemExit", 0, "", ""),
    ],
)
def test_a_program_that_is_ready_ends_as_one_that_starts(
    text: str, code: int, out: str, err: str, tmp_path: Path, warm: dict[str, str]
) -> None:
    done = type_in(["python", "-c", text], tmp_path, warm)
    assert (done.returncode, done.stdout) == (code, out)
    assert done.stderr.endswith(err)
    assert bool(done.stderr) == bool(err)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_commands_of_a_page_are_in_the_new_spelling(page: Path) -> None:
    """None is rewritten before it runs, as `evermap.cli.moved` does with old ones."""
    root = typer.main.get_command(app)

    def options(verb: str) -> Mapping[str, Any]:
        found: Any = root
        for word in verb.split():
            found = found.get_command(None, word)
        return options_of(found)

    scripts = [one[-1] for block in blocks(page) if block.language == "console" for one in block.commands()]
    lines = re.findall(r"\bevermap ([^\n|;&#<>]+)", "\n".join(scripts).replace("$(", "("))
    assert [line for line in lines if renew(shlex.split(line), options)[1] is not None] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'(?:src|href)="([^"]+)"', text)
    for target in targets:
        path, _, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target) or (path.startswith(GENERATED) and path.endswith(".md")):
            continue
        goal = page.parent / path if path else page
        assert goal.exists(), f"{page.name}: broken link {target}"
        if anchor:
            assert anchor in anchors(goal), f"{page.name}: no heading for {target}"


def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page, as MkDocs and code hosts make them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings]
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading).strip()) for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_shell_blocks_are_ones_that_run(page: Path) -> None:
    """`bash` and `sh` blocks would never be tried; commands belong into `console` blocks."""
    fences = re.findall(r"^```(\w+)", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert not {"bash", "sh", "shell", "zsh"} & set(fences)
    for block in blocks(page):
        if block.language == "console":
            assert any(line.startswith("$ ") for line in block.text.splitlines()), f"line {block.line}: no command"
