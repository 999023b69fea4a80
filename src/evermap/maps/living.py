"""The nouns of a living map: frozen dataclasses of arrays, one row an item, joined by ids.

    landmark --(belongs to)--> clique --(stands at one of)--> site --(has one for each landmark)--> place

A *clique* is a rigid body: landmarks that arrive, move and leave together. A *site* is one of its poses, and a *place*
is the position of one of its landmarks there. At most one site of a clique is occupied at a time, none while it is
away: gone, or where the map does not know. So one chain a clique, with the states 'away, site 1, site 2 ...', is
Rosen's persistence filter (one site, absorbing 'away'), Bateman's joint clique filter (one chain for many landmarks)
and Nielsen's modes (many sites), see MATH.md section 5.

All arrays are sorted by their id. Ids are never used twice, so that revisions of a map can be compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from scipy.linalg import block_diag

from evermap.config import LivingConfig
from evermap.errors import InputError
from evermap.geometry.chunked import ChunkedCovariance, JointCovariance, blocks, taken
from evermap.maps.lives import Lives
from evermap.maps.names import Renamed, landmark_with, name_landmarks, rename
from evermap.maps.shelves import Sight
from evermap.sensing.sightlines import Glimpses, SightLines, Views, pair_rows
from evermap.show import Shown, draw
from evermap.types import (
    UNKNOWN,
    BoolArray,
    Clock,
    FloatArray,
    IntArray,
    Landmarks,
    Tabular,
    Up,
    is_text_of,
    landmark_code,
    landmark_id_of,
    landmark_label,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

USUAL = LivingConfig()
EXISTS = 0.5
"""What exists with at least this probability is in the map."""

SURVEYED = 0.95
"""Belief in landmarks of a survey, at most: some were moved since."""
MOST_DIGITS = 18
"""Of ids of landmarks, which are 64 bits wide."""


TURNS, AXES = {2: 0, 3: 4}, {2: 0, 3: 3}
"""Numbers of an orientation, and of its covariance's rows, of places in the plane and in space."""
_DTYPES: dict[str, type] = {"IntArray": np.int64, "FloatArray": np.float64, "BoolArray": np.bool_}


class _Rows(Tabular):
    """Tables of a map, in the plane or in space."""

    __slots__ = ()

    @classmethod
    def empty(cls, dim: int = 2) -> Self:
        """Return a table of no rows, of the plane or, with `dim=3`, of space."""
        shapes = {
            "position_m": (0, dim),
            "size_m": (0, 3),
            "rotation": (0, TURNS[dim]),
            "rotation_covariance": (0, *2 * (AXES[dim],)),
        }
        return cls(*(np.zeros(shapes.get(f.name, (0,)), _DTYPES[str(f.type)]) for f in fields(cls)))


@dataclass(frozen=True, slots=True)
class Members(_Rows):
    """Landmarks: (L,) rows, sorted by `landmark_id`.

    Attributes:
        landmark_id: as the front end calls it.
        class_id: row of `LivingMap.class_names`, or `UNKNOWN`.
        clique_id: the body it belongs to; a landmark that moves alone is a clique of its own.
        pinned: an operator said that it is never to be removed.
        deleted: an operator said that it is not to be used; its detections are ignored until that is taken back.
    """

    landmark_id: IntArray
    class_id: IntArray
    clique_id: IntArray
    pinned: BoolArray
    deleted: BoolArray


@dataclass(frozen=True, slots=True)
class Sites(_Rows):
    """Poses that cliques have occupied: (S,) rows, sorted by `site_id`.

    Attributes:
        site_id: unique, never used again.
        clique_id: whose.
        p_here: probability that the clique stands there at `LivingMap.stamp_s`; the rest to 1 of a clique is 'away'.
        p_kept: part of it: that it has stood there ever since it was seen there last.
        since_s: first sighting of the newest stay there.
        seen_s: last sighting there.
    """

    site_id: IntArray
    clique_id: IntArray
    p_here: FloatArray
    p_kept: FloatArray
    since_s: FloatArray
    seen_s: FloatArray


@dataclass(frozen=True, slots=True)
class Places(_Rows):
    """Positions: (P,) rows, sorted by `site_id`, then by `landmark_id`.

    Attributes:
        site_id, landmark_id: where this landmark is while its clique stands at this site.
        position_m: (P, 2) in the map's frame, in space (P, 3).
        n_hits, n_misses: (P,) detections there, and looks without one that expected it.
        rotation: in space (P, 4) quaternion of landmarks that have an orientation, nan of points; (P, 0) in the plane.
        rotation_covariance: (P, 3, 3) of it, in the landmark's own axes [rad^2]; (P, 0, 0) in the plane.
    """

    site_id: IntArray
    landmark_id: IntArray
    position_m: FloatArray
    n_hits: IntArray
    n_misses: IntArray
    rotation: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    rotation_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def __post_init__(self) -> None:
        count, dim = self.position_m.shape
        if not self.rotation.size:  # nobody said
            object.__setattr__(self, "rotation", np.full((count, TURNS[dim]), np.nan))
            object.__setattr__(self, "rotation_covariance", np.full((count, AXES[dim], AXES[dim]), np.nan))


@dataclass(frozen=True, slots=True)
class Stays(_Rows):
    """Stays of cliques at sites: (K,) rows, sorted by `first_s`; what lifetimes are learned from.

    Attributes:
        clique_id, site_id, class_id: what and where.
        position_m: (K, 2) middle of the clique there, in space (K, 3).
        elsewhere_s: last look before `first_s` at which it was not there; -inf where its place was never looked at.
        first_s, last_s: first and last sighting.
        gone_s: first look after `last_s` at which it was not there; inf while it is said to stand there.
        p_gone: (K,) probability that it ended then; 0 while it goes on.
    """

    clique_id: IntArray
    site_id: IntArray
    class_id: IntArray
    position_m: FloatArray
    elsewhere_s: FloatArray
    first_s: FloatArray
    last_s: FloatArray
    gone_s: FloatArray
    p_gone: FloatArray


@dataclass(frozen=True, slots=True)
class Dated(_Rows):
    """Sites whose beliefs are of an earlier instant than the map's, since no recent session was near.

    Attributes:
        site_id: (D,) sorted.
        stamp_s: (D,) when their `Sites.p_here` and `p_kept` held.
    """

    site_id: IntArray
    stamp_s: FloatArray


@dataclass(frozen=True, slots=True)
class Boxes(_Rows):
    """Landmarks that were seen as boxes without identity: the map gave them their ids.

    Attributes:
        landmark_id: (B,) sorted.
        size_m: (B, 3) length, width and height.
    """

    landmark_id: IntArray
    size_m: FloatArray

    def of(self, landmark_id: IntArray) -> FloatArray:
        """Return (K, 3) sizes of landmarks, nan of others."""
        row = rows_among(self.landmark_id, landmark_id)
        return np.asarray(np.vstack([self.size_m, np.full((1, 3), np.nan)])[row])


@dataclass(frozen=True, slots=True)
class MemberTraits(_Rows):
    """What landmarks are like, such as their radius or colour: (T,) rows, sorted by `landmark_id` and `column_id`.

    Attributes:
        landmark_id: which landmark.
        column_id: `landmark_id_of` the name of the column.
        value: mean over sessions of the median of a session's readings.
        sessions: number of these.
    """

    landmark_id: IntArray
    column_id: IntArray
    value: FloatArray
    sessions: IntArray

    def of(self, landmark_id: IntArray, columns: Sequence[str]) -> tuple[FloatArray, IntArray]:
        """Return (K, C) values of landmarks, nan where there is none, and the numbers of sessions."""
        wanted = np.array([landmark_id_of(name) for name in columns], dtype=np.int64)
        asked = np.repeat(landmark_id, len(wanted)), np.tile(wanted, len(landmark_id))
        row = pair_rows((self.landmark_id, self.column_id), asked).reshape(-1, len(wanted))
        return np.append(self.value, np.nan)[row], np.append(self.sessions, 0)[row]

    def met(self, landmark_id: IntArray, columns: Sequence[str], value: FloatArray) -> MemberTraits:
        """Return the table after a session, by the medians (K, C) of its readings, nan for none."""
        before, sessions = self.of(landmark_id, columns)
        before = np.where(sessions > 0, before, 0.0)
        after, column_id = before + (value - before) / (sessions + 1), [landmark_id_of(name) for name in columns]
        k, c = np.nonzero(np.isfinite(value))
        new = MemberTraits(landmark_id[k], np.array(column_id, dtype=np.int64)[c], after[k, c], sessions[k, c] + 1)
        every = self.joined(new)
        every = every[np.lexsort((every.column_id, every.landmark_id))]  # of two the newer one is behind
        last = (np.diff(every.landmark_id) != 0) | (np.diff(every.column_id) != 0)
        return every[np.append(last, True)[: len(every)]]


@dataclass(frozen=True, slots=True)
class Metres(_Rows):
    """Scales of the named robots of a map: (R,) rows.

    Attributes:
        robot_id: `landmark_id_of` the robot's name; 0 for sessions without one, and for a survey. log_metre: log of the
        robot's scale over the map's, the mean of its sessions: positive if its ranges are too long. log_variance: of
        the log of the robot's scale over the true one. information: sum of the inverse variances of all sessions of
        which the robot's metre is the mean.
    """

    robot_id: IntArray
    log_metre: FloatArray
    log_variance: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, robot: str, log_variance: float, information: float) -> Self:
        """Return that of one robot, '' for sessions without a name, which has the metre of the map."""
        name = landmark_id_of(robot) if robot else 0
        return cls(np.array([name]), np.zeros(1), np.array([log_variance]), np.array([information]))


@dataclass(frozen=True, slots=True)
class LivingMap(Shown):
    """Everything known about a site at one instant; the input of the next session.

    Attributes:
        stamp_s: until when observations went in: beliefs are those of this instant, but for `dated` ones. -inf before
            the first session.
        session_start_s: begin of the newest session; one that begins earlier is late.
        members, sites, places, stays, dated, boxes, traits: see there.
        covariance_m2: (2 P, 2 P) joint covariance of all places, x and y interleaved, as if the map's size were known;
            or (P, 2, 2) blocks, while the places are independent; in chunks where there are many; with 3 for 2 in
            space.
        log_size_variance: variance of the log of the map's metre over the true one; 0 where a sensor knows the metre.
        log_size_information: sum of the inverse variances of that, of all sessions of which the metre is the mean.
        metres: what each robot says of the metre, of which the map has what they agree on.
        lives: how long things of a class stay, stay away, and where they turn up again.
        sightlines: from where each place can be seen.
        views: from where the robot looked, and when.
        glimpses: where something was detected that is no landmark of the map, and when.
        sight: both of a large map, whose `sightlines` and `views` have no rows; None in a small one.
        class_names: names of the classes.
        landmark_texts: identities of landmarks that are no numbers (`types.landmark_id_of`); `maps.names` says what
            they are called.
        renamed: what operators call landmarks.
        clock: of all stamps.
        up: where up is in the frame of a map in space, by all sessions; `landmarks().up` says it in the plane, too.
        n_cliques_ever, n_sites_ever: next free ids.
    """

    stamp_s: float = -np.inf
    session_start_s: float = -np.inf
    members: Members = field(default_factory=Members.empty)
    sites: Sites = field(default_factory=Sites.empty)
    places: Places = field(default_factory=Places.empty)
    stays: Stays = field(default_factory=Stays.empty)
    dated: Dated = field(default_factory=Dated.empty)
    boxes: Boxes = field(default_factory=Boxes.empty)
    traits: MemberTraits = field(default_factory=MemberTraits.empty)
    covariance_m2: JointCovariance = field(default_factory=lambda: np.zeros((0, 0)))
    log_size_variance: float = 0.0
    log_size_information: float = np.inf
    metres: Metres = field(default_factory=Metres.empty)
    lives: Lives = field(default_factory=Lives)
    sightlines: SightLines = field(default_factory=SightLines.empty)
    views: Views = field(default_factory=Views.empty)
    glimpses: Glimpses = field(default_factory=Glimpses.empty)
    sight: Sight | None = None
    class_names: tuple[str, ...] = ()
    landmark_texts: tuple[str, ...] = ()
    renamed: Renamed = field(default_factory=Renamed)
    clock: Clock = Clock.RECORDING
    up: Up = field(default_factory=Up)
    n_cliques_ever: int = 0
    n_sites_ever: int = 0

    @classmethod
    def in_space(cls, clock: Clock = Clock.RECORDING) -> Self:
        """Return a map of three dimensions before its first session."""
        return cls(places=Places.empty(3), stays=Stays.empty(3), clock=clock)

    @classmethod
    def begun(cls, landmarks: Landmarks, whole_places: int = USUAL.whole_places) -> Self:
        """Return a map of surveyed landmarks, each a separate body, before its first session.

        They are taken to have been seen when that begins. The covariance of more than `whole_places` is in chunks.
        """
        order = np.argsort(landmarks.landmark_id, kind="stable")
        names, count = landmarks.landmark_id[order], len(order)
        number, none = np.arange(count), np.zeros(count, dtype=np.int64)
        off, then = np.zeros(count, dtype=np.bool_), np.zeros(count)
        p_here = np.clip(landmarks.p_exists[order], 0.0, SURVEYED)
        position, own = landmarks.position_m[order], landmarks.covariance_m2[order]
        dim = position.shape[1]
        turns = [part[order] for part in (landmarks.rotation, landmarks.rotation_covariance) if part is not None]
        covariance: JointCovariance = np.zeros((0, 0))
        if count:
            covariance = ChunkedCovariance.of_independent(position, own) if count > whole_places else block_diag(*own)
        return cls(
            members=Members(names, landmarks.class_id[order], number, off, off),
            sites=Sites(number, number, p_here, p_here, then, then),
            places=Places(number, names, position, none, none, *turns),
            stays=Stays.empty(dim),
            covariance_m2=covariance,
            class_names=landmarks.class_names,
            landmark_texts=tuple(sorted(name for one, name in landmarks.names.items() if is_text_of(name, one))),
            renamed=Renamed.of_file({one: name for one, name in landmarks.names.items() if not is_text_of(name, one)}),
            clock=landmarks.clock,
            up=landmarks.up if dim == 3 else Up(),
            n_cliques_ever=count,
            n_sites_ever=count,
        )

    def from_now_on(self, stamp_s: float) -> Self:
        """Return the map at its first session, which begins at `stamp_s`; surveyed landmarks are seen until then."""
        if np.isfinite(self.stamp_s) or not len(self.places):
            return self
        then = np.full(len(self.sites), stamp_s)
        return replace(self, stamp_s=stamp_s, sites=replace(self.sites, since_s=then, seen_s=then))

    @property
    def dim(self) -> int:
        """Coordinates of a position: 2, or 3 in space."""
        return int(self.places.position_m.shape[1])

    def _facts(self) -> dict[str, Any]:
        exists = (self.p_exists() >= EXISTS) & ~self.members.deleted
        return {
            "landmarks": len(self.members),
            "existing": int(exists.sum()),
            "bodies": len(np.unique(self.members.clique_id)),
            "sites": len(self.sites),
            "stays": len(self.stays),
            "classes": self.class_names,
            "seen_until_s": self.stamp_s,
            "clock": str(self.clock),
            **({"up": self.up.text} if self.dim == 3 else {}),
        }

    def to_pandas(self) -> Any:
        """Return a data frame with a row a landmark, as `landmarks` has them.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        return self.landmarks().to_pandas()

    def plot(self, *, title: str = "") -> Figure:
        """Draw the map, gone landmarks and the sensor positions; returns a matplotlib figure.

        Raises:
            InputError: there is nothing to draw.
        """
        return draw("plot_map", self, title=title)

    @property
    def landmark_names(self) -> dict[int, str]:
        """Names of landmarks that are called by more than a number, by their ids (`maps.names`)."""
        return dict(name_landmarks(self.landmark_texts, self.renamed))

    def label(self, landmark_id: int) -> str:
        """Return what a landmark is called: its name, or its number."""
        return landmark_label(landmark_id, name_landmarks(self.landmark_texts, self.renamed))

    def landmark_called(self, name: str) -> int:
        """Return the id of a landmark by what it is or was called, or by its id in digits; -1 where that is neither."""
        found = landmark_with(name, self.landmark_texts, self.renamed)
        if found is not None:
            return found
        if name.isdecimal() and len(name) <= MOST_DIGITS:
            return int(name)
        return next((one for one in self.members.landmark_id.tolist() if landmark_code(one) == name), -1)

    def with_name(self, landmark_id: int, name: str) -> LivingMap:
        """Return the map in which a landmark is called otherwise; '' takes an operator's name back.

        Raises:
            KeyError: no landmark has this id.
            InputError: not a name, or that of another landmark.
        """
        if landmark_id not in self.members.landmark_id:
            raise KeyError(landmark_id)
        numbers = self.members.landmark_id.tolist()
        return replace(self, renamed=rename(self.renamed, landmark_id, name, self.landmark_texts, numbers))

    def p_exists(self, at: float | None = None) -> FloatArray:
        """Return the (L,) probability that each landmark is at one of its known places.

        Args:
            at: stamp at which it is asked for, by what is learned of lifetimes; None for `stamp_s`.

        Raises:
            InputError: an earlier stamp than `stamp_s`; what was believed then is in an older revision.
        """
        if at is not None and not at >= self.stamp_s:
            problem = f"{at:g} s is before the map's newest look, {self.stamp_s:g} s"
            raise InputError(problem, field="at", hint="an older revision: store.load(number)")
        p_here = self.sites.p_here
        if (at is not None or len(self.dated)) and np.isfinite(self.stamp_s):
            from evermap.maps.sessions.believe import aged

            p_here = aged(self, USUAL, self.stamp_s if at is None else at).p_here
        return self.p_of_sites(p_here)

    def p_of_sites(self, p_here: FloatArray) -> FloatArray:
        """Return (L,) what the sites of each landmark's clique have in sum, of (S,)."""
        cliques, row = np.unique(self.sites.clique_id, return_inverse=True)
        total = np.append(np.bincount(row, p_here, minlength=len(cliques)), 0.0)  # row -1 is the last
        return np.asarray(total[rows_among(cliques, self.members.clique_id)], dtype=np.float64)

    def believed_s(self) -> FloatArray:
        """Return (S,) instants at which the beliefs in the sites held."""
        stamp_s = np.full(len(self.sites), self.stamp_s)
        stamp_s[np.searchsorted(self.sites.site_id, self.dated.site_id)] = self.dated.stamp_s
        return stamp_s

    def site_of(self, p_site: FloatArray | None = None) -> IntArray:
        """Return (L,) the most probable `site_id` of each landmark's clique, `UNKNOWN` where it has none; by the
        probabilities (S,) of the sites, None for those of the map.
        """
        order = np.lexsort((self.sites.p_here if p_site is None else p_site, self.sites.clique_id))
        clique = self.sites.clique_id[order]
        last = np.flatnonzero(np.diff(clique, append=-1) != 0)  # one a clique, by clique
        site = np.append(self.sites.site_id[order[last]], UNKNOWN)
        return np.asarray(site[rows_among(clique[last], self.members.clique_id)])

    def find_current_site(self) -> IntArray:
        """Return (L,) `site_id` of the current stay of each landmark's clique; `UNKNOWN` if away.

        Of a clique without a stay, as in maps made by hand, its most probable site, if it more probably stands.
        """
        site = np.where(self.p_of_sites(self.sites.p_here) >= EXISTS, self.site_of(), UNKNOWN)
        known = np.isin(self.members.clique_id, self.stays.clique_id)
        goes_on = np.flatnonzero(self.stays.gone_s == np.inf)
        order = goes_on[np.argsort(self.stays.clique_id[goes_on], kind="stable")]
        at = rows_among(self.stays.clique_id[order], self.members.clique_id)
        told = np.append(self.stays.site_id[order], UNKNOWN)[at]
        return np.asarray(np.where(at >= 0, told, np.where(known, UNKNOWN, site)))

    def place_row(self, landmark_id: IntArray, site_id: IntArray) -> IntArray:
        """Return (K,) rows of `places` for pairs of landmark and site, -1 if there is none."""
        return pair_rows((self.places.site_id, self.places.landmark_id), (site_id, landmark_id))

    def landmarks(
        self,
        *,
        at: float | None = None,
        within: tuple[float, float, float, float] | None = None,
        p_least: float = 0.0,
    ) -> Landmarks:
        """Return the map as plain records: every landmark at its most probable place, deleted ones left out.

        Args:
            at: stamp for which `p_exists` is asked, see there; None for `stamp_s`.
            within: leave out what lies outside of this box `(x_min, y_min, x_max, y_max)`, in metres of the map.
            p_least: leave out what exists with a smaller probability.

        Raises:
            InputError: `at` is earlier than the map's newest look, or the box is not of four numbers in this order.
        """
        row = self.place_row(self.members.landmark_id, self.site_of())
        p_exists = self.p_exists(at)
        kept = np.flatnonzero((row >= 0) & ~self.members.deleted & (p_exists >= p_least))
        if within is not None:
            box = np.asarray(within, dtype=np.float64)
            if box.shape != (4,) or not (box[:2] <= box[2:]).all():
                raise InputError(
                    f"{within!r} is not a box", field="within", hint="(x_min, y_min, x_max, y_max) in metres"
                )
            position = self.places.position_m[row[kept], :2]
            kept = kept[((position >= box[:2]) & (position <= box[2:])).all(axis=1)]
        row = row[kept]
        return self._records(row, self.place_covariance_m2(row), p_exists[kept])

    def _records(self, row: IntArray, covariance_m2: FloatArray, p_exists: FloatArray) -> Landmarks:
        """Places (K,) as plain records."""
        site = np.searchsorted(self.sites.site_id, self.places.site_id[row])
        name = self.places.landmark_id[row]
        oriented = self.dim == 3 and bool(np.isfinite(self.places.rotation).any())
        return Landmarks(
            landmark_id=name,
            position_m=self.places.position_m[row],
            covariance_m2=covariance_m2,
            class_id=self.members.class_id[np.searchsorted(self.members.landmark_id, name)],
            p_exists=p_exists,
            n_hits=self.places.n_hits[row],
            n_misses=self.places.n_misses[row],
            first_seen_s=self.sites.since_s[site],
            last_seen_s=self.sites.seen_s[site],
            class_names=self.class_names,
            frame="prior_map",
            clock=self.clock,
            names=self.landmark_names,
            rotation=self.places.rotation[row] if oriented else None,
            rotation_covariance=self.places.rotation_covariance[row] if oriented else None,
            size_m=self.boxes.of(name) if len(self.boxes) else None,
            up=self.up,
        )

    def place_covariance_m2(self, row: IntArray) -> FloatArray:
        """Return (K, 2, 2) covariances of places (K,), with the uncertainty of the map's scale about its middle."""
        middle = self.places.position_m.mean(axis=0) if len(self.places) else np.zeros(self.dim)
        arm = self.places.position_m[row] - middle
        size = self.log_size_variance * arm[:, :, None] * arm[:, None, :]
        return np.asarray(blocks(self.covariance_m2, self.dim)[row] + size)

    def list_sighted(self, p_site: FloatArray) -> Landmarks:
        """Return every place as a record of its own, in the order of `places`: what a robot may meet, by the
        probability (S,) of every site.
        """
        site = np.searchsorted(self.sites.site_id, self.places.site_id)
        member = np.searchsorted(self.members.landmark_id, self.places.landmark_id)
        rows = np.arange(len(self.places))
        own = blocks(self.covariance_m2, self.dim)
        return self._records(rows, own, np.where(self.members.deleted[member], 0.0, p_site[site]))

    def edited(self, landmark_id: int, *, pinned: bool | None = None, deleted: bool | None = None) -> LivingMap:
        """Return the map with an operator's edit of one landmark; None keeps a flag.

        Raises:
            KeyError: no landmark has this id.
        """
        row = int(np.searchsorted(self.members.landmark_id, landmark_id))
        if row >= len(self.members) or self.members.landmark_id[row] != landmark_id:
            raise KeyError(landmark_id)
        pins, deletions = self.members.pinned.copy(), self.members.deleted.copy()
        pins[row] = pins[row] if pinned is None else pinned
        deletions[row] = deletions[row] if deleted is None else deleted
        return replace(self, members=replace(self.members, pinned=pins, deleted=deletions))

    def without(self, landmark_ids: IntArray) -> LivingMap:
        """Return the map as if these landmarks had never been seen; bodies of which nothing is left go, too."""
        members = self.members[~np.isin(self.members.landmark_id, landmark_ids)]
        kept = np.flatnonzero(~np.isin(self.places.landmark_id, landmark_ids))
        places = self.places[kept]
        return replace(
            self,
            members=members,
            sites=self.sites[np.isin(self.sites.site_id, places.site_id)],
            dated=self.dated[np.isin(self.dated.site_id, places.site_id)],
            boxes=self.boxes[np.isin(self.boxes.landmark_id, members.landmark_id)],
            traits=self.traits[np.isin(self.traits.landmark_id, members.landmark_id)],
            places=places,
            stays=self.stays[np.isin(self.stays.clique_id, members.clique_id)],
            covariance_m2=taken(self.covariance_m2, kept, self.dim),
        )


def rows_among(ids: IntArray, asked: IntArray) -> IntArray:
    """Return (N,) the first row of each id among sorted ones, -1 where it is missing."""
    row = np.searchsorted(ids, asked)
    return np.where(np.append(ids, -1)[row] == asked, row, -1)


def clique_rows(sites: Sites) -> tuple[IntArray, IntArray]:
    """Return ids of the cliques that have sites, and for every site the row of its own."""
    cliques, row = np.unique(sites.clique_id, return_inverse=True)
    return cliques, row.ravel().astype(np.int64)


def class_of(living: LivingMap, cliques: IntArray) -> IntArray:
    """Return (C,) class of every clique: that of its members."""
    order = np.argsort(living.members.clique_id, kind="stable")
    first = np.searchsorted(living.members.clique_id[order], cliques)
    return np.asarray(living.members.class_id[order[first]])


def site_middles(living: LivingMap) -> FloatArray:
    """Return (S, 2) mean position of the places of every site, in space (S, 3)."""
    row = np.searchsorted(living.sites.site_id, living.places.site_id)
    count = np.maximum(np.bincount(row, minlength=len(living.sites)), 1)
    columns = [np.bincount(row, axis, minlength=len(living.sites)) / count for axis in living.places.position_m.T]
    return np.column_stack(columns)
