"""The notebooks in `examples/` run from top to bottom as they are, and are kept without outputs.

Their code is plain Python but for magics, lines that begin with `%`; so they run without Jupyter. A figure at the end
of a cell is drawn. `NOTEBOOK_PICTURES=FOLDER` keeps what they draw.
"""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from .test_docs_commands import REPOSITORY, environment

NOTEBOOKS = sorted((REPOSITORY / "examples").glob("*.ipynb"))
LARGEST = 20_000
"""Bytes of a notebook without outputs."""
TIMEOUT_S = 300


def cells(notebook: Path, kind: str) -> list[str]:
    content = json.loads(notebook.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in content["cells"] if cell["cell_type"] == kind]


def script(notebook: Path) -> str:
    """The cells as one program, in which the value of a last line is shown as a notebook shows it."""
    parts = ["def shown(value, number):", "    import os", "    if hasattr(value, 'savefig'):"]
    parts += ["        folder = os.environ.get('NOTEBOOK_PICTURES', '.')"]
    parts += [f"        value.savefig(os.path.join(folder, f'{notebook.stem}-{{number}}.png'))"]
    parts += ["    elif value is not None:", "        print(getattr(value, '_repr_html_', value.__repr__)())"]
    for number, text in enumerate(cells(notebook, "code")):
        lines = [line for line in text.splitlines() if not line.startswith("%")]
        tree = ast.parse("\n".join(lines))
        if tree.body and isinstance(tree.body[-1], ast.Expr):
            last = tree.body[-1]
            call = ast.Call(ast.Name("shown", ast.Load()), [last.value, ast.Constant(number)], [])
            tree.body[-1] = ast.copy_location(ast.Expr(call), last)
        parts.append(ast.unparse(ast.fix_missing_locations(tree)))
    return "\n".join(parts)


def test_there_is_one_for_each_way_in() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["existence", "living_map", "tracks"]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(notebook: Path) -> None:
    content: dict[str, Any] = json.loads(notebook.read_text(encoding="utf-8"))
    assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in content["cells"]}) == len(content["cells"])
    for cell in content["cells"]:
        assert cell["cell_type"] in ("markdown", "code")
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None
    assert notebook.stat().st_size < LARGEST
    assert cells(notebook, "markdown")[0].startswith("# ")


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook: Path, tmp_path: Path) -> None:
    code = script(notebook)
    pictures = os.environ.get("NOTEBOOK_PICTURES") or str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**environment(), "NOTEBOOK_PICTURES": pictures},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert done.stdout.strip()
    assert list(Path(pictures).glob(f"{notebook.stem}-*.png"))
