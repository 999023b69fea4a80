"""What a map learns of how long parked cars stay from one drive down a street: KITTI's tracking sequences.

Each sequence begins a map of its own with the defaults, also where its verdict would keep it out of one. Listed are
stays, which of them ended in view and what the labels say of these, and how probably what stands at the end of the
drive is there an hour later. No recording is an hour long: of that there is no truth, only of the ends in view.

    python -m benchmarks.kitti_stays ../shared/data/kitti_tracking                     # goes on where it was ended
    python -m benchmarks.kitti_stays ../shared/data/kitti_tracking --only 0011 --out out/kitti-stays
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kitti import Table, read
from benchmarks.kitti_slam import MOVES_MPS
from evermap.config import Config, with_overrides
from evermap.geometry import se3
from evermap.io import read_recording
from evermap.maps.living import EXISTS, LivingMap
from evermap.maps.sessions.session import Session
from evermap.pipeline import run_session
from evermap.slam.space.moving import has_traffic
from evermap.types import FloatArray, SpatialRecording
from evermap_studies.markdown import markdown_table, number
from evermap_studies.rows import RowsFile, commit_of_code, sources

Row = dict[str, Any]

CAR = "Car"
HOUR_S = 3600.0
LEAST_P = 0.9
"""What a parked car is to be believed to be there with, an hour later."""
STUDIED = "0011"
NEAR_M, ABOUT_S, OFF_M = 2.0, 1.0, 1.0
"""A label is of a stay if it was this near when it was seen last, and has left if it is this far off later."""
STANDS_S, DRIVES_M = 2.0, 2.0
"""A labelled car stood in view if it was slow for so long, and drove if it came so far."""


class Labelled:
    """Labelled tracks in the world of the odometry.

    Args:
        recording: with odometry.
        labels: as read.
        range_scale: by which ranges are longer in the odometry's metre.
    """

    def __init__(self, recording: SpatialRecording, labels: Table, range_scale: float) -> None:
        assert recording.odometry is not None
        own = labels.columns["track_id"] >= 0
        self.stamp_s, self.track = labels.columns["stamp_s"][own], labels.columns["track_id"][own]
        self.is_car = labels.names[own] == CAR
        at = np.stack([labels.columns[name][own] for name in ("x_m", "y_m", "z_m")], axis=1)
        pose = se3.interpolate(recording.odometry.stamp_s, recording.odometry.pose_world_robot, self.stamp_s)
        self.world_m: FloatArray = se3.transform(pose, range_scale * at)[:, :2]

    def fate_of(self, place_m: FloatArray, last_s: float) -> str:
        """Return what became of that which stood at a place (2,) until it was seen last: 'drove off', 'stands' or
        'no label'.
        """
        then = np.abs(self.stamp_s - last_s) <= ABOUT_S
        away_m = np.where(then, np.linalg.norm(self.world_m - place_m, axis=1), np.inf)
        row = int(np.argmin(away_m)) if len(away_m) else -1
        if row < 0 or away_m[row] > NEAR_M:
            return "no label"
        later = (self.track == self.track[row]) & (self.stamp_s > last_s)
        off_m = np.linalg.norm(self.world_m[later] - self.world_m[row], axis=1)
        return "drove off" if len(off_m) and off_m[-1] > OFF_M else "stands"

    def count_stood_and_drove(self) -> tuple[int, int]:
        """Return of how many cars the labels say that they stood all the time, and that they stood and drove."""
        stood = both = 0
        for one in np.unique(self.track[self.is_car]):
            mine = np.flatnonzero(self.track == one)
            stamp_s, at = self.stamp_s[mine], self.world_m[mine]
            if stamp_s[-1] - stamp_s[0] < STANDS_S:
                continue
            before = np.searchsorted(stamp_s, stamp_s - STANDS_S, side="right") - 1
            whole = before >= 0
            way_m = np.linalg.norm(at[whole] - at[before[whole]], axis=1)
            slow = way_m <= MOVES_MPS * STANDS_S
            drove = np.linalg.norm(at - at[0], axis=1).max() > DRIVES_M and not slow.all()
            stood, both = stood + int(slow.all()), both + int(slow.any() and drove)
        return stood, both


def stays_of(session: Session, labels: Labelled) -> Row:
    """Return what a session says of stays of its classes, of those that ended, and of an hour later."""
    living = session.living
    names, stays = living.class_names, living.stays
    there = living.landmarks(p_least=EXISTS)
    later = _p_later(living, there.landmark_id)
    of_cars = np.array([0 <= row < len(names) and names[row] == CAR for row in there.class_id], dtype=bool)
    ended = [
        {
            "landmark": _label_of(living, int(stays.clique_id[row])),
            "class": names[int(stays.class_id[row])],
            "from_s": float(stays.first_s[row]),
            "last_s": float(stays.last_s[row]),
            "gone_s": float(stays.gone_s[row]),
            "p": float(stays.p_gone[row]),
            "labels": labels.fate_of(stays.position_m[row, :2], float(stays.last_s[row])),
        }
        for row in np.flatnonzero(np.isfinite(stays.gone_s))
    ]
    verdict = session.slam.verdict
    return {
        "verdict": None if verdict is None else str(verdict.kind),
        "stays": len(stays),
        "stays_of_cars": int(sum(names[int(one)] == CAR for one in stays.class_id)),
        "ended": ended,
        "cars_there": int(of_cars.sum()),
        "p_hour": float(later[of_cars].mean()) if of_cars.any() else None,
        "p_hour_least": float(later[of_cars].min()) if of_cars.any() else None,
        "labelled_stood": labels.count_stood_and_drove()[0],
        "labelled_stood_and_drove": labels.count_stood_and_drove()[1],
    }


def _p_later(living: LivingMap, landmark_id: FloatArray) -> FloatArray:
    """(L,) probability of landmarks to be there an hour later, by what is learned."""
    row = np.searchsorted(living.members.landmark_id, landmark_id)
    return np.asarray(living.p_exists(living.stamp_s + HOUR_S)[row], dtype=np.float64)


def _label_of(living: LivingMap, clique_id: int) -> str:
    members = living.members.landmark_id[living.members.clique_id == clique_id]
    return living.label(int(members[0])) if len(members) else f"clique {clique_id}"


def run(folder: Path, file: RowsFile, overrides: Sequence[str] = (), only: Sequence[str] = ()) -> list[Row]:
    """Return a row a sequence; those in the file are not run again."""
    rows = file.read()
    for place in sorted(folder.glob("[0-9]*")):
        if (only and place.name not in only) or place.name in {row["sequence"] for row in rows}:
            continue
        recording = read_recording(place)
        assert isinstance(recording, SpatialRecording)
        began, row = time.process_time(), {"sequence": place.name, "commit": commit_of_code()}
        if has_traffic(recording):
            session = run_session(recording, None, with_overrides(Config(), overrides))
            found = {one.name: one.value for one in session.slam.parameters}
            labels = Labelled(recording, read(place / "labels.csv.gz"), found.get("range_scale", 1.0))
            row |= stays_of(session, labels)
        rows.append(row | {"cpu_s": time.process_time() - began})
        file.add(rows[-1])
    return sorted(rows, key=lambda row: str(row["sequence"]))


def claims(rows: Sequence[Row]) -> list[tuple[str, str, str, str]]:
    """Return what was expected: name, expectation, what was measured, whether that is met."""
    lines = []
    for row in rows:
        if row["sequence"] == STUDIED:
            met = row["p_hour_least"] is not None and row["p_hour_least"] >= LEAST_P
            lines.append((f"{STUDIED}: a parked car is there an hour later, least P", f"≥ {LEAST_P}",
                          number("{:.3f}", row["p_hour_least"]), "yes" if met else "**no**"))  # fmt: skip
    known = [row["p_hour_least"] for row in rows if row.get("p_hour_least") is not None]
    if len(known) > 1:
        met = min(known) >= LEAST_P
        lines.append((f"the {len(known)} sequences with cars in their map: the same, least P", f"≥ {LEAST_P}",
                      f"{min(known):.3f}", "yes" if met else "**no**"))  # fmt: skip
    ended = [one for row in rows for one in row.get("ended", [])]
    judged = [one for one in ended if one["labels"] != "no label"]
    if judged:
        right = sum(one["labels"] == "drove off" for one in judged)
        met_all = "yes" if right == len(judged) else "**no**"
        lines.append(("ends of stays with a label: it drove off", f"{len(judged)} of {len(judged)}",
                      f"{right} of {len(judged)}", met_all))  # fmt: skip
    return lines


def as_markdown(rows: Sequence[Row]) -> str:
    """Write claims, a row a sequence, and a row for each stay that ended."""
    mapped = [row for row in rows if "stays" in row]
    lines = [
        (
            row["sequence"], row["verdict"] or "–", f"{row['stays']} ({row['stays_of_cars']})", str(len(row["ended"])),
            str(row["cars_there"]), number("{:.3f}", row["p_hour"]), number("{:.3f}", row["p_hour_least"]),
            str(row["labelled_stood"]), str(row["labelled_stood_and_drove"]), f"{row['cpu_s']:.1f}",
        )
        for row in mapped
    ]  # fmt: skip
    head = ("sequence", "verdict", "stays (of cars)", "ended", "cars there at the end",
            "P(car an hour later), mean", "least", "labelled cars: stood", "stood and drove", "CPU [s]")  # fmt: skip
    ends = [
        (row["sequence"], one["landmark"], one["class"], f"{one['from_s']:.1f} to {one['last_s']:.1f}",
         f"{one['gone_s']:.1f}", f"{one['p']:.3f}", one["labels"])
        for row in mapped for one in row["ended"]
    ]  # fmt: skip
    end_head = ("sequence", "stay that ended", "class", "seen [s]", "gone at [s]", "p", "by the labels it")
    parts = [markdown_table(("", "expected", "measured", "met"), claims(rows)), sources(list(rows))]
    parts.append(markdown_table(head, lines, words=(0, 1)))
    if ends:
        parts.append(markdown_table(end_head, ends, words=(0, 1, 2, 6)))
    return "\n\n".join(part for part in parts if part)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line, with its arguments if none are given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with a folder for each sequence")
    parser.add_argument("--only", action="append", default=[], help="a sequence; repeatable")
    parser.add_argument("--out", type=Path, default=Path("evermap-out/kitti-stays"), help="folder for the table")
    parser.add_argument("--set", action="append", default=[], dest="overrides", help="setting, as of `evermap slam`")
    chosen = parser.parse_args(arguments)
    file = RowsFile.beside(chosen.out)
    rows = run(chosen.folder, file, chosen.overrides, chosen.only)
    text = as_markdown(rows)
    chosen.out.mkdir(parents=True, exist_ok=True)
    (chosen.out / "table.md").write_text(text + "\n", encoding="utf-8")
    (chosen.out / "summary.json").write_text(json.dumps({"commit": commit_of_code(), "rows": rows}), encoding="utf-8")
    file.remove()
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
