"""Boxes of a driving car followed, beside AB3DMOT: KITTI's tracking sequences with the boxes of PointRCNN.

`evermap bench --only kitti` scores both by class (see `kitti_score`) with the same poses. evermap follows all classes
at once with its defaults; what counts is what it says at once, frame by frame.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from benchmarks import kitti_score, kitti_slam
from benchmarks.ab3dmot import CLASSES, Ab3dmot
from benchmarks.kitti_score import LEAST_PX, MOST_OCCLUDED, MOST_TRUNCATED, Judged
from benchmarks.overlap import overlap
from evermap.config import TrackConfig
from evermap.errors import InputError
from evermap.tracking.detections import read_input
from evermap.tracking.run import run_track, warm_up
from evermap.tracking.tracklets import TrackState
from evermap.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "kitti_tracking"
NEIGHBOURS = {"Car": ("Van",), "Pedestrian": ("Person_sitting", "Person"), "Cyclist": ()}
WIDTH_PX, HEIGHT_PX = 1242.0, 375.0
FRAME_S = 0.1
BOX = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


class Table(NamedTuple):
    """Columns of a table by name, F frames at `stamp_s`."""

    columns: dict[str, FloatArray]
    names: IntArray

    def rows(self, name: str) -> IntArray:
        """Rows of a class."""
        return np.flatnonzero(self.names == name)

    def box(self, rows: IntArray) -> FloatArray:
        """(K, 7)."""
        return np.stack([self.columns[name][rows] for name in BOX], axis=1)


class Drive(NamedTuple):
    """A sequence: F frames at `stamp_s` with poses (F, 7) of the sensor in the world."""

    name: str
    stamp_s: FloatArray
    pose: FloatArray
    detections: Table
    labels: Table
    camera: FloatArray


class Answer(NamedTuple):
    """Tracks of one class in a drive, R rows.

    Attributes:
        frame: (R,); track: (R,) ids.
        box: (R, 7) in the world.
        score: (R,); certain: (R,) whether a row belongs to the one answer that is asked for.
    """

    frame: IntArray
    track: IntArray
    box: FloatArray
    score: FloatArray
    certain: BoolArray


NOTHING = Answer(*(np.zeros(0, dtype=np.int64),) * 2, np.zeros((0, 7)), np.zeros(0), np.zeros(0, dtype=np.bool_))

LOST = {
    "samota_lost": ("swept", "sAMOTA"),
    "mota_lost": ("at_once", "MOTA"),
    "hota_lost": ("at_once", "HOTA"),
    "idf1_lost": ("at_once", "IDF1"),
}
METRICS: dict[str, tuple[str, float, str]] = {
    **{
        f"kitti_{name.lower()}_{what}": ("lower", 0.02, f"100 (1 - {key}) of KITTI's boxes of class {name}, {when}")
        for name in CLASSES
        for what, (when, key) in LOST.items()
    },
    "kitti_speed_ratio": ("higher", 0.35, "frames a second of boxes followed, over AB3DMOT"),
}
"""Metric: which direction is better, relative tolerance, meaning."""


def read(path: Path) -> Table:
    from pyarrow import csv

    table = csv.read_csv(path)
    names = table["class_id"].to_numpy(zero_copy_only=False) if "class_id" in table.column_names else np.zeros(0)
    columns = {n: table[n].to_numpy().astype(np.float64) for n in table.column_names if n != "class_id"}
    return Table(columns, names)


def drive(folder: Path) -> Drive:
    odometry = read(folder / "odometry.csv.gz").columns
    detections = read(folder / "detections.csv.gz")
    return Drive(
        folder.name, odometry["stamp_s"], np.stack([odometry[n] for n in POSE], axis=1), detections,
        read(folder / "labels.csv.gz"), camera_of(detections),
    )  # fmt: skip


def frames_of(stamp_s: FloatArray, at: FloatArray) -> IntArray:
    """The frame of each stamp: both tables have the same ones."""
    return np.searchsorted(at, stamp_s - 0.5 * FRAME_S).astype(np.int64)


def from_camera(box: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(K, 8) rays left and down of the corners of boxes in the sensor's frame, and their distance ahead."""
    signs = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)])
    local = signs[None] * box[:, None, 3:6]
    c, s = np.cos(box[:, 6:]), np.sin(box[:, 6:])
    ahead = box[:, :1] + c * local[..., 0] - s * local[..., 1]
    left = box[:, 1:2] + s * local[..., 0] + c * local[..., 1]
    up = box[:, 2:3] + local[..., 2]
    depth = np.maximum(ahead, 0.1)
    return np.stack([-left / depth, -up / depth, 1.0 / depth], axis=-1), ahead


def camera_of(detections: Table) -> FloatArray:
    """(2, 3) focal length, centre and baseline of the image's axes, from boxes in space and in the image."""
    c = detections.columns
    inside = (c["left_px"] > 5) & (c["right_px"] < 1220) & (c["top_px"] > 5) & (c["bottom_px"] < 365) & (c["x_m"] > 8)
    ray, _ = from_camera(detections.box(np.flatnonzero(inside)))
    found = []
    for axis, sides in enumerate((("left_px", "right_px"), ("top_px", "bottom_px"))):
        ends = [ray[..., axis].argmin(axis=1), ray[..., axis].argmax(axis=1)]
        k = np.arange(len(ray))
        known = np.concatenate([np.c_[ray[k, e, axis], np.ones(len(k)), ray[k, e, 2]] for e in ends])
        seen = np.concatenate([c[name][inside] for name in sides])
        weight = np.ones(len(seen))
        for _ in range(20):
            fit = np.linalg.lstsq(known * weight[:, None], seen * weight, rcond=None)[0]
            weight = 1.0 / np.sqrt(1.0 + (known @ fit - seen) ** 2)
        found.append(fit)
    return np.array(found)


def in_image(box: FloatArray, camera: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Whether the centre of what is seen of boxes (K, 7) is in the image, and how high it is there [px]."""
    ray, ahead = from_camera(box)
    u = camera[0, 0] * ray[..., 0] + camera[0, 1] + camera[0, 2] * ray[..., 2]
    v = camera[1, 0] * ray[..., 1] + camera[1, 1] + camera[1, 2] * ray[..., 2]
    middle = 0.5 * (u.min(axis=1) + u.max(axis=1))
    top, bottom = np.clip(v.min(axis=1), 0.0, HEIGHT_PX), np.clip(v.max(axis=1), 0.0, HEIGHT_PX)
    return (ahead.min(axis=1) > 0.0) & (middle > 0.0) & (middle < WIDTH_PX) & (bottom > top), bottom - top


def to_world(pose: FloatArray, box: FloatArray) -> FloatArray:
    """Boxes (K, 7) seen from poses (K, 7), in the world: upright, as the peer takes them."""
    yaw = np.arctan2(*_ahead(pose)[:, 1::-1].T)
    centre = _rotated(pose, box[:, :3]) + pose[:, :3]
    return np.column_stack([centre, box[:, 3:6], box[:, 6] + yaw])


def to_sensor(pose: FloatArray, box: FloatArray) -> FloatArray:
    """The way back."""
    yaw = np.arctan2(*_ahead(pose)[:, 1::-1].T)
    back = np.column_stack([pose[:, :3], -pose[:, 3:6], pose[:, 6]])
    return np.column_stack([_rotated(back, box[:, :3] - pose[:, :3]), box[:, 3:6], box[:, 6] - yaw])


def _rotated(pose: FloatArray, vectors: FloatArray) -> FloatArray:
    axis, w = pose[:, 3:6], pose[:, 6:]
    twice = 2.0 * np.cross(axis, vectors)
    return vectors + w * twice + np.cross(axis, twice)


def _ahead(pose: FloatArray) -> FloatArray:
    return _rotated(pose, np.tile([1.0, 0.0, 0.0], (len(pose), 1)))


def judged(one: Drive, answer: Answer, name: str) -> tuple[list[Judged], dict[int, float]]:
    """Labels and tracks of a class, frame by frame; and the mean score of every track."""
    labels = one.labels
    rows = np.flatnonzero(np.isin(labels.names, (name, *NEIGHBOURS[name])))
    c = labels.columns
    counts = (labels.names == name) & (c["occluded"] <= MOST_OCCLUDED) & (c["truncated"] <= MOST_TRUNCATED)
    label_frame = frames_of(c["stamp_s"], one.stamp_s)
    found = to_sensor(one.pose[answer.frame], answer.box)
    seen, high_px = in_image(found, one.camera)
    excused = ~seen | (high_px <= LEAST_PX)
    frames = []
    for k in range(len(one.stamp_s)):
        mine, theirs = rows[label_frame[rows] == k], np.flatnonzero(answer.frame == k)
        frames.append(
            Judged(
                c["track_id"][mine].astype(np.int64), counts[mine], answer.track[theirs], excused[theirs],
                overlap(labels.box(mine), np.ascontiguousarray(found[theirs])),
            )
        )  # fmt: skip
    ids, of = np.unique(answer.track, return_inverse=True)
    mean = np.bincount(of, answer.score) / np.maximum(np.bincount(of), 1) if len(ids) else np.zeros(0)
    return frames, dict(zip(ids.tolist(), mean.tolist(), strict=True))


def certain(frames: list[Judged], answer: Answer) -> list[Judged]:
    """The one answer that is asked for."""
    sure: dict[int, set[int]] = {}
    for k, i in zip(answer.frame[answer.certain].tolist(), answer.track[answer.certain].tolist(), strict=True):
        sure.setdefault(k, set()).add(i)
    found = []
    for k, f in enumerate(frames):
        kept = np.array([i in sure.get(k, ()) for i in f.track.tolist()], dtype=np.bool_)
        found.append(f._replace(track=f.track[kept], excused=f.excused[kept], overlap=f.overlap[:, kept]))
    return found


def score(drives: list[Drive], answers: list[Answer], name: str) -> dict[str, dict[str, Any]]:
    """All scores of a class: of whole tracks at the best threshold (`swept`), and of what is said at once."""
    pairs = [judged(one, answer, name) for one, answer in zip(drives, answers, strict=True)]
    sequences, mean = [frames for frames, _ in pairs], [m for _, m in pairs]
    swept = kitti_score.swept(sequences, mean)
    best = [
        answer._replace(certain=np.array([m[i] >= swept["threshold"] for i in answer.track.tolist()], dtype=np.bool_))
        for answer, m in zip(answers, mean, strict=True)
    ]
    found = {}
    for when, chosen in (("swept", best), ("at_once", answers)):
        sure = [certain(frames, answer) for frames, answer in zip(sequences, chosen, strict=True)]
        counts = kitti_score.told(kitti_score.clear(sure, [dict.fromkeys(m, 0.0) for m in mean], -1.0))
        found[when] = counts | kitti_score.identities(sure)
    found["swept"] |= swept
    return found


def by_evermap(folder: Path, one: Drive) -> tuple[dict[str, Answer], float]:
    """evermap on all classes at once as `evermap track` runs, with its defaults; and its CPU time [s]."""
    table = read_input(folder)
    began = time.process_time()
    result = run_track(table, TrackConfig())
    cpu_s = time.process_time() - began
    tracks = result.tracks
    box = np.column_stack([tracks.position_m, tracks.box])
    p = np.clip(tracks.p_exists, 1e-12, 1.0 - 1e-12)
    log_odds, sure = np.log(p / (1.0 - p)), (tracks.state != TrackState.BIRTH) & (p >= 0.5)
    frame, class_id = frames_of(tracks.stamp_s, one.stamp_s), tracks.class_p.argmax(axis=1)
    answers = {}
    for k, name in enumerate(table.class_names):
        of = class_id == k
        answers[name] = Answer(frame[of], tracks.track_id[of], box[of], log_odds[of], sure[of])
    return answers, cpu_s


def by_ab3dmot(one: Drive, name: str) -> tuple[Answer, float]:
    """The peer on one class, and its CPU time [s]; at once a track counts by the mean of its scores so far."""
    rows = one.detections.rows(name)
    frame = frames_of(one.detections.columns["stamp_s"][rows], one.stamp_s)
    began = time.process_time()
    box = to_world(one.pose[frame], one.detections.box(rows))
    tracker, found = Ab3dmot(CLASSES[name]), []
    for k in range(len(one.stamp_s)):
        mine = frame == k
        ids, boxes, scores = tracker.step(box[mine], one.detections.columns["score"][rows[mine]])
        found.append((np.full(len(ids), k), ids, boxes, scores))
    cpu_s = time.process_time() - began
    frames, track, boxes, scores = (np.concatenate(column) for column in zip(*found, strict=True))
    sure = np.zeros(len(frames), dtype=np.bool_)
    for i in np.unique(track):
        of = np.flatnonzero(track == i)
        so_far = np.cumsum(scores[of]) / np.arange(1, len(of) + 1)
        sure[of] = so_far >= CLASSES[name].least_score
    return Answer(frames, track, boxes, scores, sure), cpu_s


def run(folder: Path = FOLDER, only: Sequence[str] | None = None) -> tuple[dict[str, float], dict[str, Any]]:
    """Follow and score all sequences, or some.

    Raises:
        InputError: the recordings are not there.
    """
    places = [place for place in sorted(folder.glob("[0-9]*")) if only is None or place.name in only]
    if not places:
        raise InputError("has no sequences", path=folder, hint="KITTI's tracking sequences, one folder each")
    warm_up()
    drives = [drive(place) for place in places]
    ours = [by_evermap(place, one) for place, one in zip(places, drives, strict=True)]
    shown: dict[str, Any] = {"sequences": [place.name for place in places], "classes": {}}
    cpu_s = {"evermap": sum(spent for _, spent in ours), "AB3DMOT": 0.0}
    ratios = {}
    for name in CLASSES:
        peers = [by_ab3dmot(one, name) for one in drives]
        cpu_s["AB3DMOT"] += sum(spent for _, spent in peers)
        answers = {"evermap": [found.get(name, NOTHING) for found, _ in ours], "AB3DMOT": [found for found, _ in peers]}
        rows = {who: score(drives, found, name) for who, found in answers.items()}
        shown["classes"][name] = rows
        for what, (when, key) in LOST.items():
            ratios[f"kitti_{name.lower()}_{what}"] = 100.0 * (1.0 - rows["evermap"][when][key])
    n_frames = sum(len(one.stamp_s) for one in drives)
    shown["ms_a_frame"] = {who: 1e3 * spent / n_frames for who, spent in cpu_s.items()}
    shown["slam"] = kitti_slam.run(folder, read, only)
    ratios["kitti_speed_ratio"] = cpu_s["AB3DMOT"] / cpu_s["evermap"]
    return ratios, shown


def claims(shown: dict[str, Any]) -> list[str]:
    """What was expected: to be ahead of the peer in every class, without an identity switch, in 5 ms a frame."""
    leads = [
        rows["evermap"][when][key] - rows["AB3DMOT"][when][key]
        for rows in shown["classes"].values()
        for when in ("swept", "at_once")
        for key in ("MOTA", "IDF1", "HOTA")
    ]
    switches = sum(rows["evermap"]["swept"]["IDS"] for rows in shown["classes"].values())
    spent = shown["ms_a_frame"]["evermap"]
    return [
        "|  | expected | measured | met |",
        "| --- | ---: | ---: | ---: |",
        f"| least lead over AB3DMOT in MOTA, IDF1 and HOTA | ≥ 0 | {min(leads):.4f} | {_met(min(leads) >= 0.0)} |",
        f"| identity switches of cars, pedestrians, cyclists | ≤ 0 | {switches} | {_met(switches == 0)} |",
        f"| CPU time of a frame [ms] | ≤ 5 | {spent:.2f} | {_met(spent <= 5.0)} |",
    ]


def _met(fine: bool) -> str:
    return "yes" if fine else "**no**"


def figure(shown: dict[str, Any]) -> Figure:
    """MOTA over recall, a panel for each class."""
    from matplotlib.figure import Figure

    from evermap.viz.style import ESTIMATE, ODOMETRY

    drawn = Figure(figsize=(9.0, 3.0), layout="constrained")
    panels = drawn.subplots(1, len(shown["classes"]), sharex=True, squeeze=False)[0]
    for axes, (name, rows) in zip(panels, shown["classes"].items(), strict=True):
        for who, colour in (("evermap", ESTIMATE), ("AB3DMOT", ODOMETRY)):
            axes.plot(*np.array(rows[who]["swept"]["curve"]).reshape(-1, 2).T, color=colour, label=who)
        axes.set(title=name, xlabel="recall", xlim=(0.0, 1.0), ylim=(-0.2, 0.9))
        axes.grid(alpha=0.3)
    drawn.axes[0].set_ylabel("MOTA")
    drawn.axes[0].legend(frameon=False)
    return drawn


def write(shown: dict[str, Any], folder: Path) -> None:
    """Write `table.md` and `kitti.png` into a folder, from which `docs/gen/results.py` takes them."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "table.md").write_text("\n".join(claims(shown)) + "\n\n" + as_markdown(shown) + "\n", encoding="utf-8")
    figure(shown).savefig(folder / "kitti.png", dpi=150)


def as_markdown(shown: dict[str, Any]) -> str:
    """A row for each class and tracker, and the time of a frame."""
    swept = ("sAMOTA", "AMOTA", "AMOTP", "MOTA", "MOTP", "IDS", "FRAG", "HOTA", "IDF1")
    at_once = ("MOTA", "IDS", "HOTA", "IDF1")
    lines = [
        f"| class | tracker | {' | '.join(swept)} | at once: {' | '.join(at_once)} |",
        f"|---|---|{'---:|' * (len(swept) + len(at_once))}",
    ]
    for name, rows in shown["classes"].items():
        for who, row in rows.items():
            cells = [row["swept"][key] for key in swept] + [row["at_once"][key] for key in at_once]
            text = " | ".join(f"{v:.0f}" if isinstance(v, int) else f"{v:.4f}" for v in cells)
            lines.append(f"| {name} | {who} | {text} |")
    took = ", ".join(f"{who} {ms:.2f} ms" for who, ms in shown["ms_a_frame"].items())
    lines += ["", f"CPU time of a frame, all classes: {took}."]
    lines += ["", "| SLAM among traffic | asked for | reached | met |", "| --- | ---: | ---: | ---: |"]
    lines += [
        f"| {name} | {asked} | {reached} | {_met(fine)} |"
        for name, asked, reached, fine in kitti_slam.claims(shown["slam"])
    ]
    return "\n".join([*lines, "", kitti_slam.as_markdown(shown["slam"])])
