"""How much memory a contender needs, measured in a process of its own.

python -m benchmarks.memory isam2 evermap 2000
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_WARM_UP_POSES = 50


def measure(race: str, contender: str, n_poses: int) -> dict[str, float]:
    """Peak resident memory [MB] of a fresh process that runs one contender once, and what it had before the run.

    Args:
        race: one of `contenders.CONTENDERS`, or 'scale'.
        contender: 'evermap' or 'gtsam'.
        n_poses: size of the world; of 'scale', in landmarks.
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
    from benchmarks.contenders import CONTENDERS
    from benchmarks.world import circular_world

    compete = CONTENDERS[race][("evermap", "gtsam").index(contender)]
    calibrated = race == "isam2"
    compete(circular_world(_WARM_UP_POSES, calibrated=calibrated))
    world = circular_world(n_poses, calibrated=calibrated)
    before_mb = peak_mb()
    compete(world)
    return {"before_mb": before_mb, "peak_mb": peak_mb()}


if __name__ == "__main__":
    print(json.dumps(_run(sys.argv[1], sys.argv[2], int(sys.argv[3]))))
