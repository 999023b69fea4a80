"""Rules of the library's house: modules without circles, one class a name, constants that say what they are."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "src"
MODULES = {
    ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(SOURCE.rglob("*.py"))
}


@cache
def tree_of(name: str) -> ast.Module:
    """Parsed when it is asked for: whoever only collects tests need not wait for 300 modules."""
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


SETTLED = (
    "live", "maps.sessions", "runs.persist", "sensing", "slam.association", "slam.changes", "slam.space", "tracking",
)  # fmt: skip
"""Packages whose beliefs and thresholds are keys of the configuration: see docs/architecture.md."""
SETTLED_MODULES = ("batch", "calibration", "known_places", "localize", "problem", "streaming", "votes")
BELIEF = re.compile(
    r"_(M|M2|S|RAD|HZ|MPS|PX|NATS|P|ODDS)$|^_?(P|SIGMA|FEWEST|LEAST|GATE|CONFIDENCE|MIN|SEEN|SURE|NEAR|FAR)(_|$)"
)
"""Names by which constants state a probability, a distance, a time, evidence, a gate or a count of sightings."""
OF_THE_CODE = frozenset(
    """
    AGREE_RAD BESIDE_RAD BURST_S CERTAIN_NATS CONTRADICTS_NATS FAR FARTHEST_M FAR_M FAR_OUT FEWEST FEWEST_BINS
    FEWEST_LOST FEWEST_NUMBERS FEWEST_OF_BOTH FEWEST_PAIRS FEWEST_PARTICLES FEWEST_POSES FEWEST_ROWS FEWEST_SIGHTINGS
    FLAT_M GATE GROSS_M GUESS_S HELD_M HELD_NATS IMPLIED_M2 LEAST LEAST_AGREE_M LEAST_FALL LEAST_INFORMATION LEAST_LEFT
    LEAST_M2 LEAST_OF_SQUARE LEAST_P LEAST_SHARE LEAST_SIGMA LEAST_VARIANCE LEAST_WEIGHT LONGEST_S LOOSE_RAD LOST_M
    MOST_P NEAR NEAR_GAIN NEAR_NOISE NEAR_NOISE_GAIN NEAR_ROUND NEAR_S NO_JUMP_LOG_ODDS PERSIST_S REST_S RETRY_S SAME_M
    SAME_NATS SAME_S SEEN_P SEEN_TOGETHER SIGMA_M SIGMA_RAD SLACK_M SLACK_RAD SMALLEST_P START_M START_RAD STILL_M
    STILL_RAD STRIDE_S TESTED_M2 TOLD_S UNKNOWN_RAD VAGUE_M VAGUE_RAD VISIT_S WAIT_S WITNESSED_NATS _NEAR_S
    _SHORTEST_GAP_S
    """.split()  # noqa: SIM905
)
"""Of these names, those of tolerances, limits of an iteration, first values and the pace of messages, in any module."""

BACKWARDS = {("evermap.maps.living", "evermap.maps.sessions.believe")}
"""Imports inside a function against the order of modules: a map that is asked for another time asks its beliefs."""


def imported(name: str) -> set[str]:
    """Modules of ours that a module imports anywhere, inside functions and for type checking too."""
    found: set[str] = set()
    for node in ast.walk(tree_of(name)):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    ours = {one for one in found & MODULES.keys() if one != name and not name.startswith(f"{one}.")}
    return {one for one in ours if (name, one) not in BACKWARDS}


def test_no_circle_of_modules() -> None:
    left = {name: imported(name) for name in MODULES}
    while left:
        free = [name for name, needs in left.items() if not needs & left.keys()]
        if not free:  # what nobody in the rest imports is in no circle, either
            needed = set().union(*left.values())
            free = [name for name in left if name not in needed]
        assert free, f"modules in circles: { {name: sorted(needs & left.keys()) for name, needs in left.items()} }"
        for name in free:
            del left[name]


def test_one_class_a_name() -> None:
    homes: dict[str, list[str]] = {}
    for name in MODULES:
        for node in tree_of(name).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(name)
    assert {noun: found for noun, found in homes.items() if len(found) > 1} == {}


def classes_from(base: str) -> dict[str, ast.ClassDef]:
    """Classes of all modules that name a base class."""
    return {
        node.name: node
        for name in MODULES
        for node in ast.walk(tree_of(name))
        if isinstance(node, ast.ClassDef) and base in {ast.unparse(by).partition("[")[0] for by in node.bases}
    }


def test_one_filter() -> None:
    """Plane and space say how detections are linearised and what a step moves; how they are used is written once."""
    assert list(classes_from("NearbyPlaces")) == ["LocalFilter"]
    own = {"drive", "ahead", "compare", "update", "bring", "hold", "meet", "sight"}
    for one in classes_from("LocalFilter").values():
        assert not own & {node.name for node in one.body if isinstance(node, ast.FunctionDef)}


def test_one_problem_of_several_robots() -> None:
    """Plane and space say what blocks and values each robot has; how they are concatenated is written once."""
    specialised = classes_from("Together")
    assert set(specialised) == {"PlanarTogether", "SpatialTogether"}
    for one in specialised.values():
        methods = {node.name for node in one.body if isinstance(node, ast.FunctionDef)}
        assert not methods & {"graph_in_slices", "variables", "minimised_in_slices", "linearised_in_slices"}


def numbers() -> Iterator[tuple[str, bool]]:
    """Numeric constants of the settled packages, and whether their definition says what they are."""
    settled = (*(f"evermap.{name}." for name in SETTLED), *(f"evermap.slam.{name}." for name in SETTLED_MODULES))
    for module in MODULES:
        if not f"{module}.".startswith(settled):
            continue
        for row, node in enumerate(tree_of(module).body):
            if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
                continue
            kinds = {type(one.value) for one in ast.walk(node.value) if isinstance(one, ast.Constant)}
            if not kinds & {int, float} or str in kinds:
                continue
            rest = (one for one in tree_of(module).body[row:] if not isinstance(one, ast.Assign | ast.AnnAssign))
            told = isinstance(after := next(rest, None), ast.Expr) and isinstance(after.value, ast.Constant)
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            for one in target.elts if isinstance(target, ast.Tuple) else [target]:
                if isinstance(one, ast.Name) and one.id.isupper():
                    yield f"{module.removeprefix('evermap.')}.{one.id}", told


def test_beliefs_and_thresholds_are_keys_of_the_configuration() -> None:
    """A new constant with such a name becomes a key, or joins the list if it is none of a belief or a threshold."""
    stated = (name for name, _ in numbers() if BELIEF.search(name.rpartition(".")[2]))
    assert [name for name in stated if name.rpartition(".")[2] not in OF_THE_CODE] == []


def test_constants_say_what_they_are() -> None:
    assert [name for name, told in numbers() if not told] == []
