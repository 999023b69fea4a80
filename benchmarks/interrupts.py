"""Interrupt commands at random instants, and count how they ended.

    python -m benchmarks.interrupts --count 200

Every verb runs once to its end, to know how long it takes and to leave an older output. Then commands are started
again and again and get a SIGINT after a random share of that time. Each must end with exit code 130 and one line that
says so, leave nothing half written, and the older output whole. What is found is printed as a table; the exit code is 1
where a command did anything else.
"""

from __future__ import annotations

import argparse
import collections
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

VERBS: dict[str, list[str]] = {
    "slam": ["slam", "rec", "--out", "out/slam"],
    "map enter": ["map", "enter", "site.evermap", "later", "--out", "out/living"],
    "persist": ["persist", "looks.csv", "--out", "out/persist", "--set", "figures=2"],
    "track": ["track", "detections.csv", "--range-m", "12", "--out", "out/track"],
    "simulate": ["simulate", "building", "--days", "8", "--force"],
    "convert": ["convert", "rec", "converted", "--force"],
    "demo": ["demo", "--days", "2", "--out", "out/demo"],
    "reproduce": ["reproduce", "rosen2016", "--sequences", "200", "--out", "out/rosen2016"],
    "survival fit": ["survival", "fit", "out/track/lifetimes.csv", "--out", "priors.json"],
    "map show": ["map", "show", "site.evermap", "--figure", "map.png"],
}
SHARES = {"slam": 8, "map enter": 3}
"""How often a verb is interrupted; 1 for the others."""


PYTHON_STARTS_S = 0.3
"""Only so early can an interrupt hit Python itself, before the first line of ours: .02 s on an idle machine."""
PYTHON_ENDS_S = 0.1
"""A command that ends well so soon after the signal had reported its result: Python was clearing up, and heard nothing.
One that swallowed the signal still had to write its output."""
BEFORE_OURS = "interrupted while Python itself was starting"


@dataclass(frozen=True, slots=True)
class Ending:
    """How one interrupted command ended; `wrong` is '' where all is as it should be."""

    verb: str
    after_s: float
    code: int
    stderr: str
    wrong: str


def main() -> int:
    """Parse, run, count. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=VERBS, action="append", help="only this verb; repeatable")
    parser.add_argument("--first-s", type=float, help="interrupt within the first seconds only")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="evermap-interrupts-") as folder:
        endings = interrupt(
            Path(folder), given.count, seed=given.seed, verbs=given.only or list(VERBS), first_s=given.first_s
        )
    counts: collections.Counter[tuple[str, int, str]] = collections.Counter()
    for ending in endings:
        counts[ending.verb, ending.code, ending.wrong] += 1
    for (verb, code, wrong), count in sorted(counts.items()):
        print(f"{count:5d}  {verb:14s} exit {code:4d}  {wrong or 'as it should be'}")
    lines = collections.Counter(ending.stderr.splitlines()[-1] for ending in endings if not ending.wrong)
    for line, count in lines.most_common():
        print(f"{count:5d}  {line}")
    early = [ending for ending in endings if ending.wrong == BEFORE_OURS]
    bad = [ending for ending in endings if ending.wrong and ending not in early]
    for ending in bad:
        print(f"\n{ending.verb} after {ending.after_s:.3f} s: exit {ending.code}, {ending.wrong}\n{ending.stderr}")
    print(f"\n{len(endings) - len(bad) - len(early)} of {len(endings)} interrupts ended with 130 and one line")
    if early:
        print(f"{len(early)} more within {max(ending.after_s for ending in early):.3f} s: {BEFORE_OURS}")
    return 1 if bad else 0


def interrupt(folder: Path, count: int, *, seed: int, verbs: list[str], first_s: float | None = None) -> list[Ending]:
    """Run the verbs in a folder, first to their ends, then interrupted."""
    prepare(folder)
    chance = random.Random(seed)
    lasts_s = {verb: _duration_s(folder, VERBS[verb]) for verb in verbs}
    endings: list[Ending] = []
    while len(endings) < count:
        verb = chance.choices(verbs, [SHARES.get(verb, 1) for verb in verbs])[0]
        after_s = chance.uniform(0.0, first_s or lasts_s[verb])
        ending = _interrupted(folder, verb, after_s)
        if ending is not None:
            endings.append(ending)
            print(f"{len(endings)}/{count} {verb} {after_s:.3f} s: {ending.code} {ending.wrong}", file=sys.stderr)
    return endings


def prepare(folder: Path) -> None:
    """What the verbs read."""
    _run(folder, ["simulate", "sessions", "--days", "2", "--patrol-s", "60"])
    shutil.copytree(folder / "sessions" / "day00_session00", folder / "rec")
    shutil.copytree(folder / "sessions" / "day01_session00", folder / "later")
    _run(folder, ["map", "enter", "site.evermap", "rec", "--out", "out/living"])
    _run(folder, ["init", "looks", "looks.csv"])
    _run(folder, ["init", "detections", "detections.csv"])
    _run(folder, VERBS["track"])


def _duration_s(folder: Path, command: list[str]) -> float:
    """Twice, because the first time kernels may be compiled."""
    for _ in range(2):
        start = time.perf_counter()
        _keeping_the_map(folder, lambda: _run(folder, command))
    return time.perf_counter() - start


def _interrupted(folder: Path, verb: str, after_s: float) -> Ending | None:
    """None where the command was done before it could be interrupted."""
    before = _state(folder)

    def run() -> tuple[int, str] | None:
        process = _start(folder, VERBS[verb])
        time.sleep(after_s)
        if process.poll() is not None:
            process.communicate()
            return None
        process.send_signal(signal.SIGINT)
        sent_s = time.perf_counter()
        _, stderr = process.communicate(timeout=300)
        if process.returncode == 0 and time.perf_counter() - sent_s < PYTHON_ENDS_S:
            return None
        return process.returncode, stderr

    ended = _keeping_the_map(folder, run)
    if ended is None:
        return None
    code, stderr = ended
    wrong = ""
    lines = stderr.splitlines()
    # Python's own death by the signal: none of our handlers was there yet, they all end with 130
    if code != 130 and after_s < PYTHON_STARTS_S and (code == -signal.SIGINT or "evermap" not in stderr):
        wrong = BEFORE_OURS
    elif code != 130:
        wrong = "another exit code"
    elif not lines or not lines[-1].startswith("evermap: interrupted: "):
        wrong = "no line that says so"
    elif any(not line.startswith("evermap: ") for line in lines):
        wrong = "other text"
    elif hidden := [name for name in _state(folder) if _is_temporary(name) and name not in before]:
        wrong = f"left {hidden[0]}"
    else:
        wrong = _damage(folder, before)
    return Ending(verb, after_s, code, stderr.strip(), wrong)


def _damage(folder: Path, before: dict[str, str]) -> str:
    """Outputs must be the older ones, or whole new ones; all else as it was."""
    now = _state(folder)
    changed = {name for name in before.keys() | now.keys() if before.get(name) != now.get(name)}
    for manifest in sorted(folder.rglob(".evermap-run.json")):
        listed = json.loads(manifest.read_text())["files"]
        for name, checksums in listed.items():
            path = manifest.parent / name
            if not path.is_file() or _checksum(path) not in checksums:
                return f"{path.relative_to(folder)} is not what its list says"
            changed.discard(path.relative_to(folder).as_posix())
        changed.discard(manifest.relative_to(folder).as_posix())
    gone = {name for name in changed if name not in now and name.startswith("out/")}  # replaced by a new run
    changed -= gone | {"site.evermap", "priors.json", "map.png"}
    return f"changed {min(changed)}" if changed else ""


def _is_temporary(name: str) -> bool:
    return any(part.startswith(".") and part != ".evermap-run.json" for part in Path(name).parts) or "journal" in name


def _state(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): _checksum(path) for path in folder.rglob("*") if path.is_file()}


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _keeping_the_map(folder: Path, run: Callable[[], Any]) -> Any:
    """A session is entered once: the map is put back afterwards."""
    content = (folder / "site.evermap").read_bytes()
    try:
        return run()
    finally:
        (folder / "site.evermap").write_bytes(content)


def _run(folder: Path, command: list[str]) -> None:
    process = _start(folder, command)
    _, stderr = process.communicate()
    if process.returncode:
        raise RuntimeError(f"evermap {' '.join(command)}: {stderr}")


def _start(folder: Path, command: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "evermap", *command],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        # a shell that runs this in the background has it ignore SIGINT, which is inherited
        preexec_fn=_default_interrupt if os.name == "posix" else None,  # noqa: PLW1509 (no threads here)
    )


def _default_interrupt() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)


if __name__ == "__main__":
    sys.exit(main())
