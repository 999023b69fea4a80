"""Documents, and the text in code, are in plain technical English, without literal translations."""

from __future__ import annotations

import io
import re
import tokenize
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = [
    *(REPOSITORY / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((REPOSITORY / "docs").rglob("*.md")),
]
MODULES = sorted((REPOSITORY / "src" / "evermap" / "slam" / "association").glob("*.py"))
"""Their docstrings, comments and messages are tested, too."""
AVOIDED = {
    r"takes? stock": "relinearise",
    r"foretell\w*|foretold": "predict",
    r"told apart|tells? apart": "distinguish",
    r"on the mean": "on average",
    r"that are none|that is none\b": "invalid",
    r"that are no numbers|that is no number": "non-finite",
    r"whoever|somebody|nobody|who is told": "name the robot, the user or the object",
    r"stood in the way|stands in the way|stands before it": "occluded",
    r"is to be had|are to be had": "is available",
    r"by turns": "interleaved",
    r"how dear|how sure": "cost; calibration",
    r"for want of": "without",
    r"laid (?:over|on|beside) (?:the map|the rest|it|each other|one another)": "aligned with",
    r"surer": "more certain",
    r"who is who": "identity",
    r"stands? (?:elsewhere|there|nowhere|somewhere|at one of|beside)|what stands|what stood": "is at; static",
    r"(?:is|are|was|were|be) told": "reported; given",
    r"the metre of (?:the|a) (?:map|session|robot|others?)|metres? (?:is|of) the map": "scale",
    r"says? nothing": "gives no evidence",
    r"works as it is|read as they are|as it is read": "runs unchanged; read directly",
    r"what it stands": "robustness",
    r"(?:a|one) (?:row|line) a(?= [a-z]+[,:.])": "one row per",
}


AVOIDED_IN_CODE = AVOIDED | {
    r"tells?|told": "gives; distinguishes",
    r"(?:is|are|was|were|been|not) met": "seen; mapped",
    r"laid|l(?:ies|ie|ay) (?:beside|on|over)": "aligned",
    r"who|whom": "name the robot, the user or the object",
    r"looked at|looks? at": "used; compared",
    r"stands?|stood": "is at; static",
    r"surely|how sure": "certain",
    r"one expects|as one has": "expected",
    r"anew|mended|as good as none|for all that": "again; corrected",
}


def prose(page: Path) -> str:
    """A page without its blocks, generated tables and code spans, in one line."""
    text = page.read_text(encoding="utf-8")
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^\|.*$", "", text, flags=re.MULTILINE)
    return " ".join(re.sub(r"`[^`]*`", "", text).split())


def texts(module: Path) -> str:
    """Strings and comments of a module without its code spans, in one line."""
    parts = tokenize.generate_tokens(io.StringIO(module.read_text(encoding="utf-8")).readline)
    kinds = {tokenize.STRING, tokenize.COMMENT, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
    text = "\n".join(part.string for part in parts if part.type in kinds)
    return " ".join(re.sub(r"`[^`]*`", "", text).split())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_a_page_has_no_literal_translations(page: Path) -> None:
    assert not avoided(prose(page), AVOIDED)


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.name)
def test_the_text_of_a_module_has_no_literal_translations(module: Path) -> None:
    assert not avoided(texts(module), AVOIDED_IN_CODE)


def avoided(text: str, patterns: dict[str, str]) -> dict[str, str]:
    """Passages with an avoided pattern, and what to write."""
    return {
        text[max(match.start() - 30, 0) : match.end() + 30]: better
        for pattern, better in patterns.items()
        for match in re.finditer(rf"\b(?:{pattern})\b", text, re.IGNORECASE)
    }
