"""What a run returns: estimates, changes, causes and the verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from evermap.show import Shown, draw
from evermap.types.arrays import ArrayTable, FloatArray, IntArray
from evermap.types.landmarks import Landmarks, Trajectory
from evermap.types.measured import Misses
from evermap.types.names import landmark_label
from evermap.types.recording import AnyRecording

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class ParameterEstimate(Shown):
    """One calibration state or noise level with prior and estimate.

    Attributes:
        name: e.g. 'odometry_delay_s', 'range_bias_m', 'sigma_range_m'.
        value, sigma: estimate and standard deviation (0 where fixed).
        prior_mean, prior_sigma: the weak prior; nan where there is none.
        unit: 's', 'm', 'rad', '1' ...
        fixed: True where it was held: by the configuration, or because it is not needed.
        meaning: half a sentence for the report.
        p_needed: probability that it is another than stated, by which it is estimated; nan where that is not asked.
        alone: value if it were the only one of two errors that only show together; nan of others.
        shown_with: name of the other one; '' without.
        decided_by: keys of `sensor.toml` that divide what both show.
        evident: whether the readings say that one of the two is another than stated.
    """

    name: str
    value: float
    sigma: float
    prior_mean: float
    prior_sigma: float
    unit: str
    fixed: bool = False
    meaning: str = ""
    p_needed: float = float("nan")
    alone: float = float("nan")
    shown_with: str = ""
    decided_by: tuple[str, ...] = ()
    evident: bool = False


class Undecided(NamedTuple):
    """Two errors of which a recording only shows what they are together."""

    one: ParameterEstimate
    other: ParameterEstimate

    @property
    def text(self) -> str:
        """Return both readings in one line, with what decides between them."""
        alone = " or ".join(f"{each.name} = {each.alone:.4g}" for each in self)
        assumed = ", ".join(f"{each.name} = {each.value:.4g}" for each in self)
        decide = " or ".join(self.one.decided_by)
        return f"either {alone}, which this recording cannot tell (assumed: {assumed}); state {decide} in sensor.toml"


@dataclass(frozen=True, slots=True)
class Innovations(ArrayTable):
    """Innovations of detections before their use: one row per detection with a prediction.

    Attributes:
        stamp_s: (K,) frame stamps.
        detection: (K,) row of `Recording.detections`.
        landmark_id: (K,) landmark it was compared with.
        nis: (K,) squared Mahalanobis distance of the innovation, chi-square with `dof` degrees of freedom if honest.
        p_inlier: (K,) final probability that it is not an outlier, after smoothing.
        dof: (K,) numbers that each detection measured; None where all measured two, as in the plane.
    """

    stamp_s: FloatArray
    detection: IntArray
    landmark_id: IntArray
    nis: FloatArray
    p_inlier: FloatArray
    dof: IntArray | None = None


@dataclass(frozen=True, slots=True)
class AssociationEvidence(Shown):
    """What speaks for the landmarks that detections without identities were given; it needs no truth.

    Attributes:
        dropped: share of the detections that are of no landmark.
        n_landmarks: landmarks that were kept.
        n_alone: landmarks by odometry alone, each visit counted; -1 where it was not asked, as in space.
        n_closures: visits of landmarks that had been visited before; -1 where it was not asked.
        closure_nats: by how much these raise the negative log likelihood of the optimum: by one each, on average, if
            all are right.
        lead_nats: log evidence over odometry alone, where no landmark is met again; negative if that explains more.
    """

    dropped: float
    n_landmarks: int
    n_alone: int = -1
    n_closures: int = -1
    closure_nats: float = math.nan
    lead_nats: float = math.nan

    @property
    def nats_per_closure(self) -> float:
        """Return the rise of the negative log likelihood by each landmark that was met again; nan if none was."""
        return self.closure_nats / self.n_closures if self.n_closures > 0 else math.nan


class ChangeKind(StrEnum):
    """Kind of a change of a group of landmarks."""

    MOVED = "moved"
    """All members by the same displacement."""
    ROTATED = "rotated"
    """Like a rigid body: turned about their centroid, and moved."""
    SWAPPED = "swapped"
    """Two landmarks carry each other's identity."""
    APPEARED = "appeared"
    """Never seen before, in a place that had been looked at."""
    VANISHED = "vanished"
    """Not where the map has it, and nowhere else."""
    RETURNED = "returned"
    """It had vanished before; its displacement says whether to the place it had left."""
    REPLACED = "replaced"
    """Without identities: another one stands where one stood; or, with the rest of the probability, it is the same."""


@dataclass(frozen=True, slots=True)
class MapChange(Shown):
    """A difference between world and map: a change of a group of landmarks.

    Attributes:
        landmark_ids: the group, sorted; of a replacement those that stood there, then those that took their place.
        kind: kind of the change.
        stamp_from_s, stamp_to_s: it happened between these two; nan and the first stamp for 'before the session'.
        displacement_m: (x, y), in space (x, y, z), of the group's centroid, in the map's frame; nan where it was not,
            or is not, there.
        rotation_rad: about the centroid, counter-clockwise, in space about any axis; 0 where it did not turn.
        probability: of this very group at this time, over all hypotheses that were weighed.
        n_hits, n_misses: detections at the new place, and expected detections at the old one that did not come: in a
            living map misses count by how probably their lines of sight were clear.
        names: what the landmarks are called, if that is not their numbers; see `labels`.
        displacement_covariance_m2: in a living map rows of the covariance of `displacement_m`, by the joint Gaussian of
            both places, with that of the map's metre; () where it is not known.
    """

    landmark_ids: tuple[int, ...]
    kind: ChangeKind
    stamp_from_s: float
    stamp_to_s: float
    displacement_m: tuple[float, ...]
    rotation_rad: float
    probability: float
    n_hits: int = 0
    n_misses: int = 0
    names: tuple[str, ...] = field(default=(), compare=False)
    displacement_covariance_m2: tuple[tuple[float, ...], ...] = ()

    @property
    def displacement_sigma_m(self) -> float:
        """Standard deviation of its displacement along an axis, the root of their mean variance; nan if unknown."""
        spread = self.displacement_covariance_m2
        return math.sqrt(sum(row[k] for k, row in enumerate(spread)) / len(spread)) if spread else math.nan

    def named(self, names: Mapping[int, str]) -> MapChange:
        """Return the same with what its landmarks are called, where that is not their numbers."""
        labels = tuple(landmark_label(identity, names) for identity in self.landmark_ids)
        return self if labels == tuple(map(str, self.landmark_ids)) else replace(self, names=labels)

    @property
    def labels(self) -> tuple[str, ...]:
        """Return what its landmarks are called: their names, or their numbers."""
        return self.names or tuple(landmark_label(identity, {}) for identity in self.landmark_ids)


@dataclass(frozen=True, slots=True)
class Alternative(Shown):
    """Another explanation that the recording cannot rule out.

    Attributes:
        changes: what would have happened instead.
        probability: its weight among all hypotheses.
        landmarks: the map as it would be then.
    """

    changes: tuple[MapChange, ...]
    probability: float
    landmarks: Landmarks


class VerdictKind(StrEnum):
    """What a run ends with; it needs no truth."""

    SOUND = "sound"
    """Poses and landmarks are as certain as their covariances say."""
    WEAK = "weak"
    """Right as far as it goes, but something that matters can't be known from this recording."""
    LOST = "lost"
    """Poses or landmarks can't be trusted, and no cause was found."""
    MAP_OUTDATED = "map outdated"
    """Too much of the given map is wrong to localise in, or it is the map of another site, frame or edition."""
    SENSOR_SUSPECT = "sensor suspect"
    """A sensor, or the odometry, is not as stated: units, scale, size, clock, mount, axes, lens."""

    @property
    def is_trustworthy(self) -> bool:
        """Whether a run that ends so may be used as it is: exit code 0, else 3."""
        return self in (VerdictKind.SOUND, VerdictKind.WEAK)


@dataclass(frozen=True, slots=True)
class Symptom(Shown):
    """A sign, which needs no truth, of how far a run can be trusted.

    Attributes:
        code: stable name, such as `innovations`.
        message: one line, with numbers and units.
        value: what was measured.
        least, most: between which it is where all is well.
    """

    code: str
    message: str
    value: float
    least: float = -math.inf
    most: float = math.inf

    @property
    def is_alarming(self) -> bool:
        """Whether the value is where it should not be."""
        return not self.least <= self.value <= self.most


@dataclass(frozen=True, slots=True)
class Cause(Shown):
    """A cause other than a change of a landmark by which a recording contradicts what was stated.

    Attributes:
        code: stable name of the kind of cause, such as `tag-size` or `clock`.
        subject: what it is of: a sensor, a class, an identity, the odometry, the map; '' where there is one only.
        message: one line that a user understands, with value and unit.
        value, sigma: of the state that it frees, in the unit that `message` names; nan where there is none.
        probability: among all that was weighed.
        fix: the line of `sensor.toml`, or the option, that mends it; '' where there is none.
        nats: by how much it raises the log evidence of the recording, its price paid.
        instead: messages of the most probable explanation without it; '' where that is nothing.
    """

    code: str
    subject: str
    message: str
    value: float = math.nan
    sigma: float = math.nan
    probability: float = math.nan
    fix: str = ""
    nats: float = math.nan
    instead: str = ""


@dataclass(frozen=True, slots=True)
class Verdict(Shown):
    """What a run ends with: how far it can be trusted, and why.

    Attributes:
        kind: one of five words.
        message: one line: the reason, and what would decide it or mend it.
        symptoms: all that was asked, the alarming ones first.
        causes: those that were found, the most probable first.
    """

    kind: VerdictKind
    message: str
    symptoms: tuple[Symptom, ...] = ()
    causes: tuple[Cause, ...] = ()

    @property
    def text(self) -> str:
        """Return it in one line: 'lost: ...'."""
        return f"{self.kind}: {self.message}"


@dataclass(frozen=True, slots=True)
class SlamResult(Shown):
    """All estimates of a run.

    Attributes:
        trajectory: smoothed poses at every frame that has one, and in between where the gap is long.
        online: causal poses, one per frame; none in the plane unless `slam.online` asks for them.
        landmarks: the map.
        parameters: calibration states and noise levels.
        innovations: consistency of every detection.
        misses: expected and not detected.
        step_s: (N,) processing time of every frame; of frames that were solved together, the share of each.
        dead_reckoning: odometry alone from the first pose, at the stamps of `trajectory`.
        warnings: counted remarks of the estimator.
        interrupted: True where the run was stopped before the end of the recording.
        changes: how the world differs from the map that was given, or changed during the run.
        alternatives: other explanations nearly as probable as `changes`, the most probable first.
        gone: landmarks that the map knows but does not believe to be there.
        followed: what moved while it was looked at, a `evermap.tracking.run.TrackResult`; None where nothing was
            followed.
        causes: what other than changes of landmarks the recording was found to have.
        verdict: how far all this can be trusted; None where nobody asked.
        association: what speaks for the identities that were found; None where they were given.
    """

    trajectory: Trajectory
    online: Trajectory
    landmarks: Landmarks
    parameters: tuple[ParameterEstimate, ...]
    innovations: Innovations
    misses: Misses
    step_s: FloatArray
    dead_reckoning: Trajectory
    warnings: tuple[str, ...] = ()
    interrupted: bool = False
    changes: tuple[MapChange, ...] = ()
    alternatives: tuple[Alternative, ...] = ()
    gone: Landmarks = field(default_factory=lambda: Landmarks.at([], np.zeros((0, 2))))
    followed: Any = None
    causes: tuple[Cause, ...] = ()
    verdict: Verdict | None = None
    association: AssociationEvidence | None = None

    @property
    def is_trustworthy(self) -> bool:
        """Whether the verdict, where there is one, lets the result be used as it is."""
        return self.verdict is None or self.verdict.kind.is_trustworthy

    @property
    def undecided(self) -> tuple[Undecided, ...]:
        """Return errors that only show together, where the readings say that one is another than stated."""
        by_name = {one.name: one for one in self.parameters}
        pairs = [(one, by_name[one.shown_with]) for one in self.parameters if one.shown_with in by_name]
        return tuple(Undecided(*pair) for pair in pairs if pair[0].name < pair[1].name and pair[0].evident)

    def _facts(self) -> dict[str, Any]:
        return {
            **self.trajectory._facts(),
            "landmarks": len(self.landmarks),
            "parameters": len(self.parameters),
            "innovations": len(self.innovations),
            "misses": len(self.misses),
            "changes": len(self.changes),
            "alternatives": len(self.alternatives),
            "warnings": len(self.warnings),
            "interrupted": self.interrupted,
        }

    def plot(self, recording: AnyRecording | None = None) -> Figure:
        """Draw path and map; with its recording also the truth and the detections. Returns a matplotlib figure."""
        return draw("plot_result", self, recording)
