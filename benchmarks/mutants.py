"""Do the tests notice when the code is broken? One small change at a time, sampled, and the tests that run through it.

A mutant changes one operator, comparison, number, condition or call of one function. The quick tests of a part are run
once, and it is kept which functions each of them calls; a mutant then meets the tests that call its function, the short
ones first, until one fails. One that none of them notices survives: a weak test, dead code, or a change without effect.
Compiled kernels are not mutated: their tests run in machine code, which does not say what it called.

    python -m benchmarks.mutants maps                      # 200 mutants of src/evermap/maps, an hour on one core
    python -m benchmarks.mutants explain --number 40 --seed 3
    python -m benchmarks.mutants maps --only maps/why.py   # of some files, by a part of their path
    python -m benchmarks.mutants maps --again out/mutants/maps.jsonl  # those that survived before

Survivors are printed with file, line, the line before and after. Rows of all mutants are appended to `--out`, and a
mutant whose row is there is not run again.
"""

from __future__ import annotations

import argparse
import ast
import copy
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PARTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "maps": (("maps",), ("tests/maps",)),
    "explain": (("explain",), ("tests/explain",)),
    "association": (("slam/association", "align"), ("tests/slam/association", "tests/align")),
    "tracking": (("tracking",), ("tests/tracking",)),
    "existence": (("existence", "survival"), ("tests/existence", "tests/survival")),
    "estimate": (("estimate",), ("tests/estimate",)),
    "server": (("server",), ("tests/server",)),
}
"""What is mutated, below `src/evermap`, and the tests of it."""
NUMBER = 200
MOST_TESTS_S = 60.0
"""Tests of one mutant, by the time they take without it; the shortest, as many as fit."""
SLOWER = 5.0
"""A mutant whose tests take so many times longer, and 20 s, runs for ever, which is noticed."""
COMPARED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd, ast.FloorDiv: ast.Mult,
}  # fmt: skip
CALLED = {
    "min": "max", "max": "min", "any": "all", "all": "any", "argmin": "argmax", "argmax": "argmin",
    "minimum": "maximum", "maximum": "minimum", "exp": "expm1", "log1p": "log", "sum": "mean", "mean": "median",
    "floor": "ceil",
}  # fmt: skip
"""Calls whose results have the type of the other."""


@dataclass(frozen=True)
class Mutant:
    """One change.

    Attributes:
        path: of the file, below `src`.
        function: name of the function, with those around it.
        first_line: where the function begins, decorators included.
        place: number of the changed node among those of the file that can be changed.
        line: where it is.
        what: what was changed into what.
    """

    path: str
    function: str
    first_line: int
    place: int
    line: int
    what: str


def changes_of(node: ast.AST) -> Iterator[tuple[str, Callable[[Any], None]]]:
    """Yield what can be changed in a node: a name of the change, and what does it to a copy of the node."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in COMPARED:
        other = COMPARED[type(node.ops[0])]
        yield f"{type(node.ops[0]).__name__} to {other.__name__}", lambda it: it.ops.__setitem__(0, other())
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in COMPUTED and not _is_text(node):
        operator = COMPUTED[type(node.op)]
        yield f"{type(node.op).__name__} to {operator.__name__}", lambda it: setattr(it, "op", operator())
    if isinstance(node, ast.BoolOp):
        logic = ast.Or if isinstance(node.op, ast.And) else ast.And
        yield f"{type(node.op).__name__} to {logic.__name__}", lambda it: setattr(it, "op", logic())
    if isinstance(node, ast.If | ast.IfExp | ast.While):
        yield "condition negated", lambda it: setattr(it, "test", ast.UnaryOp(ast.Not(), it.test))
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        value = node.value
        twice = 2 * value or 1
        yield f"{value} to {twice}", lambda it: setattr(it, "value", twice)
    if isinstance(node, ast.Constant) and type(node.value) is bool:
        yield f"{node.value} to {not node.value}", lambda it: setattr(it, "value", not it.value)
    if isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in CALLED:
            field = "attr" if isinstance(node.func, ast.Attribute) else "id"
            yield f"{name} to {CALLED[name]}", lambda it: setattr(it.func, field, CALLED[name])
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Invert | ast.Not | ast.USub):
        yield f"{type(node.op).__name__} removed", lambda it: setattr(it, "operand", ast.UnaryOp(node.op, it.operand))


def _is_text(node: ast.BinOp | ast.AugAssign) -> bool:
    parts = (node.left, node.right) if isinstance(node, ast.BinOp) else (node.value,)
    return any(isinstance(part, ast.JoinedStr) or isinstance(getattr(part, "value", None), str) for part in parts)


def functions_of(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield all functions that are not compiled, with their names."""

    def below(body: Sequence[ast.stmt], around: str) -> Iterator[tuple[str, ast.FunctionDef]]:
        for node in body:
            if isinstance(node, ast.ClassDef):
                yield from below(node.body, f"{around}{node.name}.")
            elif isinstance(node, ast.FunctionDef) and not any(map(_compiles, node.decorator_list)):
                yield f"{around}{node.name}", node

    yield from below(tree.body, "")


def _compiles(decorator: ast.expr) -> bool:
    return any(word in ast.unparse(decorator) for word in ("kernel", "jit", "inlined", "vectorised"))


def nodes_of(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """Yield the nodes of a function whose change has an effect: no annotations, and nothing of what an error says."""
    todo: list[ast.AST] = [*function.args.defaults, *(one for one in function.args.kw_defaults if one), *function.body]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.Import | ast.ImportFrom):
            continue
        if isinstance(node, ast.keyword) and node.arg == "strict":  # of `zip`: lengths differ in no test that passes
            continue
        yield node
        parts = (
            {"annotation", "returns", "decorator_list"} if isinstance(node, ast.AnnAssign | ast.FunctionDef) else set()
        )
        for name, value in ast.iter_fields(node):
            if name not in parts:
                todo += [one for one in (value if isinstance(value, list) else [value]) if isinstance(one, ast.AST)]


def mutants_of(path: Path) -> list[Mutant]:
    """Return all mutants of a file."""
    tree, found = ast.parse(path.read_text(encoding="utf-8")), []
    for name, function in functions_of(tree):
        first = min([function.lineno, *(by.lineno for by in function.decorator_list)])
        for place, (node, what, _) in enumerate(_changes(function)):
            where = path.relative_to(ROOT / "src").as_posix()
            found.append(Mutant(where, name, first, place, getattr(node, "lineno", first), what))
    return found


def _changes(function: ast.FunctionDef) -> Iterator[tuple[ast.AST, str, Callable[[Any], None]]]:
    for node in nodes_of(function):
        for what, change in changes_of(node):
            yield node, what, change


def source_of(mutant: Mutant) -> str:
    """Return the text of the file with the change in it; the rest as it was."""
    text = (ROOT / "src" / mutant.path).read_text(encoding="utf-8")
    tree = ast.parse(text)
    function = dict(functions_of(tree))[mutant.function]
    node, _, change = list(_changes(function))[mutant.place]
    start, end = _span(text, node)
    changed = copy.deepcopy(node)
    change(changed)
    new = ast.unparse(ast.fix_missing_locations(changed))
    if isinstance(node, ast.stmt):
        indent = " " * node.col_offset
        new = new.replace("\n", "\n" + indent)
    else:
        new = f"({new})"
    return text[:start] + new + text[end:]


def _span(text: str, node: Any) -> tuple[int, int]:
    lines = text.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))

    def at(line: int, column: int) -> int:
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    return at(node.lineno, node.col_offset), at(node.end_lineno, node.end_col_offset)


PLUGIN = """
import json, os, sys, time
import pytest

SOURCE, FOUND = os.environ["MUTANTS_SOURCE"], {}


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item, nextitem):
    calls, start = set(), time.perf_counter()

    def called(frame, event, _):
        if event == "call" and frame.f_code.co_filename.startswith(SOURCE):
            calls.add((frame.f_code.co_filename[len(SOURCE) + 1:], frame.f_code.co_firstlineno))

    sys.setprofile(called)
    try:
        yield
    finally:
        sys.setprofile(None)
        FOUND[item.nodeid] = (time.perf_counter() - start, sorted(calls))


def pytest_sessionfinish():
    with open(os.environ["MUTANTS_OUT"], "w") as file:
        json.dump(FOUND, file)
"""


def run_tests(tests: Sequence[str], source: Path, scratch: Path, timeout_s: float, **more: str) -> int:
    """Run tests against a copy of the sources and return pytest's exit code, -1 where it took too long."""
    beside = (str(ROOT / each) for each in ("studies/src", "packages/evermap-score/src"))
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(source), *beside, str(scratch)]),
           "OPENBLAS_NUM_THREADS": "1", **more}  # fmt: skip
    line = [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider", "-o", "pythonpath=",
            *(["-p", "which_calls"] if more else ["-x"]), *tests]  # fmt: skip
    try:
        done = subprocess.run(line, cwd=ROOT, env=env, capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return -1
    if done.returncode not in (0, 1):
        print(done.stdout[-2000:], done.stderr[-2000:], file=sys.stderr)
    return done.returncode


def find_callers(tests: Sequence[str], source: Path, scratch: Path) -> dict[tuple[str, int], list[tuple[float, str]]]:
    """Return for each function, by file and first line, the tests that call it and their seconds, short ones first."""
    (scratch / "which_calls.py").write_text(PLUGIN, encoding="utf-8")
    out = scratch / "calls.json"
    code = run_tests(tests, source, scratch, 7200.0, MUTANTS_SOURCE=str(source), MUTANTS_OUT=str(out))
    if code != 0:
        raise SystemExit(f"the tests of the part fail without a mutant (pytest ends with {code})")
    callers: dict[tuple[str, int], list[tuple[float, str]]] = {}
    for test, (seconds, calls) in json.loads(out.read_text(encoding="utf-8")).items():
        for path, line in calls:
            callers.setdefault((path, line), []).append((seconds, test))
    return {key: sorted(found) for key, found in callers.items()}


def judge(mutant: Mutant, callers: Sequence[tuple[float, str]], source: Path, scratch: Path) -> str:
    """Return `noticed`, `survived`, or `unreached` where no test calls its function."""
    if not callers:
        return "unreached"
    chosen, total_s = list[str](), 0.0
    for seconds, test in callers:
        total_s += seconds
        if chosen and total_s > MOST_TESTS_S:
            break
        chosen.append(test)
    target = source / mutant.path
    before = target.read_text(encoding="utf-8")
    target.write_text(source_of(mutant), encoding="utf-8")
    try:
        code = run_tests(chosen, source, scratch, 20.0 + SLOWER * min(total_s, MOST_TESTS_S))
    finally:
        target.write_text(before, encoding="utf-8")
    return "survived" if code == 0 else "noticed"


def main(arguments: Sequence[str] | None = None) -> int:
    """Mutate a part, and return how many mutants were not noticed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--number", type=int, default=NUMBER)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="part of a path")
    parser.add_argument("--again", type=Path, help="rows of an earlier run whose survivors are run")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args(arguments)
    folders, tests = PARTS[given.part]
    out = given.out or ROOT / "out" / "mutants" / f"{given.part}.jsonl"
    out.parent.mkdir(parents=True, exist_ok=True)
    files = [path for folder in folders for path in sorted((ROOT / "src" / "evermap" / folder).rglob("*.py"))]
    every = [one for path in files if given.only in path.as_posix() for one in mutants_of(path)]
    chosen = random.Random(given.seed).sample(every, min(given.number, len(every)))
    if given.again:
        rows = [json.loads(line) for line in given.again.read_text(encoding="utf-8").splitlines()]
        old = {(row["path"], row["function"], row["place"], row["what"]) for row in rows if row["fate"] != "noticed"}
        chosen = [one for one in every if (one.path, one.function, one.place, one.what) in old]
    done = (
        set()
        if given.again or not out.exists()
        else {
            tuple(json.loads(line)[key] for key in ("path", "function", "place", "what"))
            for line in out.read_text(encoding="utf-8").splitlines()
        }
    )
    fates: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        scratch, source = Path(folder), Path(folder) / "src"
        shutil.copytree(ROOT / "src", source)
        callers = find_callers(tests, source, scratch)
        for one in chosen:
            if (one.path, one.function, one.place, one.what) in done:
                continue
            start = time.perf_counter()
            fate = judge(one, callers.get((one.path, one.first_line), []), source, scratch)
            fates[fate] = fates.get(fate, 0) + 1
            with out.open("a", encoding="utf-8") as file:
                row = {**asdict(one), "fate": fate, "seconds": round(time.perf_counter() - start, 1)}
                file.write(json.dumps(row) + "\n")
            if fate != "noticed":
                print(f"{fate}: src/{one.path}:{one.line} {one.function}: {one.what}", flush=True)
    print(f"{given.part}: " + ", ".join(f"{count} {fate}" for fate, count in sorted(fates.items())))
    return sum(count for fate, count in fates.items() if fate != "noticed")


if __name__ == "__main__":
    sys.exit(min(1, main()))
