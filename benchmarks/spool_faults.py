"""What does a flipped bit cost of a drive that waits to enter its map? Flips one bit after another of its spool.

    python -m benchmarks.spool_faults                    # 10,000 flips, some minutes
    python -m benchmarks.spool_faults --flips 100000 --seed 1

Each flip is in a copy of one of the files of a folder `MAP.live` of two sessions, and that file is read, as whoever
enters the sessions reads it. It is refused where that raises; parts are lost that are not read as they were written.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evermap.config import Config
from evermap.live.parts import unpack_parts
from evermap.live.spool import WAITING, Spool, find_settings
from evermap.maps.store.measured import pack_recording
from evermap.types import UNKNOWN, Detections, Frames, Odometry, Recording, Sensor

SESSIONS, PARTS = 2, 12
"""Sessions that wait, and parts of each, of two seconds."""


class Cost(NamedTuple):
    """What flips cost.

    Attributes:
        refused: files whose reading raised.
        lost: how many flips cost 0, 1, 2, ... parts.
        wrong: parts that were read and differ from what was written.
        silent: flips that cost a part, of which nothing is said.
        settings: flips of which the settings of the engine are taken.
    """

    refused: int
    lost: Counter[int]
    wrong: int
    silent: int
    settings: int


def make_part(number: int, rate_hz: float = 10.0, count: int = 6) -> Recording:
    """Return two seconds of a drive, with some detections a frame."""
    random = np.random.default_rng(number)
    stamp_s = 2.0 * number + np.arange(0.0, 2.0, 1.0 / rate_hz)
    size = count * len(stamp_s)
    return Recording(
        name="drive",
        source="",
        odometry=Odometry(stamp_s, *random.normal(size=(3, len(stamp_s)))),
        frames=Frames(stamp_s),
        detections=Detections(
            np.repeat(np.arange(len(stamp_s)), count),
            random.integers(40, size=size),
            random.uniform(1.0, 9.0, size),
            random.uniform(-1.0, 1.0, size),
            class_id=np.full(size, UNKNOWN),
            sigma_range_m=np.full(size, np.nan),
            sigma_bearing_rad=np.full(size, np.nan),
            source_line=np.zeros(size, dtype=np.int64),
        ),
        sensor=Sensor(),
    )


def measure(flips: int, seed: int) -> Cost:
    """Return what `flips` bits cost, one at a time."""
    random, written = np.random.default_rng(seed), [make_part(k) for k in range(SESSIONS * PARTS)]
    key = {pack_recording(part) for part in written}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "site.evermap"
        spool = Spool(path)
        spool.settle(Config())
        for k, part in enumerate(written):
            spool.write(part)
            if k % PARTS == PARTS - 1:
                spool.finish()
        spool.close()
        files = [one for one in sorted(spool.folder.iterdir()) if one.stat().st_size]
        whole = [one.read_bytes() for one in files]
        bounds = np.cumsum([len(data) for data in whole])
        refused = wrong = silent = settings = 0
        lost = Counter[int]()
        for _ in range(flips):
            at = int(random.integers(bounds[-1]))
            k = int(np.searchsorted(bounds, at, side="right"))
            data = bytearray(whole[k])
            row = at - (int(bounds[k - 1]) if k else 0)
            data[row] ^= 1 << int(random.integers(8))
            try:
                if files[k].suffix != WAITING:
                    files[k].write_bytes(data)
                    settings += find_settings(files[k]) is None
                    lost[0] += 1
                    continue
                found = unpack_parts(bytes(data))
            except Exception:
                refused += 1
                continue
            right = sum(pack_recording(part) in key for part in found.recordings)
            wrong += len(found.recordings) - right
            lost[PARTS - right] += 1
            silent += right < PARTS and not found.damage
    return Cost(refused, lost, wrong, silent, settings)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flips", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    cost = measure(asked.flips, asked.seed)
    print(f"{asked.flips} flips: {cost.refused} files refused, {cost.wrong} parts read wrong, {cost.silent} silent")
    for parts, count in sorted(cost.lost.items()):
        print(f"  {parts} parts lost: {count}")
    print(f"  settings taken from the engine instead: {cost.settings}")


if __name__ == "__main__":
    main()
