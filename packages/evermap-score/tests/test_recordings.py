"""Files of others, as they are: surveys of WPILib and TagSLAM; skipped where they are not on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from evermap_score import score
from evermap_score.changes import derive_changes
from evermap_score.importers import read_any, read_survey
from evermap_score.importers.yaml import parse_yaml
from evermap_score.matching import Rules
from evermap_score.score import make_world

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
pytestmark = [pytest.mark.data, pytest.mark.skipif(not DATA.is_dir(), reason=f"recordings are not here: {DATA}")]
LAYOUTS = DATA / "field" / "wpilib" / "format_2022_to_2026"
PAIR = f"{LAYOUTS}/2025-reefscape-welded.json,{LAYOUTS}/2025-reefscape-andymark.json@100"


def test_what_differs_between_two_editions_of_a_field() -> None:
    # known: tags 3 and 16 differ by 73 mm, 1, 2, 12 and 13 by 20 to 29, all others by a common 5
    table = read_any(PAIR)
    for same_place_m, expected in ((0.05, {"3", "16"}), (0.015, {"3", "16", "1", "2", "12", "13"})):
        world = make_world(table, {"x": table}, rules=Rules(same_place_m=same_place_m))
        assert world.rules.in_space
        changes = derive_changes(table, world)
        assert {each.landmark_id for each in changes} == expected
        assert {(each.kind, each.stamp_s) for each in changes} == {("moved", 100.0)}


def test_a_stale_map_finds_none_of_them() -> None:
    found = score(PAIR, f"{LAYOUTS}/2025-reefscape-welded.json", rules=Rules(same_place_m=0.05), draws=0)
    assert found["changes/moved/any_looks/recall"].value == 0.0
    # by Khronos' rules the nearest object of the truth is that of before, and it is gone: two of 22 are hallucinated
    # afterwards; of the two at one place only the first counts, so none is missed
    assert found["presence/f1"].value == pytest.approx((1 + 2 * 20 / (2 * 20 + 2)) / 2)
    assert found["gospa/missed"].value == found["gospa/false"].value == 0.0  # 73 mm are no miss here


def test_a_layout_in_inches_is_the_same_as_in_metres() -> None:
    folder = DATA / "field" / "wpilib" / "format_2027"
    one, other = (read_survey(folder / f"2025-reefscape-welded.{ending}") for ending in ("json", "csv"))
    assert one.landmark_id.tolist() == other.landmark_id.tolist()
    assert other.position_m == pytest.approx(one.position_m, abs=0.002)  # inches have two decimals at most


@pytest.mark.parametrize("path", sorted((DATA / "tagslam").glob("*/tagslam.yaml")), ids=lambda path: path.parent.name)
def test_the_part_of_yaml_is_read_as_by_pyyaml(path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    text = path.read_text(encoding="utf-8")

    def without_brackets(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: without_brackets(each) for key, each in value.items() if key != "ignore_tags"}
        return [without_brackets(each) for each in value] if isinstance(value, list) else value

    ours, reference = (without_brackets(read(text)) for read in (parse_yaml, yaml.safe_load))
    assert ours["bodies"]
    assert ours["bodies"] == reference["bodies"]
