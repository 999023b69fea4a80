"""Compute figures of accuracy, consistency, changes, beliefs and cost, or compare those of two commits.

    python -m benchmarks.goldens --out now.json                        # all; some ten minutes on one core
    python -m benchmarks.goldens --out now.json --only mrclam6 room    # some parts
    python -m benchmarks.goldens --out now.json --resume               # what is not in the file yet
    python -m benchmarks.goldens --compare before.json now.json        # exits with 1 if something got worse
    python -m benchmarks.goldens --commits main HEAD                   # computes both, one after the other

A part whose recording is not here says so and has no figures. One that fails is noted as failed; the others still run.
Costs are CPU seconds of one process: other work on the machine moves them by some ten percent, which their tolerances
allow; everything else is the same from run to run.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.goldens import recordings, worlds
from benchmarks.goldens.figures import ABSENT, BAD, DONE, FAILED, Figure, Figures, as_text, compare
from benchmarks.goldens.scores import MissingDataError

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
OWN = Path(__file__).resolve().parent.relative_to(ROOT)


def all_parts() -> dict[str, recordings.Part]:
    """Return every part by name, cheap ones first."""
    return worlds.parts() | recordings.parts()


def compute(out: Path, data: Path, only: Sequence[str] = (), *, resume: bool = False) -> Figures:
    """Compute parts and write the file after each.

    Args:
        out: JSON.
        data: the shared folder.
        only: names of parts, or beginnings of them; all where empty.
        resume: keep what the file has of parts that were done.
    """
    found = Figures.read(out) if resume and out.is_file() else Figures({}, {}, {})
    found.about = about()
    warm_up()
    parts = {name: part for name, part in all_parts().items() if not only or name.startswith(tuple(only))}
    for name, part in parts.items():
        if resume and found.parts.get(name, {}).get("state") == DONE:
            continue
        began = time.process_time()
        state, line = DONE, ""
        figures: dict[str, Figure] = {}
        try:
            for key, value in part(data):
                figures[f"{name}/{key}"] = Figure.of(f"{name}/{key}", value)
        except MissingDataError as error:
            state, line = ABSENT, str(error)
        except Exception as error:  # whatever it is, the other parts are to run
            state, line = FAILED, f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            traceback.print_exc(limit=-4)
        cpu_s = time.process_time() - began
        found.figures = {key: one for key, one in found.figures.items() if key.partition("/")[0] != name} | figures
        found.parts[name] = {"state": state, "line": line, "cpu_s": round(cpu_s, 1)}
        found.write(out)
        print(f"{name}: {state}, {len(figures)} figures, {cpu_s:.1f} s{f': {line}' if line else ''}", flush=True)
    return found


def warm_up() -> None:
    """Compile what most parts need, so that no figure of cost holds it: the templates, with and without identities."""
    import evermap as em
    from evermap.io import write_template
    from evermap.types import UNKNOWN

    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        for in_space in (False, True):
            recording = em.read_recording(write_template(Path(folder) / str(in_space), in_space=in_space))
            seen = recording.detections
            nameless = replace(recording, detections=replace(seen, landmark_id=np.full_like(seen.landmark_id, UNKNOWN)))
            config = em.Config(slam={"unknown_ids": True})
            for one, settings in ((recording, None), (nameless, config)):
                try:
                    living = em.run_session(one, None, settings).living
                    em.run_session(one, living, settings)
                except Exception as error:  # parts will say
                    print(f"warming up: {error}", flush=True)
    print(f"warmed up, {time.process_time() - began:.1f} s", flush=True)


def about() -> dict[str, Any]:
    """Return the commit, whether it was changed, versions and the machine."""
    from evermap.runs.summary import versions

    def git(*given: str) -> str:
        try:
            done = subprocess.run(["git", *given], cwd=ROOT, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return ""
        return done.stdout.strip()

    changed = bool(git("status", "--porcelain", "--untracked-files=no"))
    commit = git("rev-parse", "--short=10", "HEAD") + ("+changes" if changed else "")
    return {"commit": commit, "versions": versions(), "machine": platform.machine(), "cores": os.cpu_count()}


def at_commit(commit: str, out: Path, data: Path, only: Sequence[str]) -> Figures:
    """Compute at a commit, in a worktree of its own; with the goldens from here, so that both count the same."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        subprocess.run(["git", "worktree", "add", "--detach", "--quiet", str(tree), commit], cwd=ROOT, check=True)
        try:
            shutil.copytree(ROOT / OWN, tree / OWN, dirs_exist_ok=True)
            paths = os.pathsep.join(str(tree / each) for each in ("src", "studies/src", ""))
            command = [sys.executable, "-m", "benchmarks.goldens", "--out", str(out), "--data", str(data)]
            command += ["--only", *only] if only else []
            # it ends with 1 where a part fails, which the file says
            subprocess.run(command, cwd=tree, env={**os.environ, "PYTHONPATH": paths}, check=False)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT, check=True)
    found = Figures.read(out)
    found.about["commit"] = found.about["commit"].removesuffix("+changes")
    found.write(out)
    return found


def report(before: Figures, after: Figures) -> int:
    """Print the comparison; returns 1 if something is worse."""
    rows = compare(before, after)
    print(as_text(before, after, rows))
    return int(any(row.verdict in BAD for row in rows))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks.goldens", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="compute, and write what was found")
    parser.add_argument("--only", nargs="+", default=[], metavar="PART", help="parts by name, or beginnings of names")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of recordings")
    parser.add_argument("--resume", action="store_true", help="keep what FILE.json has")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("A.json", "B.json"), help="of two files")
    parser.add_argument("--commits", nargs=2, metavar=("A", "B"), help="compute both and compare")
    parser.add_argument("--list", action="store_true", help="names of the parts")
    given = parser.parse_args(arguments)
    unknown = [name for name in given.only if not any(part.startswith(name) for part in all_parts())]
    if unknown:
        parser.error(f"no part '{unknown[0]}': {', '.join(all_parts())}")
    if given.list:
        print("\n".join(all_parts()))
        return 0
    if given.compare:
        before, after = (Figures.read(path) for path in given.compare)
        return report(before, after)
    data = given.data.resolve()
    if given.commits:
        with tempfile.TemporaryDirectory() as folder:
            files = [Path(folder) / f"{row}.json" for row in range(2)]
            found = [at_commit(one, path, data, given.only) for one, path in zip(given.commits, files, strict=True)]
        return report(found[0], found[1])
    if given.out is None:
        parser.error("one of --out, --compare and --commits is needed")
    found_now = compute(given.out, data, given.only, resume=given.resume)
    return int(any(part["state"] == FAILED for part in found_now.parts.values()))


if __name__ == "__main__":
    raise SystemExit(main())
