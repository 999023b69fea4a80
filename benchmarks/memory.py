"""How much memory a contender needs, measured in a process of its own.

    python -m benchmarks.memory isam2 evermap 2000

And how much `evermap persist` needs of a folder of Parquet files with so many looks at 20,000 features, in parts of a
million rows and in one piece, with CPU time and the checksum of all beliefs:

    python -m benchmarks.memory persist parts 8000000
    python -m benchmarks.memory persist one 8000000
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_WARM_UP_POSES = 50
_FEATURES, _FILE_ROWS, _PART_ROWS = 20_000, 500_000, 1_000_000


def measure(race: str, contender: str, n_poses: int) -> dict[str, float]:
    """Peak resident memory [MB] of a fresh process that runs one contender once, and what it had before the run.

    Args:
        race: one of `contenders.CONTENDERS`, 'scale', or 'persist'.
        contender: 'evermap' or 'gtsam'; of 'persist', 'parts' or 'one'.
        n_poses: size of the world; of 'scale', in landmarks, of 'persist', in looks.
    """
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.memory", race, contender, str(n_poses)],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env=child_environment(),
    )
    measured: dict[str, float] = json.loads(done.stdout)
    return measured


def child_environment() -> dict[str, str]:
    """Return the environment of a child that imports this checkout."""
    path = [str(ROOT), str(ROOT / "src"), str(ROOT / "studies" / "src"), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, path))}


def peak_mb() -> float:
    """Largest resident size of this process so far [MB].

    Linux counts the parent's size at the fork into `ru_maxrss`, which would hide a contender smaller than its parent;
    the address space's own high-water mark does not.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1e3
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


def _run(race: str, contender: str, n_poses: int) -> dict[str, float]:
    """In the child: libraries are loaded and code is compiled by a small world first, so that they do not count."""
    if race == "scale":
        from benchmarks import scale

        scale.once(contender, scale.WARM_UP)
        before_mb = peak_mb()
        scale.once(contender, n_poses)
        return {"before_mb": before_mb, "peak_mb": peak_mb()}
    if race == "persist":
        return _persist(contender == "parts", n_poses)
    from benchmarks.contenders import CONTENDERS
    from benchmarks.world import circular_world

    compete = CONTENDERS[race][("evermap", "gtsam").index(contender)]
    calibrated = race == "isam2"
    compete(circular_world(_WARM_UP_POSES, calibrated=calibrated))
    world = circular_world(n_poses, calibrated=calibrated)
    before_mb = peak_mb()
    compete(world)
    return {"before_mb": before_mb, "peak_mb": peak_mb()}


def _persist(in_parts: bool, rows: int) -> dict[str, float]:
    """`evermap persist` of simulated looks, 500,000 a file."""
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq
    from typer.testing import CliRunner

    from evermap.cli.main import app

    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        looks, out = Path(folder) / "looks", Path(folder) / "out"
        looks.mkdir()
        for number, start in enumerate(range(0, rows, _FILE_ROWS)):
            size = min(_FILE_ROWS, rows - start)
            who, stamp_s = rng.integers(0, _FEATURES, size), 1.7e9 + start + np.sort(rng.uniform(0, size, size))
            there = stamp_s < 1.7e9 + rows * (who + 1) / _FEATURES
            detected = rng.random(size) < np.where(there, 0.9, 0.1)
            table = pa.table({"stamp_s": stamp_s, "feature_id": who, "detected": detected.astype(np.int8)})
            pq.write_table(table, looks / f"{number:04}.parquet")
        CliRunner().invoke(app, ["init", "looks", str(Path(folder) / "small.csv")])
        CliRunner().invoke(app, ["persist", str(Path(folder) / "small.csv"), "--out", str(out)])
        before_mb, before = peak_mb(), os.times()
        words = ["persist", str(looks), "--out", str(out), "--set", "figures=2"]
        words += ["--set", f"persist.rows_at_once={_PART_ROWS if in_parts else rows}"]
        assert CliRunner().invoke(app, words).exit_code == 0
        after = os.times()
        with (out / "beliefs.csv").open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    print(f"beliefs: {digest}", file=sys.stderr)
    cpu_s = after.user + after.system - before.user - before.system
    return {"before_mb": before_mb, "peak_mb": peak_mb(), "cpu_s": cpu_s}


if __name__ == "__main__":
    print(json.dumps(_run(sys.argv[1], sys.argv[2], int(sys.argv[3]))))
