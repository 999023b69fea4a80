"""Keep the pages of results: one page a study, and one page of all claims.

    python docs/gen/results.py                      write docs/results.md anew from the pages of the studies
    python docs/gen/results.py mrclam out/mrclam    put the tables and figures of a run into the page of its study first

A page of a study names its command and the commit of its tables, and holds the generated tables between
`<!-- NAME:begin -->` and `<!-- NAME:end -->`. Its tables with a column 'expected' hold its claims: what was measured
stands in the column after it, that of the first contender.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1]
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
    "persistence-speed",
    "soak",
    "scale",
)
PROVENANCE = re.compile(r"Computed by `(?P<command>[^`]+)`\. Tables of commit `(?P<commit>\w+)`, (?P<date>[\d-]+)")
HEAD = """# Results

Every number that is claimed, what was expected before it was computed, and whether it is met. Truth is used for scoring
only. Generated from the studies' pages by `docs/gen/results.py`; `evermap demo` has [more](demo.md#what-was-expected).
"""
UNKNOWN = "–"


@dataclass(frozen=True)
class Claim:
    """One number: what it is, what was expected, what was measured, and whether that is met."""

    name: str
    expected: str
    measured: str
    met: str


def page_of(study: str) -> Path:
    """Return the path of a study's page."""
    return DOCS / "results" / f"{study}.md"


def cells(line: str) -> list[str]:
    """Return the cells of a row of a table."""
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def claims(text: str) -> list[Claim]:
    """Return the claims of a page: the rows of its tables that have expectations.

    Raises:
        ValueError: the page has no such table.
    """
    found, head = [], [""]
    for line in text.splitlines():
        row = cells(line) if line.startswith("|") else []
        if not row:
            head = [""]
        elif head == [""]:
            head = row
        elif len(head) >= 3 and head[1].startswith("expected") and not row[1].startswith("---"):
            found += _claim(head, row)
    if not found:
        raise ValueError("no table with a column 'expected'")
    return [claim for claim in found if not claim.expected.startswith(UNKNOWN)] or found


def _claim(head: list[str], row: list[str]) -> list[Claim]:
    """Return the claim of a row; none where nobody had an expectation, or nobody has run it yet."""
    name, expected, measured, *rest = row
    plain = head[2:] == ["measured", "met"]
    if measured.startswith(UNKNOWN) or (expected == UNKNOWN and not plain):
        return []
    met = rest[0] if plain else "**no**" if "**no**" in measured or _above(expected, measured) else "yes"
    unit = re.sub(r"^expected\s*|[\[\]]", "", head[1])
    return [Claim(name, _with(expected, unit), _with(measured.replace("**no**", "").strip(), unit), met)]


def _above(expected: str, measured: str) -> bool:
    """Say whether a number is beyond the limit that is expected, where cells do not say it themselves."""
    limit, value = (re.search(r"-?\d+(?:\.\d+)?", text) for text in (expected, measured))
    return expected.startswith("≤") and bool(limit and value) and float(value[0]) > float(limit[0])  # type: ignore[index]


def _with(text: str, unit: str) -> str:
    return f"{text} {unit}" if unit else text


def claims_page() -> str:
    """Return the page of all claims as Markdown."""
    rows = [HEAD, "| study, tables of | number | expected | measured | met |", "| --- | --- | ---: | ---: | ---: |"]
    for study in STUDIES:
        text = page_of(study).read_text(encoding="utf-8")
        made = PROVENANCE.search(text)
        if made is None:
            raise ValueError(f"{page_of(study)}: no line 'Computed by `command`. Tables of commit `hash`, date.'")
        for index, claim in enumerate(claims(text)):
            label = "" if index else f"**[{study}](results/{study}.md)** `{made['commit']}`, {made['date']}"
            rows.append(f"| {label} | {claim.name} | {claim.expected} | {claim.measured} | {claim.met} |")
    return "\n".join(rows) + "\n"


def renew(study: str, folder: Path) -> None:
    """Put the table and the figures of a run into the page of its study, with the commit of the working tree."""
    page = page_of(study)
    text = page.read_text(encoding="utf-8")
    table = (folder / "table.md").read_text(encoding="utf-8").strip()
    begin, end = f"<!-- {study}:begin -->", f"<!-- {study}:end -->"
    before, _, rest = text.partition(begin)
    _, _, after = rest.partition(end)
    if not rest or end not in text:
        raise ValueError(f"{page}: no '{begin}' ... '{end}'")
    text = f"{before}{begin}\n{table}\n{end}{after}"
    git = ["git", "-C", str(DOCS), "show", "-s", "--format=%h %cs", "HEAD"]
    commit, date = subprocess.run(git, capture_output=True, text=True, check=True).stdout.split()
    text = PROVENANCE.sub(lambda made: f"Computed by `{made['command']}`. Tables of commit `{commit}`, {date}", text)
    page.write_text(text, encoding="utf-8")
    for image in re.findall(r"\(\.\./images/([\w.-]+)\)", text):
        names = (image, image.removeprefix(f"{study}-"))
        for source in (folder / place / name for place in (".", "figures") for name in names):
            if source.exists():
                shutil.copyfile(source, DOCS / "images" / image)
                break


def main(arguments: list[str]) -> None:
    """Renew the page of a study if one is named, and the page of claims."""
    if len(arguments) == 2:
        renew(arguments[0], Path(arguments[1]))
    elif arguments:
        raise SystemExit(__doc__)
    (DOCS / "results.md").write_text(claims_page(), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
