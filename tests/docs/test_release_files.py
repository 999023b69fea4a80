"""What goes with a release: changelog, citation and type markers agree with the package."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import evermap

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


@pytest.mark.parametrize("package", ["src/evermap", "studies/src/evermap_studies"])
def test_a_package_says_that_it_is_typed(package: str) -> None:
    assert (REPOSITORY / package / "py.typed").is_file()
