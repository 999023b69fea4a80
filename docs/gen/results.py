"""Keep the pages of results: one page a study, and one page of all claims, failures and tables of figures.

    python docs/gen/results.py                      write docs/results.md anew from all pages and tests
    python docs/gen/results.py mrclam out/mrclam    put the tables and figures of a run into the page of its study first
    python docs/gen/results.py --age                print how many commits old the code of every number is
    python docs/gen/results.py --all out/results    compute all studies again, about a day; goes on where it was ended

A page of a study names its command and the commit of its tables, and holds the generated tables between
`<!-- NAME:begin -->` and `<!-- NAME:end -->`. Its tables with a column 'expected' or 'asked for' hold its claims: what
was measured stands in the column after it, that of the first contender. Rows of an older run that a run of a part does
not have stay, each with its commit. A table elsewhere in the documents that has numbers in it has a comment above it:

    <!-- measured: 1a2b3c4d, 2026-01-31 -->         its numbers were measured; commit and day that they are of
    <!-- not measured: why -->                      they are settings, or the like
"""

from __future__ import annotations

import ast
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

DOCS = Path(__file__).resolve().parents[1]
TESTS = DOCS.parent / "tests"
STUDIES = (
    "mrclam",
    "lifelong",
    "partial-views",
    "nielsen2024",
    "rosen2016",
    "bateman2020",
    "presence",
    "lifetimes",
    "tracking",
    "kitti",
    "space",
    "building",
    "robots",
    "causes",
    "persistence-speed",
    "soak",
    "scale",
)
PARTS = ("kitti-stays",)
"""Blocks of tables of pages of studies with commands of their own."""
PRINTED = ("tracking", "persistence-speed", "soak")
"""Studies whose commands print their numbers only: what they print is kept, and goes into their pages by hand."""
LONGEST = ("soak", "nielsen2024")
"""Studies that take hours; they are computed last."""
PAGE = "results.md"
PROVENANCE = re.compile(r"Computed by `(?P<command>[^`]+)`\. Tables of commit `(?P<commit>\w+)`, (?P<date>[\d-]+)")
ROWS_OF = re.compile(r"^Rows of commits? `(?P<commit>[\w+]+)`, (?P<date>[\d-]+)")
TOOK = re.compile(r"in \d+ s\b")
MEASURED = re.compile(r"^<!-- measured: (?P<commit>\w+), (?P<date>[\d-]+) -->$")
NOT_MEASURED = re.compile(r"^<!-- not measured: .+ -->$")
CLAIMED = ("expected", "asked for")
"""What the second column is headed, up to its unit, where a table has claims."""
CODE = "code"
"""Head of a column with the commit of each row."""
FIGURE = re.compile(r"^[^\w`]*\d")
"""How a cell with a number begins."""
HEAD = """# Results

Every number that is claimed, what was expected before it was computed, and whether it is met; what tests are known to
fail; and all other tables of numbers. Truth is used for scoring only. *Code* is the commit that the numbers are of.
Generated from all pages and tests by `docs/gen/results.py`, which says with `--age` how many commits ago that was;
`evermap demo` has [more](demo.md#what-was-expected), and `make results` computes all of it again.
"""
FAILURES = """
## Tests that are known to fail

| test | what is short |
| --- | --- |"""
OTHERS = """
## Tables without an expectation

On pages of studies and all others; of the latter *code* is the commit that wrote the numbers.

| page | table | rows | code |
| --- | --- | ---: | --- |"""
MOST_COLUMNS = 4
"""Of a table, named on the page of claims."""
UNKNOWN = "–"
Name = TypeVar("Name")


@dataclass(frozen=True)
class Claim:
    """One number: what it is, what was expected, what was measured, whether that is met, and of which code it is."""

    name: str
    expected: str
    measured: str
    met: str
    code: str = ""


@dataclass(frozen=True)
class Table:
    """A table of a page.

    Attributes:
        heading: nearest one above it.
        note: the line above it.
        head, rows: cells.
        code: commit and date that the line above, its section or its page names, or its rows; '' where none does.
    """

    heading: str
    note: str
    head: list[str]
    rows: list[list[str]]
    code: str

    @property
    def has_claims(self) -> bool:
        return len(self.head) >= 3 and self.head[1].startswith(CLAIMED)

    @property
    def has_figures(self) -> bool:
        """Whether it has a number in any cell but the first of a row."""
        return any(FIGURE.match(cell) for row in self.rows for cell in row[1:])


@dataclass(frozen=True)
class Failure:
    """A test that is marked to fail: where, and why."""

    test: str
    why: str


def page_of(study: str) -> Path:
    """Return the path of a study's page."""
    return DOCS / "results" / f"{study}.md"


def pages() -> list[Path]:
    """Return all pages but that of the claims: of the studies, in their order, then all others."""
    others = [path for path in sorted(DOCS.rglob("*.md")) if path != DOCS / PAGE and path.parent.name != "results"]
    return [*map(page_of, STUDIES), *others]


def cells(line: str) -> list[str]:
    """Return the cells of a row of a table."""
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def tables(text: str) -> list[Table]:
    """Return all tables of a page."""
    found: list[Table] = []
    of_page = of_section = heading = before = ""
    block: list[list[str]] = []
    is_code = False
    for line in [*text.splitlines(), ""]:
        if line.startswith("```"):
            is_code = not is_code
        if is_code:
            continue
        if line.startswith("|"):
            block.append(cells(line))
            continue
        if block:
            measured = MEASURED.match(before)
            code = _code(measured) if measured else of_section or of_page
            if block[0][-1] == CODE:
                every = (one.replace("`, ", "` ") for row in block[2:] for one in row[-1].split("; "))
                code = "; ".join(dict.fromkeys(every))
            found.append(Table(heading, before, block[0], block[2:], code))
            block = []
        if made := PROVENANCE.search(line):
            of_page = _code(made)
        if made := ROWS_OF.search(line):
            of_section = _code(made)
        if line.startswith("#"):
            heading, of_section = line.lstrip("# "), ""
        if line.strip():
            before = line.strip()
    return found


def _code(made: re.Match[str]) -> str:
    return f"`{made['commit']}` {made['date']}"


def claims(text: str) -> list[Claim]:
    """Return the claims of a page: the rows of its tables that have expectations.

    Raises:
        ValueError: the page has no such table.
    """
    found = [claim for table in tables(text) if table.has_claims for row in table.rows for claim in _claim(table, row)]
    if not found:
        raise ValueError(f"no table with a column {' or '.join(CLAIMED)}")
    return [claim for claim in found if not claim.expected.startswith(UNKNOWN)] or found


def _claim(table: Table, row: list[str]) -> list[Claim]:
    """Return the claim of a row; none where nobody had an expectation, or nobody has run it yet."""
    name, expected, measured, *rest = row
    code = table.code
    if table.head[-1] == CODE:
        *rest, code = rest
        code = code.replace("`, ", "` ")
    head = table.head[2:-1] if table.head[-1] == CODE else table.head[2:]
    plain = len(head) == 2 and head[1] == "met"
    if measured.startswith(UNKNOWN) or (expected == UNKNOWN and not plain):
        return []
    met = rest[0] if plain else "**no**" if "**no**" in measured or _above(expected, measured) else "yes"
    unit = re.sub(rf"^({'|'.join(CLAIMED)})\s*|[\[\]]", "", table.head[1])
    return [Claim(name, _with(expected, unit), _with(measured.replace("**no**", "").strip(), unit), met, code)]


def _above(expected: str, measured: str) -> bool:
    """Say whether a number is beyond the limit that is expected, where cells do not say it themselves."""
    limit, value = (re.search(r"-?\d+(?:\.\d+)?", text) for text in (expected, measured))
    return expected.startswith("≤") and bool(limit and value) and float(value[0]) > float(limit[0])  # type: ignore[index]


def _with(text: str, unit: str) -> str:
    return f"{text} {unit}" if unit else text


def failures() -> list[Failure]:
    """Return every test that is marked to fail, with the reason that it states."""
    found = []
    for path in sorted(TESTS.rglob("test_*.py")):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text if "mark.xfail(" in text else "")
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef):
                marks = _marks(tree, function)
                found += [Failure(f"{path.relative_to(TESTS.parent)}::{name}", why) for name, why in marks]
    return found


def _marks(tree: ast.Module, function: ast.FunctionDef) -> Iterator[tuple[str, str]]:
    """Yield the marks of a function and their reasons: of a function that makes a case, one of each of its calls."""
    for call in ast.walk(function):
        if not (isinstance(call, ast.Call) and ast.unparse(call.func).endswith("mark.xfail")):
            continue
        reason = next(keyword.value for keyword in call.keywords if keyword.arg == "reason")
        if isinstance(reason, ast.Name):
            reason = next(
                node.value
                for node in (*ast.walk(function), *tree.body)
                if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == ast.unparse(reason)
            )
        if isinstance(reason, ast.Constant):
            yield function.name, " ".join(str(reason.value).split())
            continue
        for made in ast.walk(tree):
            if isinstance(made, ast.Call) and ast.unparse(made.func) == function.name:
                said = {keyword.arg: ast.literal_eval(keyword.value) for keyword in made.keywords}
                case = ", ".join(ast.unparse(argument) for argument in made.args)
                yield f"{_test_around(tree, made)}[{case}]", str(_fill(reason, said))


def _fill(text: ast.expr, said: dict[str | None, str]) -> str:
    """Return a text with braces, of names that a call states."""
    assert isinstance(text, ast.JoinedStr)
    parts = (ast.unparse(part.value) if isinstance(part, ast.FormattedValue) else part for part in text.values)
    return "".join(said[part] if isinstance(part, str) else str(ast.literal_eval(part)) for part in parts)


def _test_around(tree: ast.Module, call: ast.Call) -> str:
    """Return the name of the test of which a call is a decorator."""
    return next(
        (
            node.name
            for node in tree.body
            if isinstance(node, ast.FunctionDef) and any(call in ast.walk(mark) for mark in node.decorator_list)
        ),
        "",
    )


def claims_page() -> str:
    """Return the page of all claims, failures and tables as Markdown.

    Raises:
        ValueError: a page of a study without its commit, or a table elsewhere that does not say what its numbers are.
    """
    lines = [HEAD, "| study | number | expected | measured | met | code |", "| --- | --- | ---: | ---: | ---: | --- |"]
    for study in STUDIES:
        text = page_of(study).read_text(encoding="utf-8")
        if PROVENANCE.search(text) is None:
            raise ValueError(f"{page_of(study)}: no line 'Computed by `command`. Tables of commit `hash`, date.'")
        for index, claim in enumerate(claims(text)):
            label = "" if index else f"**[{study}](results/{study}.md)**"
            row = (label, claim.name, claim.expected, claim.measured, claim.met, claim.code)
            lines.append(f"| {' | '.join(row)} |")
    lines.append(FAILURES)
    lines += [f"| `{one.test}` | {one.why.replace('|', '/')} |" for one in failures()]
    lines.append(OTHERS)
    for page, table in others():
        name = page.relative_to(DOCS).as_posix()
        named = [cell for cell in table.head if cell]
        columns = ", ".join(named[:MOST_COLUMNS]) + (", …" if len(named) > MOST_COLUMNS else "")
        lines.append(f"| [{name}]({name}) | {table.heading}: {columns} | {len(table.rows)} | {table.code} |")
    return "\n".join(lines) + "\n"


def others() -> Iterator[tuple[Path, Table]]:
    """Yield the tables with numbers that have no claims, with their pages.

    Raises:
        ValueError: one does not say what its numbers are.
    """
    for page in pages():
        for table in tables(page.read_text(encoding="utf-8")):
            if table.has_claims or not table.has_figures or NOT_MEASURED.match(table.note):
                continue
            if not table.code:
                raise ValueError(f"{page}: '{' | '.join(table.head)}': no <!-- measured: ... --> above it")
            yield page, table


def page_with(block: str) -> Path:
    """Return the page of a study that has a block of this name: its own, or that of a study that it is a part of."""
    own = page_of(block)
    return (
        own if own.is_file() else next((p for p in pages() if f"<!-- {block}:begin -->" in p.read_text("utf-8")), own)
    )


def renew(study: str, folder: Path) -> None:
    """Put the table and the figures of a run into the page of its study, with the commit of its code.

    The commit stands in the last line above the tables that names one. A run of a part replaces no figure.
    """
    page = page_with(study)
    text = page.read_text(encoding="utf-8")
    table = (folder / "table.md").read_text(encoding="utf-8").strip()
    begin, end = f"<!-- {study}:begin -->", f"<!-- {study}:end -->"
    before, _, rest = text.partition(begin)
    block, _, after = rest.partition(end)
    if not rest or end not in text:
        raise ValueError(f"{page}: no '{begin}' ... '{end}'")
    made = list(PROVENANCE.finditer(before))[-1]
    old, new = f"`{made['commit']}`, {made['date']}", _commit_of_run(folder)
    said = f"Computed by `{made['command']}`. Tables of commit {new}"
    before = f"{before[: made.start()]}{said}{before[made.end() :]}"
    together = merge_pages(block.strip(), table, old, new)
    text = f"{before}{begin}\n{together}\n{end}{after}"
    page.write_text(text, encoding="utf-8")
    for image in re.findall(r"\(\.\./images/([\w.-]+)\)", text):
        if together != table and (DOCS / "images" / image).exists():
            continue  # the run is of a part, and has less to draw
        names = (image, image.removeprefix(f"{study}-"))
        for source in (folder / place / name for place in (".", "figures") for name in names):
            if source.exists():
                shutil.copyfile(source, DOCS / "images" / image)
                break


def recompute(out: Path) -> list[str]:
    """Compute all studies one after the other and renew their pages; return the names of those that failed.

    A study that is done has a file NAME.done in `out`, and is not run again; one that was ended in between goes on from
    its own rows where it keeps some. Without `out` all begins anew.
    """
    names = [name for name in (*STUDIES, *PARTS) if name not in LONGEST]
    failed = []
    out.mkdir(parents=True, exist_ok=True)
    for name in (*names, *LONGEST):
        done = out / f"{name}.done"
        if done.exists():
            continue
        command = command_of(name, out)
        print(f"{name}: {shlex.join(command[1:])}", flush=True)
        with (out / f"{name}.txt").open("w", encoding="utf-8") as text:
            code = subprocess.run(command, stdout=text, check=False).returncode
        if code:
            failed.append(name)
            continue
        if name in PRINTED:
            print(f"{name}: compare {out / name}.txt with {page_of(name)}", flush=True)
        else:
            renew(name, out / name)
            (DOCS / PAGE).write_text(claims_page(), encoding="utf-8")
        done.touch()
    return failed


def command_of(name: str, out: Path) -> list[str]:
    """Return the command that the page of a study names, with its results in a folder of this name."""
    before = page_with(name).read_text(encoding="utf-8").partition(f"<!-- {name}:begin -->")[0]
    words = shlex.split(list(PROVENANCE.finditer(before))[-1]["command"])
    if "--out" in words:
        at = words.index("--out")
        del words[at : at + 2]
    words = words[1:] if words[0] == "python" else ["-m", *words]
    return [sys.executable, *words, *([] if name in PRINTED else ["--out", str(out / name)])]


def _commit_of_run(folder: Path) -> str:
    """Return commit and date of the code of a run, as '`1a2b3c4d`, 2026-01-31'; of the working tree if it says none."""
    with suppress(OSError, ValueError):
        if made := json.loads((folder / "summary.json").read_text(encoding="utf-8")).get("commit"):
            commit, date = made.split(", ")
            return f"`{commit}`, {date}"
    git = ["git", "-C", str(DOCS), "show", "-s", "--format=%h %cs", "HEAD"]
    commit, date = subprocess.run(git, capture_output=True, text=True, check=True).stdout.split()
    return f"`{commit}`, {date}"


def merge_pages(old: str, new: str, old_code: str, new_code: str) -> str:
    """Return the tables of a run, with sections and rows of an older one that the run does not have.

    Args:
        old: tables of the page.
        new: tables of the run.
        old_code: commit and date of the page's tables, where sections and rows do not say their own.
        new_code: those of the run.
    """
    before, now = _sections(old), _sections(new)
    parts = [
        _merge_section(before.get(heading, ""), now[heading], old_code, new_code)
        if heading in now
        else _pin(before[heading], old_code)
        for heading in _in_order(list(before), list(now))
    ]
    return "\n\n".join(part for part in parts if part)


def _sections(text: str) -> dict[str, str]:
    """Return a text cut before its headings of the third level, by heading."""
    found, heading = {"": ""}, ""
    for line in text.splitlines():
        if line.startswith("### "):
            heading = line
        found[heading] = f"{found.get(heading, '')}{line}\n"
    return {name: part.strip() for name, part in found.items()}


def _in_order(before: list[Name], now: list[Name]) -> list[Name]:
    """Return names in the order of the page, new ones behind those that they follow in the run."""
    order = list(before)
    for at, name in enumerate(now):
        if name not in order:
            order.insert(order.index(now[at - 1]) + 1 if at else 0, name)
    return order


def _code_of(section: str, otherwise: str) -> str:
    """Return commit and date that a section names."""
    named = (ROWS_OF.match(line) for line in section.splitlines())
    return next((f"`{made['commit']}`, {made['date']}" for made in named if made), otherwise)


def _pin(section: str, code: str) -> str:
    """Return a section that says of which commit it is."""
    if not section or _code_of(section, ""):
        return section
    heading, _, rest = section.partition("\n")
    return f"{heading}\n\nRows of commit {code}.\n\n{rest.strip()}"


def _merge_section(old: str, new: str, old_code: str, new_code: str) -> str:
    """Return a section of a run with what only the older section has, rows and tables, with their commits.

    Tables are the same if head and paragraph before are. A claim that the run did not measure is the older one's.
    """
    earlier = {key: body for key, body, _ in _tables_of(old, _code_of(old, old_code))}
    for key, body, block in _tables_of(new, _code_of(new, new_code)):
        was = earlier.pop(key, [])
        count = _count_distinguishing_cells(was, body)
        older, rows = ({tuple(row[:count]): row for row in one} for one in (was, body))
        claimed = key[2].startswith(CLAIMED) if len(key) > 2 else False
        lacks = [name for name in older if name not in rows or (claimed and rows[name][2].startswith(UNKNOWN))]
        names = list(rows) if claimed else _in_order(list(older), list(rows))
        taken = {name: older[name] if name in lacks else rows[name] for name in names}
        if not claimed:
            taken |= {name: _fill_from(older[name], rows[name]) for name in older if name in rows}
        if any(taken[name] is not rows.get(name) for name in names):
            head, rule = block.splitlines()[:2]
            lines = [f"{head} {CODE} |", f"{rule} --- |", *(f"| {' | '.join(row)} |" for row in taken.values())]
            new = new.replace(block, "\n".join(lines))
    if new.startswith("#"):
        for (paragraph, *head), body in earlier.items():
            rule = ["---", *["---:"] * (len(head) - 1), "---"]
            lines = [f"| {' | '.join(row)} |" for row in ([*head, CODE], rule, *body)]
            new = "\n\n".join(part for part in (new, paragraph, "\n".join(lines)) if part)
    return new


def _fill_from(older: list[str], row: list[str]) -> list[str]:
    """Return a row with the cells of an older one where only that has a number, of both commits then."""
    taken = [was if now.startswith(UNKNOWN) else now for was, now in zip(older[:-1], row[:-1], strict=True)]
    return row if taken == row[:-1] else [*taken, "; ".join(dict.fromkeys([older[-1], row[-1]]))]


def _count_distinguishing_cells(*bodies: list[list[str]]) -> int:
    """Return how many of the first cells distinguish the rows of each table."""
    most = max(len(row) for body in bodies for row in body)
    for count in range(1, most):
        if all(len({tuple(row[:count]) for row in body}) == len(body) for body in bodies):
            return count
    return most


def _tables_of(section: str, code: str) -> Iterator[tuple[tuple[str, ...], list[list[str]], str]]:
    """Yield the tables of a section.

    Each as what distinguishes it from the others (the paragraph before but for how long it took, unless it names
    commits, and the head), its rows with their commits, and its text.
    """
    blocks = [block for block in section.split("\n\n") if block.strip()]
    for before, block in zip(["", *blocks], blocks, strict=False):
        if not block.startswith("|"):
            continue
        head, _, *body = [cells(line) for line in block.splitlines()]
        own = head[-1] == CODE
        rows = [row if own else [*row, code] for row in body]
        paragraph = "" if before.startswith(("#", "|")) or ROWS_OF.match(before) else TOOK.sub("in … s", before)
        yield (paragraph, *(head[:-1] if own else head)), rows, block


def ages() -> Iterator[str]:
    """Yield a line for each commit that numbers are of: how many commits ago it was, and on which pages they are."""
    where = dict[str, set[str]]()
    for page in pages():
        for table in tables(page.read_text(encoding="utf-8")):
            for code in table.code.split("; ") if table.has_claims or table.has_figures else []:
                if code:
                    where.setdefault(code.replace("`", ""), set()).add(page.stem)
    for code, names in where.items():
        git = ["git", "-C", str(DOCS), "rev-list", "--count", f"{code.split()[0].rstrip('+')}..HEAD"]
        count = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip() or "?"
        yield f"{count:>6} commits ago ({code}): {', '.join(sorted(names))}"


def main(arguments: list[str]) -> None:
    """Renew the page of a study if one is named, and the page of claims."""
    if arguments == ["--age"]:
        print(*sorted(ages()), sep="\n")
        return
    if len(arguments) == 2 and arguments[0] == "--all":
        if failed := recompute(Path(arguments[1])):
            raise SystemExit(f"failed: {', '.join(failed)}; what is missing is run again by the same command")
        return
    if len(arguments) == 2:
        renew(arguments[0], Path(arguments[1]))
    elif arguments:
        raise SystemExit(__doc__)
    (DOCS / PAGE).write_text(claims_page(), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
