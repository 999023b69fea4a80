"""Label files of KITTI tracking: boxes by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from evermap_score.episodes import Episodes, episodes_from_rows
from evermap_score.errors import ScoreError

FRAME_S = 0.1


def read_kitti(path: str | Path) -> Episodes:
    """Read a label or result file, 17 or 18 values a line: an episode of a tenth of a second for each box.

    Values are frame, track, type, truncated, occluded, alpha, four of the image, height, width, length, x, y, z in the
    camera's axes, yaw, and of results a score. Places are x ahead, y left, z up *of the camera in that frame*: they are
    those of a map only where the camera stands still. So identity, presence and GOSPA are meaningful, changes are not.
    A score that is a probability is `p`. Rows of type DontCare are left out.

    Raises:
        ScoreError: the file is missing, or a line is not such a one.
    """
    rows: list[dict[str, Any]] = []
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        raise ScoreError("cannot be read", path=path) from None
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words:
            continue
        try:
            if len(words) not in (17, 18):
                raise ValueError
            frame = int(words[0])
            height, width, length, x, y, z = map(float, words[10:16])
            score = float(words[17]) if len(words) == 18 else 1.0
        except ValueError:
            raise ScoreError("not a label of KITTI tracking", path=path, line=number) from None
        if words[2] != "DontCare":
            rows.append({
                "landmark_id": words[1], "class_id": words[2],
                "t_from_s": FRAME_S * frame, "t_to_s": FRAME_S * (frame + 1),
                "x_m": z, "y_m": -x, "z_m": 0.5 * height - y,  # KITTI's place is the middle of the box's floor
                "length_m": length, "width_m": width, "height_m": height,
                "p": score if 0.0 <= score <= 1.0 else None,
            })  # fmt: skip
    return episodes_from_rows(rows, path)
