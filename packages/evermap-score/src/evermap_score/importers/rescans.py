"""`3RScan.json`: rooms that were scanned again (Wald et al., RIO, ICCV 2019)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from evermap_score.episodes import Episodes, FloatArray, episodes_from_rows
from evermap_score.errors import ScoreError


def read_rescans(path: str | Path) -> Episodes:
    """Read the scenes of which `SCAN/semseg.v2.json` of the reference scan is beside the file.

    Scan k of a scene is the interval from k to k + 1 s: the file has no times; 0 is the reference. An instance is where
    the centroid of its box is; one that moved rigidly is taken to the rescan by its transform, and back into the frame
    of the reference by that of the scan (both in columns, metres). Instances that changed their shape are left out.
    A landmark is called SCENE/INSTANCE.

    Raises:
        ScoreError: it is not such a file, moves are withheld (the test split), or no scene has its `semseg.v2.json`.
    """
    path = Path(path)
    try:
        scenes = json.loads(path.read_text(encoding="utf-8"))
        rows = []
        for scene in scenes:
            boxes = path.parent / scene["reference"] / "semseg.v2.json"
            if boxes.is_file():
                groups = json.loads(boxes.read_text(encoding="utf-8"))["segGroups"]
                rows += _scene_rows(scene, groups)
    except OSError as error:
        raise ScoreError(f"cannot be read: {error.strerror}", path=path) from None
    except (ValueError, KeyError, TypeError, IndexError):
        raise ScoreError("not 3RScan.json, or its moves are withheld", path=path) from None
    if not rows:
        raise ScoreError("no scene has its boxes", path=path, hint="SCAN/semseg.v2.json of reference scans beside it")
    return episodes_from_rows(rows, path)


def _matrix(values: list[float]) -> FloatArray:
    return np.array(values, dtype=np.float64).reshape(4, 4).T  # they are listed by columns


def _scene_rows(scene: dict[str, Any], groups: list[dict[str, Any]]) -> list[dict[str, Any]]:
    scans = scene["scans"]
    bent = {int(each) for scan in scans for each in scan.get("nonrigid", [])}
    rows = []
    for group in groups:
        instance = int(group["objectId"])
        if instance in bent:
            continue
        start = np.array([*group["obb"]["centroid"], 1.0])
        spells: list[tuple[FloatArray, int, int]] = [(start[:3], 0, 1)]
        for k, scan in enumerate(scans, start=1):
            if instance in {int(each) for each in scan.get("removed", [])}:
                continue
            place = start[:3]
            for move in scan.get("rigid", []):
                if int(move["instance_reference"]) == instance:
                    place = (_matrix(scan["transform"]) @ _matrix(move["transform"]) @ start)[:3]
            last = spells[-1]
            if last[2] == k and np.allclose(last[0], place):
                spells[-1] = (last[0], last[1], k + 1)
            else:
                spells.append((place, k, k + 1))
        for place, first, end in spells:
            rows.append({
                "landmark_id": f"{scene['reference']}/{instance}", "class_id": group.get("label"),
                "t_from_s": float(first), "t_to_s": None if end == len(scans) + 1 else float(end),
                **dict(zip(("x_m", "y_m", "z_m"), place.tolist(), strict=True)),
            })  # fmt: skip
    return rows
