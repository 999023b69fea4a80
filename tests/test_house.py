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


@cache
def nodes_of(name: str) -> tuple[ast.AST, ...]:
    """All of its tree, walked once for all rules."""
    return tuple(ast.walk(tree_of(name)))


SETTLED = (
    "live", "maps.sessions", "runs.persist", "sensing", "slam.association", "slam.changes", "slam.space", "tracking",
)  # fmt: skip
"""Packages whose beliefs and thresholds are keys of the configuration: see docs/contracts.md."""
SETTLED_MODULES = ("batch", "calibration", "known_places", "localize", "problem", "streaming", "votes")
BELIEF = re.compile(
    r"_(M|M2|S|RAD|HZ|MPS|PX|NATS|P|ODDS)$|^_?(P|SIGMA|FEWEST|LEAST|GATE|CONFIDENCE|MIN|SEEN|SURE|NEAR|FAR)(_|$)"
)
"""Names by which constants state a probability, a distance, a time, evidence, a gate or a count of sightings."""
OF_THE_CODE = frozenset(
    """
    AGREE_RAD ANYWHERE_M BESIDE_RAD BURST_S CERTAIN_NATS CONTRADICTS_NATS FAR FARTHEST_M FAR_M FAR_OUT FEWEST
    FEWEST_BINS FEWEST_LOST FEWEST_NAMES FEWEST_NUMBERS FEWEST_OF_BOTH FEWEST_PAIRS FEWEST_PARTICLES FEWEST_POSES
    FEWEST_ROWS FEWEST_SIGHTINGS FLAT_M GATE GROSS_M GUESS_S HELD_M HELD_NATS IMPLIED_M2 LEAST LEAST_AGREE_M LEAST_FALL
    LEAST_INFORMATION LEAST_LEFT LEAST_RANGE_M
    LEAST_M2 LEAST_OF_SQUARE LEAST_P LEAST_SHARE LEAST_SIGMA LEAST_VARIANCE LEAST_WEIGHT LONGEST_S LOOSE_RAD LOST_M
    MOST_P NARROW_M NEAR NEAR_GAIN NEAR_NOISE NEAR_NOISE_GAIN NEAR_ROUND NEAR_S NO_JUMP_LOG_ODDS PERSIST_S REST_S
    RETRY_S SAME_M
    SAME_NATS SAME_S SEEN_P SEEN_TOGETHER SIGMA_M SIGMA_RAD SLACK_M SLACK_RAD SMALLEST_P START_M START_RAD STILL_M
    STEP_M STILL_RAD STRIDE_S TESTED_M2 TOLD_S UNKNOWN_RAD VAGUE_M VAGUE_RAD VISIT_S WAIT_S WIDE_M
    WITNESSED_NATS _NEAR_S _SHORTEST_GAP_S
    """.split()  # noqa: SIM905
)
"""Of these names, those of tolerances, limits of an iteration, first values and the pace of messages, in any module."""

BACKWARDS = {("evermap.maps.living", "evermap.maps.sessions.believe")}
"""Imports inside a function against the order of modules: a map that is asked for another time asks its beliefs."""


def imported(name: str) -> set[str]:
    """Modules of ours that a module imports anywhere, inside functions and for type checking too."""
    found: set[str] = set()
    for node in nodes_of(name):
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
        for node in nodes_of(name)
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
        assert not methods & {"graph_in_slices", "variables", "minimise_in_slices", "linearise_in_slices"}


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


ONE_OF_EACH = {
    # one damped Gauss-Newton; smoothers in space do not go through `Solver` yet, since their levels are arguments
    "minimise": {"estimate.solver", "slam.space.smoother"},
    # one rule for noise levels: in the plane, in space, and of what robots measure of each other
    "restricted_level": {"slam.noise", "slam.space.estimate", "slam.planar_together"},
    # one loop of values and levels in turns; robots together and landmarks without identities have loops of their own
    "alternate": {"slam.batch", "slam.space.estimate"},
    "refine_noise": {
        "slam.association.in_plane",
        "slam.batch",
        "slam.streaming",
        "slam.planar_together",
        "slam.warmup",
    },
    "refined": {"slam.space.estimate", "slam.space.together"},
    # one rule that accepts a session over a map, a robot over others, a frame in a map
    "accept_alignment": {
        "maps.sessions.boxes",
        "slam.batch",
        "slam.known_places",
        "slam.space.localize",
        "slam.together",
    },
    # one search for the motion that most pairs agree on
    "find_consensus": {
        "maps.sessions.placing",
        "slam.batch",
        "slam.changes.joint",
        "slam.space.moved_groups",
        "slam.space.solve",
    },
    # one order of elimination
    "build_structure": {"slam.smoother", "slam.space.smoother", "slam.together"},
    # one density of errors that last
    "lasting_errors": {"slam.base_problem"},
}
"""Functions that do what is to be done once, and the modules that may call them: fewer is better, another is a twin."""

SUBCLASSES = {
    "BaseProblem": {"slam.problem.Problem", "slam.space.problem.SpatialProblem"},
    "Associator": {"slam.association.in_plane.PlanarAssociator", "slam.association.in_space.SpatialAssociator"},
    "BaseLocalizer": {"slam.localize.Localizer", "slam.space.localize.SpatialLocalizer"},
}
"""Bases of what the plane and space have in common, and what is derived from them."""

SOLVE_BY_THEMSELVES = {
    "slam.misfit": "values of two curves under each width of their prior: no iteration",
    "slam.filter_kernels": "distance of one detection from where a filter expects it: no iteration",
    "slam.ranges": "damped Gauss-Newton of one position from ranges, from many starts at once",
    "slam.plane": "two numbers of a mount, its tilt, by reweighted least squares",
    "slam.space.starts": "Gauss-Newton of single poses from three points each, of thousands at once",
    "slam.space.drift": "two numbers of an odometry, by expectation-maximisation and reweighted",
    "slam.space.intake": "one point where rays meet, a landmark",
    "slam.space.moved_within": "the two points where rays meet before and after a cut, reweighted",
    "maps.bodies": "Gauss-Newton of one rigid motion of a body",
    "maps.sessions.gaussian": "one similarity of a session over a map",
}
"""Modules of estimators in whose loops linear equations are solved without `estimate`, and of what."""


def called(node: ast.AST) -> Iterator[str]:
    """Names of the functions and methods that are called within a node."""
    for one in ast.walk(node):
        if isinstance(one, ast.Call):
            yield one.func.attr if isinstance(one.func, ast.Attribute) else getattr(one.func, "id", "")


def test_one_solver_one_noise_learner_one_overlay() -> None:
    """What is done in one place is called from few; who is on the list is still double, or asks for the answer."""
    callers: dict[str, set[str]] = {name: set() for name in ONE_OF_EACH}
    for module in MODULES:
        for name in callers.keys() & set(called(tree_of(module))):
            callers[name].add(module.removeprefix("evermap."))
    assert {name: more for name in callers if (more := callers[name] - ONE_OF_EACH[name])} == {}
    homes = [node.name for name in MODULES for node in nodes_of(name) if isinstance(node, ast.FunctionDef)]
    assert {name: homes.count(name) for name in ONE_OF_EACH} == dict.fromkeys(ONE_OF_EACH, 1)


def test_plane_and_space_are_two_of_one_base() -> None:
    found: dict[str, set[str]] = {base: set() for base in SUBCLASSES}
    for module in MODULES:
        for node in tree_of(module).body:
            bases = node.bases if isinstance(node, ast.ClassDef) else []
            for base in (one.value if isinstance(one, ast.Subscript) else one for one in bases):
                if isinstance(base, ast.Name) and base.id in found and isinstance(node, ast.ClassDef):
                    found[base.id].add(f"{module}.{node.name}".removeprefix("evermap."))
    assert found == SUBCLASSES


def test_who_solves_by_itself_is_known() -> None:
    """Estimation of many things together is a graph; small problems of one thing are listed."""
    own = set()
    for module in MODULES:
        if not module.startswith(("evermap.slam.", "evermap.maps.", "evermap.align.", "evermap.tracking.")):
            continue
        loops = (node for node in nodes_of(module) if isinstance(node, ast.For | ast.While))
        if any(ast.unparse(one.func) == "np.linalg.solve" for loop in loops for one in ast.walk(loop)
               if isinstance(one, ast.Call)):  # fmt: skip
            own.add(module.removeprefix("evermap."))
    assert own - SOLVE_BY_THEMSELVES.keys() == set()
