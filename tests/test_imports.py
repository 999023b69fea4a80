"""Imports go one way, and importing is cheap. The table below is also in docs/architecture.md, word by word."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

from evermap import _HOME, __all__

SOURCE = Path(__file__).resolve().parents[1] / "src" / "evermap"

# part -> what it may import of ours, beside itself
RULES = {
    "errors": "",
    "interrupts": "",
    "compiled": "errors interrupts",
    "plugins": "errors",
    "show": "errors",
    "types": "errors show",
    "config": "errors types",
    "geometry": "compiled types",
    "survival": "errors show types",
    "valid": "errors types",
    "estimate": "errors compiled types geometry",
    "align": "types config geometry",
    "io": "errors compiled interrupts plugins types geometry valid estimate",
    "metrics": "errors show types geometry estimate",
    "sensing": "errors compiled types config geometry",
    "existence": "errors compiled show types survival io sensing",
    "tracking": "errors compiled show types config geometry survival valid io sensing existence",
    "viz": "errors types geometry survival metrics existence estimate",
    "slam": "errors interrupts compiled plugins show types config geometry valid sensing tracking estimate align",
    "explain": "errors types config geometry estimate slam",
    "maps": "errors show types config geometry survival valid sensing existence tracking estimate align slam explain",
    "pipeline": "errors compiled types config estimate slam explain maps",
    "runs": (
        "errors interrupts show types config geometry survival valid io metrics existence tracking viz maps pipeline"
    ),
    "live": "errors compiled types config geometry valid io maps runs slam",
    "server": "errors types config io maps runs",
    "cli": (
        "errors interrupts compiled plugins types config geometry survival valid io existence tracking viz slam "
        "maps pipeline runs live server"
    ),
}

# loaded by the functions that need them, never by starting up
HEAVY = (
    "numba",
    "gtsam",
    "matplotlib",
    "scipy",
    "pyarrow",
    "pandas",
    "evo",
    "rerun",
    "zenoh",
    "foxglove",
    "fastapi",
    "psycopg",
    "pydantic",
    "rich",
    "numpy",
)
# what one may import of the core without loading any of these
LAZY_EVERYWHERE = ("numba", "gtsam", "matplotlib", "pyarrow", "pandas", "evo", "rerun", "zenoh", "foxglove")


def part_of(path: Path) -> str:
    """'slam' for src/evermap/slam/graph.py, 'types' for src/evermap/types/sensor.py."""
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


@functools.cache
def imported_parts(path: Path) -> frozenset[str]:
    """Parts of evermap that a module imports anywhere, inside functions and for type checking too."""
    package = ["evermap", *path.relative_to(SOURCE).parts[:-1]]
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names |= {f"{module}.{alias.name}" for alias in node.names} if module == "evermap" else {module}
    return frozenset(name.split(".")[1] for name in names if name.startswith("evermap.")) - {"__version__"}


MODULES = sorted(path for path in SOURCE.rglob("*.py") if path.parent != SOURCE or not path.name.startswith("__"))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_module_imports_only_what_its_part_may(path: Path) -> None:
    part = part_of(path)
    assert part in RULES, f"'{part}' has no row in the table of import rules"
    forbidden = imported_parts(path) - set(RULES[part].split()) - {part}
    assert not forbidden, f"evermap.{part} may not import {', '.join(sorted(forbidden))}"


def test_rules_have_no_cycle() -> None:
    left = {part: set(allowed.split()) for part, allowed in RULES.items()}
    while left:
        free = {part for part, needs in left.items() if not needs & left.keys()}
        assert free, f"cycle among {sorted(left)}"
        left = {part: needs for part, needs in left.items() if part not in free}


def test_every_permission_is_used() -> None:
    used: dict[str, set[str]] = {}
    for path in MODULES:
        used.setdefault(part_of(path), set()).update(imported_parts(path) - {part_of(path)})
    assert used == {part: set(allowed.split()) for part, allowed in RULES.items()}


def test_the_library_knows_no_study() -> None:
    for path in MODULES:
        assert "evermap_studies" not in path.read_text(encoding="utf-8"), path


def test_the_core_knows_nothing_of_its_users() -> None:
    outside = {"viz", "cli", "runs", "metrics"}
    for part in ("survival", "sensing", "existence", "tracking", "slam", "explain", "maps", "pipeline"):
        assert not set(RULES[part].split()) & outside, part


def test_architecture_page_shows_the_same_table() -> None:
    page = (SOURCE.parents[1] / "docs" / "architecture.md").read_text(encoding="utf-8")
    cells = [
        [cell.strip(" `") for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| `")
    ]
    shown = {row[0]: set(row[1].replace("`", "").split()) - {"–"} for row in cells if row[0] in RULES}
    assert shown == {part: set(allowed.split()) for part, allowed in RULES.items()}


def loaded_after(statement: str) -> set[str]:
    """Top-level modules in a fresh interpreter after a statement."""
    code = f"{statement}\nimport sys\nprint(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=SOURCE.parent)
    return set(done.stdout.split())


@pytest.mark.parametrize("module", ["evermap", "evermap.cli.main"])
def test_starting_up_loads_nothing_heavy(module: str) -> None:
    assert not loaded_after(f"import {module}") & set(HEAVY)


@pytest.mark.parametrize(
    "part",
    ["types", "errors", "geometry.se2", "config", "io", "metrics", "viz", "pipeline", "runs.folder", "slam"],
)
def test_importing_a_part_loads_no_plot_backend_or_compiler(part: str) -> None:
    assert not loaded_after(f"import evermap.{part}") & set(LAZY_EVERYWHERE)


def test_public_names_are_real() -> None:
    import evermap

    for name in __all__:
        assert getattr(evermap, name) is not None
    assert sorted(__all__) == sorted(["__version__", *(name for names in _HOME.values() for name in names)])
    with pytest.raises(AttributeError, match="no_such_name"):
        evermap.no_such_name  # noqa: B018
