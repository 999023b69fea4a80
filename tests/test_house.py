"""Limits of the library's house: size, modules without circles, short functions, docstrings that begin with a verb."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "src"
MODULES = {
    ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(SOURCE.rglob("*.py"))
}
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in MODULES.items()}

MOST_MODULES = 302
MOST_LINES = 76_000
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


BACKWARDS = {("evermap.maps.living", "evermap.maps.sessions.believe")}
"""Imports inside a function against the order of modules: a map that is asked for another time asks its beliefs."""


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for name, tree in TREES.items():
        for node in ast.walk(tree):
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
    for node in ast.walk(TREES[name]):
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
