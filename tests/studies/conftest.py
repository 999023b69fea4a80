"""A made-up MRCLAM data set: two robots drive round among landmarks, one is blind for a while."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from evermap.geometry import se2

LANDMARKS = {6: (3.0, 0.5), 7: (2.0, 3.5), 8: (-1.5, 3.0), 9: (-3.0, -1.0), 10: (0.5, -3.2), 11: (3.5, -2.5)}
BARCODE = {1: 5, 2: 14, **{subject: 50 + subject for subject in LANDMARKS}}
START_S, DURATION_S = 1000.0, 75.0
BLIND_S = {1: (1030.0, 1042.0), 2: (0.0, 0.0)}


@pytest.fixture(scope="session")
def made_up_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder that holds `MRCLAM_Dataset6`, with the whole truth, and nothing else."""
    folder = tmp_path_factory.mktemp("data") / "MRCLAM_Dataset6"
    folder.mkdir()
    _write(folder / "Barcodes.dat", list(BARCODE.items()))
    _write(folder / "Landmark_Groundtruth.dat", [(k, x, y, 0.001, 0.001) for k, (x, y) in LANDMARKS.items()])
    for robot in (1, 2):
        _write_robot(folder, robot)
    return folder.parent


def _write_robot(folder: Path, robot: int) -> None:
    rng = np.random.default_rng(robot)
    step = 0.02
    stamp = START_S + step * np.arange(int(DURATION_S / step))
    forward = 0.25 + 0.05 * np.sin(stamp / 5.0)
    turn = (0.16 if robot == 1 else -0.14) * (1.0 + 0.6 * np.sin(stamp / 3.0))
    pose = np.zeros((len(stamp), 3))
    pose[0] = (1.0, -0.5, 0.4) if robot == 1 else (-1.0, 1.0, 1.0)
    moves = se2.exp(step * np.column_stack([forward, np.zeros_like(forward), turn]))
    for k in range(1, len(stamp)):
        pose[k] = se2.compose(pose[k - 1], moves[k - 1])
    _write(folder / f"Robot{robot}_Groundtruth.dat", np.column_stack([stamp, pose]))

    noisy = [1.03 * forward + 0.08 * rng.normal(size=len(stamp)), 1.05 * turn + 0.12 * rng.normal(size=len(stamp))]
    _write(folder / f"Robot{robot}_Odometry.dat", np.column_stack([stamp, *noisy]))

    rows = []
    for k in range(10, len(stamp) - 10, 13):
        blind_from, blind_to = BLIND_S[robot]
        if blind_from < stamp[k] < blind_to:
            continue
        for subject, at in LANDMARKS.items():
            x, y = se2.transform(se2.inverse(pose[k]), np.array(at))
            distance, bearing = np.hypot(x, y), np.arctan2(y, x)
            if distance < 7.0 and abs(bearing) < 0.6:
                noise = rng.normal(size=2) * [0.02, 0.005]
                rows.append((stamp[k], BARCODE[subject], distance + noise[0], bearing + noise[1]))
    _write(folder / f"Robot{robot}_Measurement.dat", rows)


def _write(path: Path, rows: Iterable[Iterable[float]]) -> None:
    """Stamps to the microsecond, everything else to nine digits; Windows line ends, as the real files have."""
    lines = (" \t ".join(f"{value:.9g}" if abs(value) < 900 else f"{value:.6f}" for value in row) for row in rows)
    path.write_text("# made up\r\n" + "".join(f"{line}\r\n" for line in lines))
