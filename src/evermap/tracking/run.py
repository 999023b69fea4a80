"""A run of `evermap track`: frames through the tracker, then tracks, static spells and lifetimes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.config import TrackConfig
from evermap.errors import ConfigError, DataError, InputError
from evermap.existence.models import priors_of
from evermap.io.columns import TableSource
from evermap.io.text import counted, quote
from evermap.show import Shown, draw
from evermap.survival.base import LifetimePrior
from evermap.survival.censored import CensoredLifetimes, lifetimes_of_sightings
from evermap.survival.text import parse_prior
from evermap.tracking.detections import read_detections
from evermap.tracking.field_of_view import find_field_of_view
from evermap.tracking.frame import DetectionTable, p_real_of
from evermap.tracking.record import Event, Followed, Recorder, StaticSpells, Tracks
from evermap.tracking.standing import Stood, join_stood, standing
from evermap.tracking.state_file import State, read_state
from evermap.tracking.tracker import Tracker
from evermap.tracking.tracklets import EventKind, TrackState
from evermap.tracking.views import View
from evermap.types import DEFAULT_PRIOR, UNKNOWN, BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


FEW = 5
"""So many things by chance are no pattern."""
IS_THERE = 0.5
"""What is followed with at least this probability hides what is behind it."""


@dataclass(frozen=True, slots=True, repr=False)
class TrackResult(Shown):
    """Result of a tracking run.

    Attributes:
        table: the detections.
        config: the choices.
        tracks: one row an object and frame: of objects that were confirmed, sooner or later; where detections have
            scores of all that were followed, as long as they were at all likely (`p_dead`), as it was said at once.
        track_of_detection: (M,) the object that each detection is of, `UNKNOWN` for one never confirmed.
        events: all that happened, in order.
        spells: times at which objects were seen to rest for at least `rest_for_s`.
        lifetimes: samples of how long things stay, several rows a spell (see `survival.censored`); None where the
            beginning of no spell is bounded.
        spell_of_lifetime: (N,) the spell that each row of `lifetimes` belongs to.
        n_gaps: times without any look, between two frames.
        seconds: wall time of the tracker.
        warnings: remarks.
        p_static: (R,) of each row of `tracks` the probability that its object stood from first to last, nan where it
            was too short; None of points.
        stood: which boxes stood, by all of their detections (`tracking.standing`); None of points.
    """

    table: DetectionTable
    config: TrackConfig
    tracks: Tracks
    track_of_detection: IntArray
    events: tuple[Event, ...]
    spells: StaticSpells
    lifetimes: CensoredLifetimes | None
    spell_of_lifetime: IntArray
    n_gaps: int
    seconds: float
    warnings: tuple[str, ...]
    p_static: FloatArray | None = None
    stood: Stood | None = None

    def to_pandas(self) -> Any:
        """Return a data frame with a row an object and frame.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        frame = self.tracks.to_pandas()
        frame["class_id"] = np.array(self.table.class_names, dtype=object)[frame["class_id"]]
        return frame

    def plot(self) -> Figure:
        """Draw paths and places of rest from above, and when objects rested."""
        return draw("plot_track_run", self)

    def _facts(self) -> dict[str, Any]:
        return {
            "source": self.table.source,
            "frames": self.table.n_frames,
            "detections": len(self.table),
            "objects": len(self.first_rows()),
            "classes": self.table.class_names,
            "spells": len(self.spells),
            "warnings": self.warnings,
        }

    def objects(self) -> Tracks:
        """Return the rows of `tracks` that are of objects that were confirmed, sooner or later."""
        return self.tracks[self.confirmed]

    @property
    def confirmed(self) -> BoolArray:
        """Return (R,) which rows of `tracks` those are."""
        t = self.tracks
        return np.isin(t.track_id, t.track_id[t.state != TrackState.BIRTH])

    def speeds_mps(self) -> FloatArray:
        """Return (C,) the speed of each class above which it moves."""
        return np.array(_speeds(self.config, self.table.class_names))

    def first_rows(self) -> IntArray:
        """Return (T,) row of `objects()` at which each object begins."""
        return np.unique(self.objects().track_id, return_index=True)[1]

    def class_of_track(self) -> IntArray:
        """Return (T,) most probable class of each object in the end, in the order of their ids."""
        objects = self.objects()
        ends = np.append(self.first_rows()[1:], len(objects)) - 1
        return np.asarray(objects.class_p[ends].argmax(axis=1), dtype=np.int64)


def check_choices(config: TrackConfig, table: DetectionTable) -> None:
    """Raise a ConfigError, before anything takes long, for choices that need a sensor's pose where it is unknown."""
    if config.range_m is not None and table.sensor_m is None:
        hint = "columns sensor_x_m, sensor_y_m, sensor_z_m in the table"
        raise ConfigError("the position of the sensor is unknown", field="range_m", hint=hint)
    if config.fov_deg is not None and (config.range_m is None or table.sensor_yaw_rad is None):
        hint = "`range_m`, and a folder with poses in `odometry`"
        raise ConfigError("the field of view is unknown", field="fov_deg", hint=hint)


def run_track(
    detections: DetectionTable | TableSource,
    config: TrackConfig | None = None,
    *,
    confusion: FloatArray | None = None,
    tracker: Tracker | None = None,
    progress: Callable[[float, float], None] | None = None,
) -> TrackResult:
    """Track all frames of a table.

    Args:
        detections: of `read_detections`, or what that takes: a data frame, or a file.
        config: the choices.
        confusion: (C, C) `P(detected class | true class)`, a row a true class; equal mistakes where None.
        tracker: of `make_tracker`, which goes on where it was and is changed; a new one where None. The spells and
            lifetimes of the result are then those of all its tables.
        progress: told after every hundredth frame what is done, and how many there are.

    Raises:
        ConfigError: choices that do not fit the table.
        InputError: as of `read_detections`.
        DataError: nothing was seen often enough to be an object.
    """
    config = config or TrackConfig()
    table = detections
    if not isinstance(table, DetectionTable):
        table = read_detections(table, min_score=config.min_score)
    check_choices(config, table)
    if tracker is None:
        tracker = make_tracker(table, config, confusion=confusion)
    table = _with_classes(table, tracker.class_names)
    start = perf_counter()
    recorder, track_of_detection, n_gaps, seen, stood = _follow(tracker, table, config, progress)
    tracks = recorder.tracks() if table.score is None else recorder.at_once(config.p_dead)
    if not (tracks.state != TrackState.BIRTH).any():
        hint = f"fewer detections for confirmation: track.warm_up={max(1, config.warm_up - 1)}"
        if _usual_step_s(table) > config.slow_step_s:
            hint = f"more frames: it takes several in a row, and these are {_usual_step_s(table):g} s apart"
        raise DataError(
            "no object was seen often enough to be distinguished from false alarms",
            path=table.source or None,
            hint=hint,
        )
    real = tracks.track_id[tracks.state != TrackState.BIRTH]
    track_of_detection = np.where(np.isin(track_of_detection, real), track_of_detection, UNKNOWN)
    spells = tracker.static_spells()
    if stood is None:  # a slow object passes the test for rest again and again, but does not rest
        spells = spells[spells.last_s - spells.first_s >= config.rest_for_s]
    lifetimes, spell_of_lifetime = _lifetimes(spells, config.rest_for_s)
    objects = tracks[np.isin(tracks.track_id, real)]
    returns = _describe_returns(spells, objects, recorder.events, config.place_sigma_m)
    return TrackResult(
        table=table,
        config=config,
        tracks=tracks,
        track_of_detection=track_of_detection,
        events=tuple(recorder.events),
        spells=spells,
        lifetimes=lifetimes,
        spell_of_lifetime=spell_of_lifetime,
        n_gaps=n_gaps,
        seconds=perf_counter() - start,
        warnings=(*_remarks(table, config, spells), *seen, *returns),
        p_static=None if stood is None else np.array([stood.p_still.get(k, np.nan) for k in tracks.track_id.tolist()]),
        stood=stood,
    )


def _find_standing(
    tracker: Tracker,
    table: DetectionTable,
    frames: slice,
    track_of_detection: IntArray,
    events: Sequence[Event],
    config: TrackConfig,
) -> Stood:
    """Return which boxes (M,) of some frames stood by all of their detections, and correct the tracker by it.

    The tracker's own test needs seconds, since it sees no later detection: whoever drives past sees a parked car for
    less.
    """
    rows = slice(int(table.first[frames.start]), int(table.first[frames.stop]))
    frame = np.repeat(np.arange(table.n_frames), np.diff(table.first))[rows]
    stamp_s, position_m, class_id = table.stamp_s[frame], table.position_m[rows], table.class_id[rows]
    speeds, unknown = tracker.settings.class_speeds(len(tracker.class_names)), class_id == UNKNOWN
    limit = np.where(unknown, np.median(speeds), speeds[np.where(unknown, 0, class_id)])
    range_m = np.zeros(len(frame))
    if table.sensor_m is not None:
        range_m = np.linalg.norm(position_m - table.sensor_m[frame], axis=1)
    assert table.box is not None
    stood = standing(stamp_s, position_m, range_m, table.box[rows], track_of_detection, limit, config.still)
    mine = [np.flatnonzero(stood.stay == k) for k in range(len(stood.track))]
    classes = [class_id[one][class_id[one] != UNKNOWN] for one in mine]
    ends = np.array([stamp_s[one[[0, -1]]] for one in mine]).reshape(-1, 2)
    stays = StaticSpells(
        track_id=stood.track,
        class_id=np.array([np.bincount(one).argmax() if len(one) else 0 for one in classes], dtype=np.int64),
        position_m=np.array([np.median(position_m[one], axis=0) for one in mine]).reshape(-1, 3),
        elsewhere_s=np.where(np.isnan(stood.since_s), -np.inf, stood.since_s - config.still.when_s),
        first_s=ends[:, 0],
        last_s=ends[:, 1],
        gone_s=np.where(np.isnan(stood.until_s), find_misses(events, stood.track), stood.until_s + config.still.when_s),
    )
    tracker.confirm_rest(stays, float(table.stamp_s[frames.start]))
    return stood


def make_tracker(
    table: DetectionTable,
    config: TrackConfig | None = None,
    *,
    confusion: FloatArray | None = None,
    state: str | Path | None = None,
) -> Tracker:
    """Return the tracker of a table, new or as it was saved.

    Args:
        table: says which classes there are, and whether detections are boxes, have scores and appearances.
        config: as of `run_track`.
        confusion: as of `run_track`.
        state: file of `Tracker.save`, of an earlier day or another robot of the same world; a new tracker where None.

    Raises:
        ConfigError: choices that do not fit the table.
        InputError: no such file; a table before its end, or of detections of another kind.
    """
    config = config or TrackConfig()
    names, kind = table.class_names, _kind_of(table)
    saved = None if state is None else read_state(state)
    if saved is not None:
        _check_goes_on(table, saved)
        names = (*saved.class_names, *(name for name in names if name not in saved.class_names))
    settings = config.model_copy(update={"class_speed_mps": _speeds(config, names)})
    priors = _priors(config, names)
    if saved is not None:
        return Tracker.of_state(saved, settings, class_names=names, confusion=confusion, priors=priors)
    n_appearance, boxes, scored = kind
    return Tracker(
        settings, n_classes=len(names), confusion=confusion, n_appearance=n_appearance, boxes=boxes, scored=scored,
        priors=priors, class_names=names,
    )  # fmt: skip


def _check_goes_on(table: DetectionTable, saved: State) -> None:
    """Raise an InputError unless a tracker may go on with a table: of the same kind, after its last frame."""
    path, kind = table.source or None, _kind_of(table)
    if saved.kind != kind:
        problem = f"detections {_in_words(kind)}, and those of the state are {_in_words(saved.kind)}"
        raise InputError(problem, path=path, hint="another --state")
    if table.n_frames and table.stamp_s[0] <= saved.stamp_s:
        problem = f"begins at {table.stamp_s[0]:.3f} s, and the state ends at {saved.stamp_s:.3f} s"
        raise InputError(problem, path=path, hint="tables in the order of their stamps, one clock")


def _kind_of(table: DetectionTable) -> tuple[int, bool, bool]:
    """As `State.kind`, of a table."""
    return 0 if table.appearance is None else table.appearance.shape[1], table.box is not None, table.score is not None


def _in_words(kind: tuple[int, bool, bool]) -> str:
    n_appearance, boxes, scored = kind
    words = ["boxes" if boxes else "points", "with scores" if scored else "without scores"]
    return " ".join([*words, f"and appearances of {n_appearance} numbers"] if n_appearance else words)


def _with_classes(table: DetectionTable, names: tuple[str, ...]) -> DetectionTable:
    """The same detections of classes by other numbers: InputError for a class that is not among the names."""
    if table.class_names == names:
        return table
    if missing := [name for name in table.class_names if name not in names]:
        raise InputError(f"class {quote(missing[0])} is unknown to the tracker", path=table.source or None)
    into = np.array([names.index(name) for name in table.class_names], dtype=np.int64)
    class_id = np.where(table.class_id == UNKNOWN, UNKNOWN, into[table.class_id])
    return replace(table, class_names=names, class_id=class_id)


def _priors(config: TrackConfig, class_names: Sequence[str]) -> tuple[LifetimePrior, ...]:
    """Return how long objects of every class rest, from texts or files of models; errors as `priors_of`."""
    _check_classes(config.class_priors, class_names, "class_priors")
    found = {name: lives.stay for name, lives in priors_of(config.prior, config.class_priors).items()}
    rest = found.get("") or parse_prior(DEFAULT_PRIOR)  # a file may name some of the classes only
    return tuple(found.get(name) or rest for name in class_names)


def _speeds(config: TrackConfig, class_names: Sequence[str]) -> tuple[float, ...]:
    """Return the speed of every class above which it is dynamic [m/s]; ConfigError for one that no detection has."""
    _check_classes(config.speeds_mps, class_names, "speeds_mps")
    common = config.class_speeds(len(class_names)).tolist()
    return tuple(config.speeds_mps.get(name, speed) for name, speed in zip(class_names, common, strict=True))


def _check_classes(by_class: Mapping[str, object], class_names: Sequence[str], field: str) -> None:
    for name in by_class:
        if name not in class_names:
            hint = f"one of {', '.join(class_names)}" if any(class_names) else "a column class_id in the table"
            raise ConfigError(f"no detection is of class {quote(name)}", field=field, hint=hint)


def _follow(
    tracker: Tracker, table: DetectionTable, config: TrackConfig, progress: Callable[[float, float], None] | None
) -> tuple[Recorder, IntArray, int, list[str], Stood | None]:
    """Frame after frame; between them, where there was no look for long, blind ones. With remarks on what was seen, and
    with which boxes stood: judged before each such time, as if it were the end.
    """
    noise = table.covariance_m2
    if noise is not None:
        noise = np.where(np.isnan(noise), config.sigma_position_m**2 * np.eye(3), noise)
    step_s = _usual_step_s(table)
    gap_s = config.gap_s or config.gap_steps * step_s
    recorder, found, n_gaps, centre_m = Recorder(), np.full(len(table), UNKNOWN), 0, np.zeros(3)
    sees = None if config.range_m is None else find_field_of_view(table, config)
    p_real = None if table.score is None else p_real_of(table.score, config.score_midpoint, config.score_scale)
    begin, parts, earlier = 0, list[Stood](), tracker.n_objects
    followed: Followed | None = None

    def judge(end: int) -> None:
        if table.box is not None and end > begin:
            rows = slice(int(table.first[begin]), int(table.first[end]))
            real = np.isin(found[rows], [one.track_id for one in recorder.events if one.kind == EventKind.BORN])
            of = np.where(real | (found[rows] < earlier), found[rows], UNKNOWN)
            parts.append(_find_standing(tracker, table, slice(begin, end), of, recorder.events, config))

    for k, stamp_s in enumerate(table.stamp_s.tolist()):
        if np.isfinite(tracker.stamp_s) and stamp_s - tracker.stamp_s > gap_s:
            n_gaps += 1
            judge(k)
            begin = k
            recorder.events.extend(_close_eyes(tracker, centre_m, tracker.stamp_s, stamp_s, min(step_s, gap_s)))
        rows = slice(int(table.first[k]), int(table.first[k + 1]))
        view, centre_m = None, centre_m if table.sensor_m is None else table.sensor_m[k]
        if config.range_m is not None and table.sensor_m is not None:
            around = centre_m, config.range_m, config.p_detect
            view = View.ball(*around) if sees is None else sees.view(k, *around)
            if followed is not None and table.box is not None:
                there = followed.p_exists >= IS_THERE  # also what is missed in this frame hides what is behind it
                view = view.hide_behind(followed.position_m[there], followed.box[there])
        found[rows], events = tracker.step(
            stamp_s,
            table.position_m[rows],
            table.class_id[rows],
            box=None if table.box is None else table.box[rows],
            p_real=None if p_real is None else p_real[rows],
            covariance_m2=None if noise is None else noise[rows],
            appearance=None if table.appearance is None else table.appearance[rows],
            view=view,
        )
        followed = tracker.followed()
        recorder.add(followed, events)
        if progress and k % 100 == 99:
            progress(k + 1, table.n_frames)
    judge(table.n_frames)
    remarks = [sees.remark] if sees is not None and sees.remark else []
    return recorder, found, n_gaps, remarks, join_stood(parts, table.position_m, config.still) if parts else None


def _close_eyes(tracker: Tracker, centre_m: FloatArray, stamp_s: float, until_s: float, step_s: float) -> list[Event]:
    """Insert frames without a view, until resting tracks are stored and moving ones are deleted.

    A filter's prediction over hours is useless, and the first frame after it would match every object wrongly.
    """
    nowhere = View.ball(centre_m, 0.0, 0.0)
    n = tracker.settings.max_missed + 1
    step_s = min(step_s, 0.5 * (until_s - stamp_s) / n)
    events: list[Event] = []
    for k in range(1, n + 1):
        events.extend(tracker.step(stamp_s + k * step_s, np.empty((0, 3)), view=nowhere)[1])
    return events


def find_misses(events: Sequence[Event], track_id: IntArray) -> FloatArray:
    """Return (K,) when objects that rested out of view were missed in their places; inf where they were not."""
    stored, missed = set[int](), dict[int, float]()
    for event in events:
        if event.kind == EventKind.STORED:
            stored.add(event.track_id)
        elif event.kind == EventKind.DIED and event.track_id in stored:
            missed[event.track_id] = event.stamp_s
        else:
            stored.discard(event.track_id)
    return np.array([missed.get(name, np.inf) for name in track_id.tolist()])


def _lifetimes(spells: StaticSpells, rest_for_s: float) -> tuple[CensoredLifetimes | None, IntArray]:
    long = spells.last_s - spells.first_s >= rest_for_s
    if not (long & np.isfinite(spells.elsewhere_s)).any():  # it is known of none when it can have begun
        return None, np.zeros(0, dtype=np.int64)
    return lifetimes_of_sightings(
        spells.elsewhere_s, spells.first_s, spells.last_s, spells.gone_s, least_stay_s=rest_for_s
    )


def _usual_step_s(table: DetectionTable) -> float:
    """Median time from frame to frame; any for a single frame."""
    return float(np.median(np.diff(table.stamp_s))) if table.n_frames > 1 else 1.0


def _remarks(table: DetectionTable, config: TrackConfig, spells: StaticSpells) -> list[str]:
    remarks = list(table.warnings)
    if table.n_weak:
        remarks.append(f"{counted(table.n_weak, 'detection')} with a low score dropped")
    step_s = _usual_step_s(table)
    if step_s > config.slow_step_s:
        remarks.append(f"frames are {step_s:.3g} s apart: moving objects are hardly tracked at that rate")
    if config.range_m is None and table.sensor_m is not None and table.score is None:
        remarks.append("without `range_m`, a missed detection is no evidence")
    unknown = int((~np.isfinite(spells.elsewhere_s)).sum())
    if unknown:
        what = f"{counted(unknown, 'spell')} whose beginning has no bound"
        why = "since the place was not observed before"
        if config.range_m is None:
            why = "since without `range_m` no place is known to be observed"
        remarks.append(f"{what}, {why}: in spells.csv, not in lifetimes.csv")
    return remarks


def _describe_returns(spells: StaticSpells, objects: Tracks, events: Sequence[Event], within_m: float) -> list[str]:
    """Say so where most of what stood and left is followed by another object of that class in that place.

    Such an object has not left: it was missed because it was not looked at. Also of those that were seen too briefly to
    rest, `objects` by their rows.
    """
    brief = _stand_briefly(objects, np.setdiff1d(_list_dead(events), spells.track_id), within_m)
    later = _stand_briefly(objects, np.setdiff1d(objects.track_id, spells.track_id), within_m)
    left = spells[np.isfinite(spells.gone_s)].joined(brief)
    came = spells.joined(later)
    again = 0
    for k in range(len(left)):
        near = np.linalg.norm(came.position_m - left.position_m[k], axis=1) < within_m
        new = (came.track_id != left.track_id[k]) & (came.class_id == left.class_id[k])
        again += bool((near & new & (came.first_s >= left.last_s[k])).any())
    if again < FEW or again <= 0.5 * len(left):
        return []
    what = f"{again} of {counted(len(left), 'object')} that left were followed by the like in the very place"
    return [f"{what}: misses come together; state what the sensor sees (`range_m`, `fov_deg`, poses)"]


def _list_dead(events: Sequence[Event]) -> IntArray:
    return np.array([event.track_id for event in events if event.kind == EventKind.DIED], dtype=np.int64)


def _stand_briefly(objects: Tracks, track_id: IntArray, within_m: float) -> StaticSpells:
    """Return those of some objects that were in one place as long as they were followed, as if they had rested."""
    mine = objects[np.isin(objects.track_id, track_id)]
    name, first = np.unique(mine.track_id, return_index=True)
    last = np.searchsorted(mine.track_id, name, side="right") - 1
    middle = (first + last) // 2
    parts = (first, middle), (middle, last), (first, last)
    begin, end, place = (
        np.array([np.median(mine.position_m[a : b + 1], axis=0) for a, b in zip(*part, strict=True)]).reshape(-1, 3)
        for part in parts
    )
    stands = np.linalg.norm(end - begin, axis=1) < within_m
    stamp_s, forever, kind = mine.stamp_s, np.full(len(name), np.inf), mine.class_p[last].argmax(axis=1)
    return StaticSpells(name, kind, place, -forever, stamp_s[first], stamp_s[last], stamp_s[last])[stands]


def warm_up() -> None:
    """Compile the kernels, or load them: a few frames with one object that comes, stays, goes, and comes back."""
    Tracker(boxes=True, scored=True).step(0.0, np.zeros((1, 3)), box=np.ones((1, 4)), p_real=np.ones(1))
    tracker = Tracker()
    here, nothing = np.zeros((1, 3)), np.empty((0, 3))
    seen = View.ball(np.zeros(3), 1.0, 0.9)
    for k in range(60):
        tracker.step(0.1 * k, here if k < 30 else nothing)
    tracker.step(7.0, here, view=seen)
    _close_eyes(tracker, np.zeros(3), 7.0, 9.0, 0.1)
    for k in range(20):
        tracker.step(10.0 + 2.0 * k, nothing, view=seen)
