"""What the documents name exists: modules, files and names in code spans."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
ROOTS = [
    REPOSITORY,
    *(REPOSITORY / root for root in ("src/evermap", "src", "studies/src", "packages/evermap-score/src", "docs")),
]
DOTTED = re.compile(r"(evermap(?:_studies|_score)?(?:\.\w+)+)(?:\(.*)?")
OTHERS = {"evermap.coordinates"}
"""Keys of files that look like modules."""
FILE = re.compile(r"(?:[\w-]+/)+[\w-]+\.(?:py|toml)")
SPANS = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")


def spans(page: Path) -> list[str]:
    """Code spans of a page outside of its blocks."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    return SPANS.findall(text)


def named_in_blocks(page: Path) -> list[str]:
    """Names of ours that the Python blocks of a page import, and those that they take from `em`."""
    text = page.read_text(encoding="utf-8")
    names = []
    for block in re.findall(r"^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("evermap"):
                names += [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "em":
                names.append(f"evermap.{node.attr}")
    return names


def exists(name: str) -> bool:
    """Say whether a dotted name is a module, or a name in one."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for part in parts[end:]:
            fields = getattr(value, "__dataclass_fields__", {})
            if not hasattr(value, part) and part not in fields:
                return False
            value = getattr(value, part, None)
        return True
    return False


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_modules_and_files_that_a_page_names_exist(page: Path) -> None:
    missing = []
    for span in spans(page):
        dotted, file = DOTTED.fullmatch(span), FILE.fullmatch(span)
        if file is not None and not span.startswith(("out/", "my-")):
            missing += [] if any((root / span).exists() for root in ROOTS) else [span]
        elif dotted is not None:
            missing += [] if exists(dotted[1]) or span in OTHERS else [span]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_what_the_examples_of_a_page_import_exists(page: Path) -> None:
    assert [name for name in named_in_blocks(page) if not exists(name)] == []


def test_the_page_on_calibration_has_every_state_with_its_prior() -> None:
    from evermap.slam.calibration import SPECS, USUAL

    page = (REPOSITORY / "docs" / "calibration.md").read_text(encoding="utf-8")
    for spec in SPECS:
        row = next(line for line in page.splitlines() if line.startswith(f"| `{spec.name}`"))
        assert f"{spec.mean:g} ± {USUAL.sigma[spec.name]:g}" in row
