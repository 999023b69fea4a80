"""The tracker (Bateman 2020, Algorithm 2), frame after frame; reads as the algorithm does.

Predict; assign detections to tracklets, and the others to the working set; start a tracklet with every remaining
detection; and delete those that should have been seen and were not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from evermap.config import TrackerConfig
from evermap.errors import ConfigError, InputError
from evermap.io.text import quote
from evermap.show import Shown, draw
from evermap.survival import GeneralPurpose, LifetimePrior
from evermap.survival.text import prior_from_dict, prior_to_dict
from evermap.tracking.frame import Frame, appearances, boxes, classes, covariances, positions, probabilities
from evermap.tracking.record import Event, Followed, SpellLog, StaticSpells
from evermap.tracking.state_file import State, read_state, write_state
from evermap.tracking.tracklets import (
    ALIVE,
    N_DETECTED,
    N_FILTERED,
    N_LEVEL,
    VARIANCE,
    WORKING_SET,
    YAW,
    EventKind,
    EventTable,
    Rules,
    SpellTable,
    TrackState,
    grown,
    room_for,
    sweep,
)
from evermap.tracking.views import View, ViewMemory
from evermap.tracking.working_set import KEPT, WorkingSet
from evermap.types import UNKNOWN, FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOM = 64
"""Rows of a table at first."""


class Tracker(Shown):
    """Tracks objects in space, and re-identifies them at their place of rest.

    Args:
        settings: assumptions about objects and their detector.
        n_classes: number of classes.
        confusion: (C, C) `P(detected class | true class)`, a row a true class; equal mistakes where None.
        n_appearance: length of the appearance vectors that come with detections, 0 for none.
        boxes: whether detections are boxes rather than points.
        scored: whether detections come with probabilities to be real.
        priors: lifetimes at rest, one for all classes or one a class; one that knows nothing where None.
        class_names: names of the classes, kept with a saved state; as many as there are numbers where None.

    Raises:
        ConfigError: a matrix, priors or names that do not fit the classes.
    """

    def __init__(
        self,
        settings: TrackerConfig | None = None,
        *,
        n_classes: int = 1,
        confusion: FloatArray | None = None,
        n_appearance: int = 0,
        boxes: bool = False,
        scored: bool = False,
        priors: LifetimePrior | Sequence[LifetimePrior] | None = None,
        class_names: Sequence[str] | None = None,
    ) -> None:
        from scipy.special import chdtri

        from evermap.tracking import association, kalman, life

        if n_classes < 1:
            raise ConfigError(f"{n_classes} classes", field="n_classes", hint="at least 1")
        self._association, self._kalman, self._life = association, kalman, life
        self.settings = s = settings or TrackerConfig()
        self._n_classes, self._n_appearance = n_classes, n_appearance
        self._boxes, self._scored = boxes, scored
        self.class_names = tuple(map(str, range(n_classes)) if class_names is None else class_names)
        if len(self.class_names) != n_classes or len(set(self.class_names)) != n_classes:
            raise ConfigError(f"{len(set(self.class_names))} names for {n_classes} classes", field="class_names")
        self._confusion = confusion
        self._lifetimes = lifetimes = _as_priors(priors, n_classes, s.leave_rates_hz)
        self._likelihood: association.Likelihood = _numbers(
            association.Likelihood,
            s,
            confusion=s.confusion_matrix(n_classes, confusion),
            class_prior=np.full(n_classes, 1.0 / n_classes),
            log_clutter=float(np.log(s.clutter_per_m3)),
            gate=float(chdtri(3.0, 1.0 - s.gate_probability)),  # of a chi-square with 3 degrees of freedom
            moved_reach_m=0.0,
            log_moved=-np.inf,
            log_p_misplaced=math.log(s.shape.p_misplaced),
        )
        self._likelihood_at_rest = self._likelihood
        if s.moved_reach_m > 0.0:
            volume_m3 = 4.0 / 3.0 * np.pi * s.moved_reach_m**3
            self._likelihood_at_rest = self._likelihood._replace(
                moved_reach_m=float(s.moved_reach_m), log_moved=float(np.log(s.p_moved / volume_m3))
            )
        self._rules: Rules = _numbers(
            Rules,
            s,
            odds_confirm=(1.0 - s.p_confirm) / s.p_confirm,
            odds_dead=(1.0 - s.p_dead) / s.p_dead,
            class_speed_mps=s.class_speeds(n_classes).copy(),  # a read-only array would have all kernels compiled twice
            inverse_odds_new=(1.0 - s.p_real) / s.p_real,
            place_m2=float(s.place_sigma_m**2) if boxes else 0.0,
            log_odds_believed=float(np.log(s.p_believed / (1.0 - s.p_believed))),
        )
        self._noise = np.eye(3)[None] * s.sigma_position_m**2
        self._tracklets = room_for(ROOM, s.order, n_classes, n_appearance, boxes=boxes, scored=scored)
        self._n = 0
        self._next_id = 0
        self._stamp_s = -np.inf
        self.working_set = WorkingSet(
            s.chunk_m, lifetimes, n_classes, n_appearance, n_box=N_FILTERED * boxes, n_level=N_LEVEL * scored
        )
        self._views = ViewMemory(float(np.log(1.0 / s.p_empty)))
        self._spells = SpellLog()
        self._tables(ROOM)

    def save(self, path: str | Path) -> Path:
        """Write all that the tracker knows: what is followed, what rests out of view, spells that have ended, views.

        Views other than balls and sectors are left out: what they saw empty is not known to a tracker that goes on.

        Args:
            path: one file (NumPy's .npz, under any name), which replaces an older one at once. Returned.

        Raises:
            ConfigError: a lifetime that does not consist of numbers.
            InputError: the file cannot be written.
        """
        t, n = self._tracklets, self._n
        about = {
            "settings": {name: value for name, value in self.settings.to_dict().items() if name in _SETTINGS},
            "class_names": list(self.class_names),
            "confusion": None if self._confusion is None else np.asarray(self._confusion).tolist(),
            "priors": [prior_to_dict(prior) for prior in self._lifetimes],
            "n_appearance": self._n_appearance,
            "boxes": self._boxes,
            "scored": self._scored,
            "next_id": self._next_id,
            "stamp_s": None if np.isneginf(self._stamp_s) else self._stamp_s,
        }
        parts = {
            "tracklets": {name: getattr(t, name)[:n] for name in t._fields},
            "working_set": self.working_set.columns(),
            "spells": self._spells.columns(),
            "views": self._views.columns(),
        }
        return write_state(path, about, parts)

    @classmethod
    def load(
        cls,
        path: str | Path,
        settings: TrackerConfig | None = None,
        *,
        class_names: Sequence[str] | None = None,
        confusion: FloatArray | None = None,
        priors: LifetimePrior | Sequence[LifetimePrior] | None = None,
    ) -> Self:
        """Return a tracker that goes on where `save` was called, on another day or another robot of the same world.

        Args:
            path: of `save`.
            settings: others than those saved; as they were where None.
            confusion: the same; equal mistakes where there are new classes.
            priors: the same; lifetimes that know nothing of new classes.
            class_names: all names that were saved, in any order, and new ones. An object is of a class that was not
                known as likely as of the least likely of those that were.

        Raises:
            InputError: no such file, or not one of `save`.
            ConfigError: names that were saved are missing, another model of motion, or choices that do not fit.
        """
        return cls.of_state(read_state(path), settings, class_names=class_names, confusion=confusion, priors=priors)

    @classmethod
    def of_state(
        cls,
        state: State,
        settings: TrackerConfig | None = None,
        *,
        class_names: Sequence[str] | None = None,
        confusion: FloatArray | None = None,
        priors: LifetimePrior | Sequence[LifetimePrior] | None = None,
    ) -> Self:
        """Return the tracker of a state that was read; arguments and errors as of `load`."""
        about, saved = state.about, state.class_names
        names = saved if class_names is None else tuple(class_names)
        if missing := [name for name in saved if name not in names]:
            raise ConfigError(f"no class {quote(missing[0])}, which objects are of", field="class_names")
        into = np.array([names.index(name) for name in saved], dtype=np.int64)
        chosen = settings or TrackerConfig.model_validate(about["settings"])
        if priors is None:
            kept = [prior_from_dict(prior) for prior in about["priors"]]
            unknown = GeneralPurpose(*chosen.leave_rates_hz)
            by_name = dict(zip(saved, kept, strict=False))
            priors = kept if len(kept) == 1 else [by_name.get(name, unknown) for name in names]
        if confusion is None and about["confusion"] is not None and len(names) == len(saved):
            order = np.argsort(into)
            confusion = np.array(about["confusion"])[np.ix_(order, order)]
        tracker = cls(
            chosen,
            n_classes=len(names),
            confusion=confusion,
            n_appearance=about["n_appearance"],
            boxes=about["boxes"],
            scored=about["scored"],
            priors=priors,
            class_names=names,
        )
        tracker._restore(state, into)
        return tracker

    def _restore(self, state: State, into: IntArray) -> None:
        """Take over what `save` wrote, of classes that now have the numbers `into`."""
        parts = state.parts
        columns = dict(parts["tracklets"])
        if columns["mean"].shape[1:] != self._tracklets.mean.shape[1:]:
            hint = f"motion={'velocity' if self.settings.order == 3 else 'acceleration'}, as the state was saved with"
            raise ConfigError("another model of motion than that of the state", field="motion", hint=hint)
        columns["class_p"] = _among(columns["class_p"], into, self._n_classes)
        n = len(columns["track_id"])
        self._reserve(n)
        for name in self._tracklets._fields:
            getattr(self._tracklets, name)[:n] = columns[name]
        self._n, self._next_id, self._stamp_s = n, state.about["next_id"], state.stamp_s
        stored, spells = parts["working_set"], parts["spells"]
        self.working_set.restore({**stored, "class_id": into[stored["class_id"]]})
        self._spells.restore({**spells, "class_id": into[spells["class_id"]]})
        self._views.restore(parts["views"])

    @property
    def stamp_s(self) -> float:
        """Stamp of the last frame, -inf before the first."""
        return self._stamp_s

    @property
    def n_objects(self) -> int:
        """Number of objects so far; each has an id below it."""
        return self._next_id

    def __len__(self) -> int:
        """Return the number of active tracklets."""
        return self._n

    def step(
        self,
        stamp_s: float,
        position_m: Any,
        class_id: Any = None,
        *,
        box: Any = None,
        p_real: Any = None,
        covariance_m2: Any = None,
        appearance: Any = None,
        view: View | None = None,
    ) -> tuple[IntArray, list[Event]]:
        """Process one frame, also an empty one.

        Args:
            stamp_s: when, after the frame before.
            position_m: (M, 3) detected centroids, in the world.
            class_id: (M,) detected classes, `UNKNOWN` for none; all unknown where None.
            box: (M, 4) length, width, height [m] and heading in the world [rad], of a tracker of boxes.
            p_real: (M,) probabilities by the detector's scores to be real (`frame.p_real_of`), nan for none.
            covariance_m2: (M, 3, 3) of the positions; the settings' noise where None.
            appearance: (M, A) vectors of any length, zeros where there is none.
            view: what can be seen. Without it all that is followed is in view, and nothing is learned about the
                working set from what is not detected.

        Returns:
            (M,) ids of the objects that the detections are of, and what happened.

        Raises:
            InputError: time running back, or detections that are malformed.
        """
        frame = self._frame(stamp_s, position_m, class_id, box, p_real, covariance_m2, appearance)
        events: list[Event] = []
        self._predict(frame.stamp_s)
        track_of_detection = self._associate(frame, view, events)
        self._find_again(frame, view, track_of_detection, events)
        self._begin(frame, track_of_detection, events)
        if view is not None:
            self._judge(frame.stamp_s, view, events)
            self._views.add(frame.stamp_s, view)
        return track_of_detection, events

    def followed(self) -> Followed:
        """Return the active tracklets after the last frame."""
        t, n = self._tracklets, self._n
        p_real = self._life.p_real(t, n, self._rules) if self._scored else 1.0
        return Followed(
            stamp_s=self._stamp_s,
            track_id=t.track_id[:n].copy(),
            state=t.state[:n].copy(),
            position_m=t.mean[:n, :3].copy(),
            velocity_mps=t.mean[:n, 3:6].copy(),
            position_covariance_m2=t.covariance[:n, :3, :3].copy(),
            velocity_covariance_m2ps2=t.covariance[:n, 3:6, 3:6].copy(),
            class_p=t.class_p[:n].copy(),
            p_exists=p_real / (1.0 + t.inverse_odds[:n]),
            box=t.box[:n, :N_DETECTED].copy(),
            box_variance=t.box[:n, VARIANCE : VARIANCE + N_DETECTED].copy(),
            n_missed=t.n_missed[:n].copy(),
            static=t.static[:n] == 1,
        )

    def p_static(self, prior: float = 0.5) -> FloatArray:
        """Return (N,) probabilities that the `followed` objects are static, in the same order.

        That an object stands is a special case of its filter: the density of velocity zero after all detections, over
        that before, is the Bayes factor (Dickey 1971).

        Args:
            prior: probability that any object stands.
        """
        t, n, s = self._tracklets, self._n, self.settings
        before = np.repeat(s.sigma_velocity_mps**2 * np.eye(3)[None], n, axis=0)
        if self._boxes:
            ahead = np.column_stack([np.cos(t.box[:n, YAW]), np.sin(t.box[:n, YAW]), np.zeros(n)])
            ahead *= s.speed_per_length_hz * t.box[:n, :1]
            before += ahead[:, :, None] * ahead[:, None, :]
        v, p = t.mean[:n, 3:6], t.covariance[:n, 3:6, 3:6]
        squared = np.einsum("ni,ni->n", v, np.linalg.solve(p, v[:, :, None])[:, :, 0])
        log_factor = 0.5 * (np.linalg.slogdet(before)[1] - np.linalg.slogdet(p)[1] - squared)
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(log_factor, -700.0, 700.0)) * (1.0 - prior) / prior))

    def to_pandas(self) -> Any:
        """Return a data frame with a row an active tracklet, after the last frame.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        return self.followed().to_pandas()

    def plot(self) -> Figure:
        """Draw the tracks, and objects at rest out of view, from above."""
        resting = self.working_set.stored.position[self.working_set.rows]
        return draw("plot_followed", self.followed(), resting)

    def _facts(self) -> dict[str, Any]:
        states = self._tracklets.state[: self._n]
        counts = {state.name.lower(): int((states == state).sum()) for state in TrackState}
        out_of_view = {"working_set": len(self.working_set), "objects_ever": self._next_id}
        last = {} if np.isneginf(self._stamp_s) else {"stamp_s": round(self._stamp_s, 6)}
        return last | {name: counts[name] for name in ("birth", "alive", "lost")} | out_of_view

    def static_spells(self) -> StaticSpells:
        """Return all static spells so far: those that have ended, and those that go on, whose end is open."""
        return self._spells.with_open(self._tracklets, self._n, self.working_set)

    def confirm_rest(self, stays: StaticSpells, since_s: float) -> None:
        """Correct what rests by all detections of a recording, of which each frame knew the earlier ones alone.

        Stays of objects that are followed or stored become their spells, with the beginning that was seen; those of
        others are spells that have ended. Of this recording, spells that nothing confirms and that are shorter than
        `rest_for_s` were not at rest.

        Args:
            stays: that all detections show, bounds of their ends as far as they were seen.
            since_s: begin of the recording.
        """
        least_s, w = self.settings.rest_for_s, self.working_set
        spare = ~self._spells.confirm(stays, since_s, least_s)
        for table, rows, place in (
            (self._tracklets, np.arange(self._n), self._tracklets.rest_mean),
            (w.stored, w.rows, w.stored.position),
        ):
            for row in rows[table.rest_seen_s[rows] >= since_s].tolist():
                mine = np.flatnonzero(
                    stays.covers(table.track_id[row], table.rest_since_s[row], table.rest_seen_s[row])
                )
                if not len(mine):
                    short = table.rest_seen_s[row] - table.rest_since_s[row] < least_s
                    table.static[row] &= not short
                    continue
                spare[mine] = False
                first = min(table.rest_since_s[row], stays.first_s[mine].min())
                if not -np.inf < table.elsewhere_s[row] < first:
                    known = stays.elsewhere_s[mine[0]]
                    empty = self._views.last_empty_s(place[row], float(first))
                    table.elsewhere_s[row] = known if -np.inf < known < first else empty
                table.static[row], table.rest_since_s[row] = 1, first
        others = stays[spare]
        for k in np.flatnonzero(np.isneginf(others.elsewhere_s)).tolist():
            others.elsewhere_s[k] = self._views.last_empty_s(others.position_m[k], float(others.first_s[k]))
        self._spells.add_ended(others)

    def _frame(
        self, stamp_s: Any, position_m: Any, class_id: Any, box: Any, p_real: Any, covariance_m2: Any, appearance: Any
    ) -> Frame:
        stamp = float(stamp_s)
        if not (stamp > self._stamp_s and stamp < np.inf):
            raise InputError(
                f"frame at {stamp_s} s does not come after the one at {self._stamp_s} s",
                field="stamp_s",
                hint="frames in the order of their stamps, all detections of one instant in one frame",
            )
        position = positions(position_m)
        m = len(position)
        shape = box_noise = np.empty((m, 0))
        noise = self._noise
        if self._boxes:
            shape = boxes(box, m)
            faces = self.settings.sigma_face_m + self.settings.sigma_face_share * shape[:, :3]
            box_noise = self._kalman.noise_of_shapes(shape, faces)
            noise = self._kalman.noise_of_centres(shape, faces) if m else noise
        return Frame(
            stamp_s=stamp,
            position=position,
            noise=covariances(covariance_m2, m, noise),
            class_id=classes(class_id, m, self._n_classes),
            appearance=appearances(appearance, m, self._n_appearance),
            box=shape,
            box_noise=box_noise,
            level=self._level(p_real, m),
        )

    def _level(self, p_real: Any, m: int) -> FloatArray:
        """(M, 1) log odds that detections are real, inf where nothing is known of that; (M, 0) without scores."""
        if not self._scored:
            return np.empty((m, 0))
        p = np.clip(probabilities(p_real, m)[:, None], 1e-9, 1.0 - 1e-9)
        return np.where(np.isnan(p), np.inf, np.log(p / (1.0 - p)))

    def _predict(self, stamp_s: float) -> None:
        """Move all filters on to the frame."""
        gap = stamp_s - self._stamp_s if self._n else 0.0
        self._stamp_s = stamp_s
        t = self._tracklets
        self._kalman.predict(t.mean, t.covariance, self._n, gap, self.settings.motion_density)
        if self._boxes:
            shape = self.settings.shape
            self._kalman.predict_shapes(t.box, self._n, gap, float(shape.turning), float(shape.resizing))
        self._death_odds = float(np.expm1(min(self.settings.vanish_rate_hz * gap, 600.0)))

    def _associate(self, frame: Frame, view: View | None, events: list[Event]) -> IntArray:
        """Assign detections to tracklets and update these; return (M,) ids, `UNKNOWN` for unassigned detections."""
        t, n = self._tracklets, self._n
        p_detect = np.full(n, self.settings.p_detect) if view is None else view.probability(t.mean[:n, :3])
        track_of_detection = np.full(len(frame.position), UNKNOWN)
        table, spells = self._event_table, self._spell_table
        in_sight = self._life.InSight(p_detect, view is not None, self._death_odds)
        n_events, n_spells, n_gone = self._life.live(
            t, n, frame, in_sight, self._likelihood, self._rules, track_of_detection, table, spells
        )
        for kind, row in zip(table.kind[:n_events].tolist(), table.row[:n_events].tolist(), strict=True):
            events.append(Event(frame.stamp_s, EventKind(kind), int(t.track_id[row])))
            if kind == EventKind.BORN:
                self._limit_arrival(row)
        self._spells.add(self._spell_table, n_spells)
        if n_gone:
            leaving = np.flatnonzero(t.state[:n] == WORKING_SET)
            if len(leaving):
                self.working_set.insert(t, leaving, frame.stamp_s)
            self._n = sweep(t, n)
        return track_of_detection

    def _find_again(self, frame: Frame, view: View | None, track_of_detection: IntArray, events: list[Event]) -> None:
        """Assign remaining detections to objects of the working set, which become active again."""
        w, s = self.working_set, self.settings
        free = np.flatnonzero(track_of_detection == UNKNOWN)
        if len(w) == 0 or len(free) == 0:
            return
        place_m2 = s.place_sigma_m**2
        position = frame.position[free]
        noise = frame.noise if len(frame.noise) == 1 else frame.noise[free]
        widest = noise[:, [0, 1, 2], [0, 1, 2]].max(axis=1) + w.widest_m2 + place_m2
        reach = np.maximum(np.sqrt(3.0 * self._likelihood.gate * widest), s.moved_reach_m)
        reach = np.broadcast_to(reach, len(free))
        rows = w.near(position, np.ascontiguousarray(reach))
        if len(rows) == 0:
            return
        covariance = w.covariance(rows)
        covariance[:, [0, 1, 2], [0, 1, 2]] += place_m2
        place = w.stored.position[rows]
        p_detect = np.full(len(rows), s.p_detect) if view is None else view.probability(place)
        appearance, box = (column[rows].astype(np.float64) for column in (w.stored.appearance, w.stored.box))
        inverse_odds = w.inverse_odds(rows, frame.stamp_s)
        columns = {name: getattr(frame, name)[free] for name in ("class_id", "appearance", "box", "box_noise", "level")}
        found, detection, log_ratio, moved = self._life.match(
            self._association.Targets(place, covariance, w.class_p(rows), appearance, box, inverse_odds, p_detect),
            frame._replace(position=position, noise=np.ascontiguousarray(noise), **columns),
            self._likelihood_at_rest,
        )
        if len(found) == 0:
            return
        self._reserve(self._n + len(found))
        t, n = self._tracklets, self._n
        self._wake(rows[found], covariance[found], p_detect[found], log_ratio, frame.stamp_s)
        n_spells = self._life.resume(
            t, n, frame, free[detection], moved, self._likelihood.confusion, self._rules, self._spell_table
        )
        self._spells.add(self._spell_table, n_spells)
        self._n = n + len(found)
        track_of_detection[free[detection]] = t.track_id[n : self._n]
        events.extend(Event(frame.stamp_s, EventKind.REIDENTIFIED, int(i)) for i in t.track_id[n : self._n])
        w.remove(rows[found])

    def _wake(
        self, rows: IntArray, covariance: FloatArray, p_detect: FloatArray, log_ratio: FloatArray, stamp_s: float
    ) -> None:
        """Copy objects of the working set behind the active tracklets, unchanged."""
        t, w = self._tracklets, self.working_set
        into = slice(self._n, self._n + len(rows))
        gain = np.exp(-np.clip(log_ratio, -60.0, 60.0)) / np.maximum(p_detect, self.settings.least_p_detect)
        for name in KEPT:
            getattr(t, name)[into] = getattr(w.stored, name)[rows]
        t.class_p[into] = w.class_p(rows)
        t.inverse_odds[into] = np.maximum(w.inverse_odds(rows, stamp_s) * gain, self._life.LEAST)
        t.rest_mean[into], t.rest_covariance[into] = w.stored.position[rows], covariance

    def _begin(self, frame: Frame, track_of_detection: IntArray, events: list[Event]) -> None:
        """Start a tracklet for every unassigned detection, in the order of their places."""
        free = np.flatnonzero(track_of_detection == UNKNOWN)
        if len(free) == 0:
            return
        free = free[np.lexsort(frame.position[free].T)]
        self._reserve(self._n + len(free))
        n_alive = self._life.start_all(
            self._tracklets, self._n, self._next_id, frame, free, self._likelihood.confusion, self._rules,
            track_of_detection,
        )  # fmt: skip
        first, self._n, self._next_id = self._n, self._n + len(free), self._next_id + len(free)
        if not n_alive:
            return
        for row in (first + np.flatnonzero(self._tracklets.state[first : self._n] == ALIVE)).tolist():
            events.append(Event(frame.stamp_s, EventKind.BORN, int(self._tracklets.track_id[row])))
            self._limit_arrival(row)

    def _limit_arrival(self, row: int) -> None:
        """Note when the place of a tracklet that is confirmed was last seen empty."""
        t = self._tracklets
        if np.isneginf(t.elsewhere_s[row]):
            t.elsewhere_s[row] = self._views.last_empty_s(t.rest_mean[row], float(t.first_s[row]))

    def _judge(self, stamp_s: float, view: View, events: list[Event]) -> None:
        """Objects of the working set that should have been seen, and were not."""
        w = self.working_set
        if len(w) == 0:
            return
        rows = w.near(view.centre_m[None], np.array([view.reach_m]))
        rows = rows[stamp_s - w.stored.judged_s[rows] >= self.settings.judge_every_s]
        p_detect = view.probability(w.stored.position[rows])
        rows, p_detect = rows[p_detect > 0.0], p_detect[p_detect > 0.0]
        if len(rows) == 0:
            return
        gone = rows[w.missed(rows, stamp_s, p_detect) > self._rules.odds_dead]
        if len(gone):
            events.extend(Event(stamp_s, EventKind.DIED, track) for track in w.stored.track_id[gone].tolist())
            self._spells.add_stored(w.stored, gone[w.stored.static[gone] == 1], stamp_s)
            w.remove(gone)

    def _reserve(self, n: int) -> None:
        """Room for `n` active tracklets."""
        room = len(self._tracklets.track_id)
        if n > room:
            while room < n:
                room *= 2
            self._tracklets = grown(self._tracklets, room)
            self._tables(room)

    def _tables(self, room: int) -> None:
        self._event_table = EventTable(np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int64))
        self._spell_table = SpellTable(
            np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int64), np.empty((room, 3)), np.empty((room, 4))
        )


_SETTINGS = frozenset(TrackerConfig.model_fields)


def _among(class_p: FloatArray, into: IntArray, n_classes: int) -> FloatArray:
    """(N, n_classes) the same beliefs of classes that now have the numbers `into`, and of new ones (`Tracker.load`)."""
    least = class_p.min(axis=1, initial=1.0)
    out = np.repeat(least[:, None], n_classes, axis=1)
    out[:, into] = class_p
    return np.asarray(out / out.sum(axis=1, keepdims=True))


def _numbers(table: Any, s: TrackerConfig, **derived: Any) -> Any:
    """Return a table of numbers as kernels take them: those derived, and those of the same name in the settings."""
    named = (name for name in table._fields if name not in derived)
    return table(**derived, **{name: getattr(s.shape if hasattr(s.shape, name) else s, name) for name in named})


def _as_priors(
    priors: LifetimePrior | Sequence[LifetimePrior] | None, n_classes: int, rates_hz: tuple[float, float]
) -> tuple[LifetimePrior, ...]:
    if priors is None:
        return (GeneralPurpose(*rates_hz),)
    several = tuple(priors) if isinstance(priors, Sequence) else (priors,)
    if len(several) not in {1, n_classes}:
        raise ConfigError(f"{len(several)} lifetime priors for {n_classes} classes", field="priors")
    return several
