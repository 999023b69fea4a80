"""Limits of the library's house: size, modules without circles, short functions, docstrings that begin with a verb."""

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


MOST_MODULES = 277
MOST_LINES = 76_114
LONGEST_FUNCTION = 60
"""Lines; kernels may be longer."""
MOST_ARGUMENTS = 8
"""Of all functions but kernels; verbs of the command line have one argument per option."""
COMPILED = {"kernel", "parallel_kernel", "inlined", "kept", "njit"}

VERBS = frozenset(
    """
    accept adapt add adjust advance align announce answer append apply ask assemble assign associate attach average
    be begin bin blend bound bring build calibrate call cancel carry centre change check choose clean clear climb
    clip close collect colour combine compare compile complete compose compress compute condition confirm connect
    convert copy correct count cover create cross cut decide declare decode decorate define delete derive descend
    describe differ discard discount divide draw drive drop eliminate emit encode end enter entry erase estimate
    evaluate evict exclude expand explain export express extend fill filter find finish fit fix fold follow forecast
    forget format formulate gather generate get give go group guard hand hash hold identify import impute index
    initialise initiate insert install integrate interpolate intersect invalidate invert iterate join judge keep
    label lay learn leave let limit linearise link list load localise locate look lower make map march marginalise
    mark mask match measure meet merge migrate mix move multiply name normalise note number observe offer open order
    overlay overwrite pack pad parse pass patrol permute pick pin place plan plot point predict prefix prepare print
    probe process profile project propagate propose prune publish pull push put quantise raise rank re-enter read
    recompute record recover reduce refine refit refuse register regroup regularise reject relabel relinearise
    remember remove rename render renew repair repeat replace replay report represent reproduce request require
    resample reset resize resolve restart restore restrict resume return revert revise rotate round run salvage
    sample save say scale scatter score search see select send separate serialise serve set settle shape shift show
    shrink shuffle sign simulate skip sleep smooth solve sort split spread stack start state stay step stop store
    stretch strip sum summarise support suppress swap switch take tell test tie time trace track train transform
    translate triangulate trim truncate try turn undo unite unpack unpin update use validate verify visit wait walk
    warm warn wash watch weigh whiten widen wrap write yield
    approve bridge broadcast commit correlate feed lease queue work
    """.split()  # noqa: SIM905
)
"""First words of docstrings, in the imperative. Add a verb where it is missing."""


SETTLED = (
    "live", "maps.sessions", "runs.persist", "sensing", "slam.association", "slam.changes", "slam.space", "tracking",
)  # fmt: skip
"""Packages whose beliefs and thresholds are keys of the configuration: see docs/architecture.md."""
SETTLED_MODULES = ("calibration", "known_places", "localize", "problem", "streaming", "votes")
BELIEF = re.compile(
    r"_(M|M2|S|RAD|HZ|MPS|PX|NATS|P|ODDS)$|^_?(P|SIGMA|FEWEST|LEAST|GATE|CONFIDENCE|MIN|SEEN|SURE|NEAR|FAR)(_|$)"
)
"""Names by which constants state a probability, a distance, a time, evidence, a gate or a count of sightings."""
OF_THE_CODE = frozenset(
    """
    live.inbox.BURST_S live.judge.REST_S live.ros.GUESS_S live.ros.TOLD_S live.ros.SEEN_P live.ros.WAIT_S
    maps.sessions.box_search.GATE maps.sessions.box_search.TESTED_M2 maps.sessions.boxes.LEAST_P
    maps.sessions.nameless.HELD_NATS maps.sessions.nameless.GATE
    maps.sessions.placing.SMALLEST_P maps.sessions.believe.WITNESSED_NATS maps.sessions.believe.LEAST_P
    maps.sessions.believe.MOST_P runs.persist.changes._SHORTEST_GAP_S sensing.kernels.FAR_OUT
    slam.association.associator.LEAST_LEFT slam.association.associator.SAME_NATS slam.association.consensus.IMPLIED_M2
    slam.association.consensus.LEAST_M2 slam.association.in_space.FAR_M
    slam.association.particles.FEWEST_PARTICLES slam.association.particles.GATE
    slam.association.wrong_associations.LEAST_M2
    slam.association.wrong_associations.LEAST_SHARE slam.calibration.LEAST_SIGMA slam.changes.explain.HELD_M
    slam.changes.search.NEAR slam.known_places.LEAST_VARIANCE slam.known_places.RETRY_S slam.known_places.SIGMA_M
    slam.problem.FEWEST_ROWS slam.space.against_map.LEAST_INFORMATION slam.space.drift.FEWEST
    slam.space.drift.FEWEST_BINS slam.space.drift.FEWEST_OF_BOTH slam.space.drift.FEWEST_PAIRS
    slam.space.drift.LEAST_OF_SQUARE slam.space.drift.PERSIST_S slam.space.drift.SEEN_TOGETHER
    slam.space.problem.LEAST_WEIGHT slam.space.problem.NO_JUMP_LOG_ODDS slam.space.solve.GROSS_M
    slam.space.solve.SLACK_M slam.space.solve.SLACK_RAD slam.space.solve.STILL_M slam.space.solve.STILL_RAD
    slam.space.starts.FEWEST_LOST slam.space.starts.LOST_M slam.space.starts.NEAR_S slam.space.starts.SLACK_M
    slam.streaming.NEAR slam.streaming.NEAR_NOISE slam.streaming.NEAR_NOISE_GAIN slam.votes.FEWEST_PAIRS
    slam.votes.LEAST_SHARE tracking.frame._NEAR_S tracking.grid.FAR tracking.life.LEAST tracking.standing.STRIDE_S
    """.split()  # noqa: SIM905
)
"""Of these names, those that are tolerances, limits of an iteration, first values or the pace of messages."""
MOST_NUMBERS = 296
"""Numeric constants in those packages."""

BACKWARDS = {("evermap.maps.living", "evermap.maps.sessions.believe")}
"""Imports inside a function against the order of modules: a map that is asked for another time asks its beliefs."""


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for name in MODULES:
        for node in ast.walk(tree_of(name)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield name, node


def decorators(function: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    called = (node.func if isinstance(node, ast.Call) else node for node in function.decorator_list)
    return {node.attr if isinstance(node, ast.Attribute) else node.id for node in called if hasattr(node, "id")} | {
        node.attr for node in function.decorator_list if isinstance(node, ast.Attribute)
    }


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


def test_the_library_stays_small() -> None:
    assert len(MODULES) <= MOST_MODULES
    assert sum(len(path.read_text(encoding="utf-8").splitlines()) for path in MODULES.values()) <= MOST_LINES


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


def test_functions_are_short() -> None:
    long = {
        f"{name}.{node.name}": node.end_lineno - node.lineno + 1
        for name, node in functions()
        if node.end_lineno - node.lineno >= LONGEST_FUNCTION and not decorators(node) & COMPILED
    }
    assert not long


def test_functions_have_few_arguments() -> None:
    many = {}
    for name, node in functions():
        count = len([*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs])
        count -= bool(node.args.args) and node.args.args[0].arg in {"self", "cls"}
        if count > MOST_ARGUMENTS and not decorators(node) & COMPILED and not name.startswith("evermap.cli."):
            many[f"{name}.{node.name}"] = count
    assert not many


def test_public_docstrings_begin_with_a_verb() -> None:
    other = []
    for name, node in functions():
        text = ast.get_docstring(node)
        if node.name.startswith("_") or not text or decorators(node) & {"property", "cached_property"}:
            continue
        first = text.split()[0].strip(".,:;").lower()
        if first not in VERBS:
            other.append(f"{name}.{node.name}: {text.splitlines()[0]}")
    assert not other


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
    found = dict(numbers())
    stated = {name for name in found if BELIEF.search(name.rpartition(".")[2])}
    assert stated == OF_THE_CODE
    assert [name for name, told in found.items() if not told] == []
    assert len(found) <= MOST_NUMBERS
