"""Count the code that a reader steps through when a second session enters a map.

    python -m benchmarks.session_path           # modules, functions, depth, maps made
    python -m benchmarks.session_path --list    # and the functions by module, in order of first entry; deepest stack

Two patrols of a simulated building go through `evermap map enter`; the second one is traced. Imports on the way are
not counted, nor are comprehensions, lambdas, bodies of classes and generated methods, which are no steps of their own,
nor compiled kernels, into which a debugger does not step.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from inspect import CO_OPTIMIZED
from io import StringIO
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import evermap as em

PACKAGE = Path(em.__file__).parent
OVERRIDES = ("slam.calibration.fix={range_slope = 0.0}",)
"""Without a length standard no estimator can tell the size of a building."""


@dataclass(slots=True)
class CodePath:
    """What was entered.

    Attributes:
        functions: by module, each in order of first entry.
        deepest: functions on the stack when most of ours were.
        maps: instances of `LivingMap` that were made.
    """

    functions: dict[str, list[str]] = field(default_factory=dict)
    deepest: tuple[str, ...] = ()
    maps: int = 0

    def figures(self) -> dict[str, int]:
        """Return the four counts."""
        return {
            "modules": len(self.functions),
            "functions": sum(len(names) for names in self.functions.values()),
            "depth": len(self.deepest),
            "maps": self.maps,
        }


def trace(run: Callable[[], object]) -> CodePath:
    """Return which functions of the package a call enters."""
    from evermap.maps.living import LivingMap

    path, entered, stack = CodePath(), set[CodeType](), list[tuple[FrameType, str]]()
    makes_map = LivingMap.__init__.__code__
    names: dict[CodeType, str] = {}

    def name_of(code: CodeType) -> str:
        """Return 'module:function'; '' for what is not counted."""
        if code not in names:
            file = Path(code.co_filename)
            counted = PACKAGE in file.parents and _is_function(code)
            module = ".".join(file.relative_to(PACKAGE).with_suffix("").parts) if counted else ""
            names[code] = f"{module}:{code.co_qualname}" if counted else ""
        return names[code]

    def profile(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call":
            path.maps += code is makes_map
            name = name_of(code)
            if not name:
                return
            stack.append((frame, name))
            if code not in entered:
                entered.add(code)
                module, _, function = name.partition(":")
                path.functions.setdefault(module, []).append(function)
            if len(stack) > len(path.deepest):
                path.deepest = tuple(each for _, each in stack)
        elif event == "return" and stack and stack[-1][0] is frame:
            stack.pop()

    sys.setprofile(profile)
    try:
        run()
    finally:
        sys.setprofile(None)
    return path


def _is_function(code: CodeType) -> bool:
    """Return whether code is that of a function or a generator that has a name, not of a module or a class."""
    return bool(code.co_flags & CO_OPTIMIZED) and not code.co_name.startswith("<")


def second_session(folder: Path) -> CodePath:
    """Return the path of the second of two sessions, which goes through the command line into a map.

    Raises:
        RuntimeError: one of them did not go into the map.
    """
    from evermap.cli.main import app
    from evermap_studies.lifelong.world import simulated_world

    written = []
    for number, recording in enumerate(simulated_world(1, 0).recordings[:2]):
        written.append(folder / f"patrol-{number}")
        em.write_native(recording, written[-1])

    def slam(recording: Path) -> None:
        words = ["map", "enter", str(folder / "map.evermap"), str(recording), "--out", f"{recording}-out"]
        for text in OVERRIDES:
            words += ["--set", text]
        said = StringIO()
        try:
            with redirect_stdout(said), redirect_stderr(said):
                app(words)
        except SystemExit as end:
            if end.code:
                raise RuntimeError(said.getvalue()) from None

    slam(written[0])
    return trace(lambda: slam(written[1]))


def main(given: list[str] | None = None) -> int:
    """Measure, and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.session_path", description=__doc__.splitlines()[0])
    parser.add_argument("--list", action="store_true", help="functions by module, and the deepest stack")
    asked = parser.parse_args(given)
    with tempfile.TemporaryDirectory() as folder:
        path = second_session(Path(folder))
    if asked.list:
        for module, names in path.functions.items():
            print(f"{module} ({len(names)})", *names, sep="\n    ")
        print("deepest stack", *path.deepest, sep="\n    ")
    print(*(f"{name} {count:,}" for name, count in path.figures().items()), sep=", ")
    return 0


if __name__ == "__main__":
    sys.exit(main())
