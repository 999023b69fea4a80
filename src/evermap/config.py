"""Everything that can be set: nested, frozen, every field with a default, a bound and a meaning.

A run needs no configuration. What is set comes from a TOML file, then from `--set slam.robust=false` overrides:

    config = load_config("my.toml", ["slam.seed=3"])

One file may hold the sections of all verbs; each verb reads its own. The sections in effect are written beside the
results (`summary.json`), and `to_toml` prints them with their meanings. This module needs pydantic and is therefore
imported only by what really runs, never by `import evermap`.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from evermap.errors import ConfigError, similar, suggestion
from evermap.types import DEFAULT_PRIOR, NOT_IN_SPACE, FloatArray, Sensor, SensorKind, SpatialSensor

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Probability = Annotated[float, Field(ge=0, le=1)]
Share = Annotated[float, Field(gt=0, lt=1)]
"""A probability that is neither zero nor one."""
Count = Annotated[int, Field(ge=1)]


def key(default: Any, meaning: str, **bounds: Any) -> Any:
    """Define a key of a section: its default, one line of meaning with the unit, and bounds as of pydantic's `Field`.

    A default that can be changed is copied for every section.
    """
    return Field(default=default, description=meaning, **bounds)


def part(section: Callable[[], Section], meaning: str) -> Any:
    """Define a section within a section."""
    return Field(default_factory=section, description=meaning)


class _RaisesOurErrors(ModelMetaclass):
    """Sections made from Python raise `ConfigError` as those from a file do; nested ones report the whole key."""

    def __call__(self, *args: Any, **values: Any) -> Any:
        try:
            return super().__call__(*args, **values)
        except ValidationError as error:
            raise config_error(self, error) from None


class Section(BaseModel, metaclass=_RaisesOurErrors):
    """Base of all sections: frozen, no unknown keys, no infinities or nan, every field with a default."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def __repr_args__(self) -> list[tuple[str | None, Any]]:
        """Show what was set, of two hundred keys."""
        return [(name, value) for name, value in super().__repr_args__() if name in self.model_fields_set]

    def to_dict(self) -> dict[str, Any]:
        """Return the section as plain JSON values, for `summary.json`."""
        return self.model_dump(mode="json")


def config_error(root: Any, error: ValidationError, path: Path | None = None) -> ConfigError:
    """Return the first thing that is wrong with values for `root` as an error of one line.

    Args:
        root: the section that the values were for.
        error: of its validation.
        path: file that the values came from.
    """
    first = error.errors(include_url=False)[0]
    names = [str(name) for name in first["loc"]]
    field = ".".join(names)
    if first["type"] == "extra_forbidden":
        return ConfigError("unknown key", path=path, field=field, hint=_nearest_key(root, names, first["input"]))
    told = first["ctx"]["error"] if first["type"] == "value_error" else None
    if isinstance(told, ValueError):
        return ConfigError(str(told), path=path, field=field or None)
    problem, hint = f"{first['msg'][:1].lower()}{first['msg'][1:]}, not {first['input']!r}", None
    if first["type"] == "literal_error":
        annotation: Any = root
        for name in names:
            annotation = annotation.model_fields[name].annotation
        hint = suggestion(str(first["input"]), _words_of(annotation))
    return ConfigError(problem, path=path, field=field, hint=hint)


def _words_of(annotation: Any) -> list[str]:
    """Return the words that a key of such a type may be."""
    return [option for option in get_args(annotation) if isinstance(option, str)]


def known_keys(section: type[Section], prefix: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the dotted names of all fields and of the sections that hold them."""
    for name, info in section.model_fields.items():
        yield ".".join((*prefix, name))
        if isinstance(info.annotation, type) and issubclass(info.annotation, Section):
            yield from known_keys(info.annotation, (*prefix, name))


def _nearest_key(root: type[Section], names: list[str], value: Any) -> str:
    """The known key that an unknown one means: of its name in any section, or similar; else the keys of its section.

    Args:
        root: the section that it was given to.
        names: of the key and the sections around it.
        value: that it was given; of a section that is not known, what that holds.
    """
    known, inner = list(known_keys(root)), names
    while isinstance(value, dict) and value:
        inner, value = [*inner, str(next(iter(value)))], next(iter(value.values()))
    for wanted in (inner, names):
        same_name = [key for key in known if key.rpartition(".")[2] == wanted[-1]]
        meant = similar(".".join(wanted), same_name, cutoff=0.0) or similar(".".join(wanted), known, cutoff=0.6)
        if meant:
            return meant
    section = max(
        (key.rpartition(".")[0] for key in known if ".".join(names).startswith(key.rpartition(".")[0])), key=len
    )
    return "one of " + ", ".join(key for key in known if key.rpartition(".")[0] == section)


SIGMAS = {
    "range_bias_m": 0.1,
    "range_slope": 0.02,
    "range_skew_per_rad": 0.1,
    "range_curvature_per_rad2": 0.5,
    "bearing_bias_rad": 0.05,
    "mount_forward_m": 0.03,
    "mount_left_m": 0.03,
    "odometry_delay_s": 0.3,
    "odometry_forward_scale": 0.05,
    "odometry_turn_scale": 0.1,
    "odometry_turn_slip_m": 0.05,
}
OfSensor = tuple[Positive, Positive, Positive, Positive, Positive]
KINDS: dict[SensorKind, OfSensor] = {
    SensorKind.LASER: (0.05, 0.002, 0.002, 0.002, 0.01),
    SensorKind.CAMERA: (0.1, 0.02, 0.1, 0.5, 0.05),
    SensorKind.TAG: (0.05, 0.02, 0.05, 0.1, 0.05),
    SensorKind.STEREO: (0.05, 0.02, 0.05, 0.1, 0.03),
    SensorKind.UWB: (0.3, 0.005, 0.02, 0.02, 0.05),
}
InSpace = tuple[Positive, Positive, NotNegative, NotNegative]
KINDS_IN_SPACE: dict[SensorKind, InSpace] = {
    SensorKind.LASER: (0.001, 0.02, 0.001, 0.003),
    SensorKind.CAMERA: (0.02, 0.02, 0.1, 0.005),
    SensorKind.TAG: (0.005, 0.005, 0.02, 0.005),
    SensorKind.STEREO: (0.01, 0.01, 0.03, 0.003),
    SensorKind.UWB: (0.003, 0.1, 0.002, 0.05),
}


class CalibrationConfig(Section):
    """Which calibration states are estimated, and what is believed of them before."""

    fix: dict[str, float] = key(
        {}, "calibration states held at a value instead of estimated, by name, e.g. odometry_delay_s = 0.0"
    )
    sigma: dict[str, Positive] = key(SIGMAS, "standard deviations of their priors, each in its own unit")
    kinds: dict[SensorKind, OfSensor] = key(
        KINDS, "those of the first five, which depend on the kind of sensor, where it is stated"
    )
    sigma_askew_rad: Positive = key(0.03, "of the direction in which a robot drives, from its front, if unstated [rad]")
    p_needed: Share = key(0.5, "prior probability that a state is not as stated")
    p_needed_sensor: Share = key(0.1, "the same of errors of ranges, for a laser or a sensor of no stated kind")
    p_needed_known: Share = key(0.9, "the same of a sensor that is stated to be of another kind than a laser")
    p_needed_mount: Share = key(
        0.1, "the same of each coordinate of the mount, which one measures, if it has no data sheet"
    )
    p_spare: Share = key(0.01, "probability to be needed below which a state is held as stated")

    @field_validator("sigma", "kinds")
    @classmethod
    def _all(cls, given: dict[Any, Any], info: ValidationInfo) -> dict[Any, Any]:
        usual: dict[Any, Any] = SIGMAS if info.field_name == "sigma" else KINDS
        if unknown := given.keys() - usual.keys():
            raise ValueError(f"no calibration state is called '{min(unknown)}': {', '.join(usual)}")
        return usual | given


class OdometryConfig(Section):
    """What is believed of the odometry, beside its noise."""

    silence_s: Positive = key(1.0, "gap of the odometry beyond which the last velocity is not continued [s]")
    silent_variance: Positive = key(0.25, "variance that such a silence adds every second, at least [m^2/s, rad^2/s]")
    longest_silence_s: Positive = key(60.0, "after a longer silence no more is unknown than after this [s]")
    turn_s: Positive = key(2.0, "span over which turns stand out from jitter [s]")
    stands_out: Positive = key(3.0, "standard deviations of the jitter by which it does")
    loose_rad: Positive = key(0.3, "heading that a silence leaves unknown, from which a recording is in parts [rad]")


class VotesConfig(Section):
    """Identities that were read wrongly, by other detections of the seconds around."""

    window_s: Positive = key(5.0, "before and after a detection, the odometry hardly drifts [s]")
    sigma_m: Positive = key(0.05, "error of a detection's place at no distance [m] ...")
    sigma_share: NotNegative = key(0.05, "... and as a share of its range")
    gate: Positive = key(2.0, "standard deviations within which another detection is of the same place")
    fewest: Count = key(2, "detections with another id that contradict one, at least ...")
    times: NotNegative = key(3.0, "... and more than so many times those with its own")
    fewest_doubles: Count = key(3, "frames that have an id at two places, from which on it is on two landmarks")
    surprising: Positive = key(50.0, "squared normalised residual from which a sighting disputes where its landmark is")


class RangesConfig(Section):
    """Detections without a bearing: where their landmarks are, before the estimator begins."""

    window_s: Positive = key(20.0, "span of ranges that locate a landmark, or the double, and so on [s]")
    drift_share: NotNegative = key(0.03, "drift of the odometry over it, as a share of the way")
    fewest: Count = key(6, "ranges that this takes")
    most_ranges: Count = key(200, "ranges that are used, at most")
    starts: int = key(16, "directions from which the place is sought", ge=4)
    steps: Count = key(30, "steps from each")
    tail: Positive = key(2.0, "standard deviations beyond which a range is probably an outlier")
    most_sigma_m: Positive = key(1.0, "standard deviation from which a place is not known [m]")
    apart_m: Positive = key(1.0, "distance from which another place is another one [m] ...")
    rival_nats: NotNegative = key(6.0, "... and how much worse it must be [nats]")
    first_m: Positive = key(1.0, "least standard deviation of the place at which the estimator begins [m]")


class RoomConfig(Section):
    """What tells that landmarks lie over a map from landmarks of another place, where each stands anywhere."""

    p_another_place: Share = key(1e-3, "probability that a session is from another place")
    smallest_room_m2: Positive = key(50.0, "minimum area in which moved landmarks may be found [m^2]")
    lowest_room_m: Positive = key(1.0, "height of a room in space, at least [m]")
    lead_nats: NotNegative = key(
        3.0, "log odds of an alignment over the next best one, from which it is accepted [nats]"
    )


class LocalizeConfig(RoomConfig):
    """When the place of a robot in a map is known, and when it is lost; landmarks are found by their identity."""

    fewest: Count = key(3, "landmarks that must have the relative positions of the map")
    p_stands: Share = key(0.9, "probability that a landmark is where the map has it, at most: groups move together")
    certain_nats: NotNegative = key(
        6.0, "log odds of an alignment over another place, from which it is accepted [nats]"
    )
    enough: Count = key(5, "landmarks of the map that a live session has met when it is entered")
    alone_s: NotNegative = key(10.0, "where no third landmark comes into view for so long, two are enough [s]")
    spread_m: Positive = key(1.0, "how far apart they must be, for a recording that is smoothed afterwards [m]")
    spread_online_m: Positive = key(
        2.0, "the same for a robot that is followed in the map: farther than on one body [m]"
    )
    track_s: Positive = key(30.0, "age of sightings that odometry still ties to the newest [s]")
    least_belief: Share = key(0.05, "least probability that a landmark is at its known place, if it is seen there")
    believed: Share = key(0.5, "belief from which not to be seen is a miss")
    sure_m: Positive = key(0.5, "no landmark is expected while the position is less certain than this [m]")
    least_p_detect: Share = key(0.01, "P(detect) from which a landmark is expected in view")
    doubt: Positive = key(1.0, "by which a place is doubted for each frame that has its landmark elsewhere [nats] ...")
    most_doubt: Positive = key(9.0, "... and by which in all, at most [nats]")
    remembered: Count = key(8, "landmarks, compared last, that judge whether the robot is lost")
    least_remembered: Count = key(3, "the same, at least")
    memory_s: Positive = key(20.0, "age up to which they do [s]")
    better_by: float = key(1.5, "times that another pose must fit better than this one", ge=1.0)


class ModesConfig(Section):
    """Landmarks with several positions (Nielsen and Hendeby 2024): gates, switching, selectors."""

    gate_probability: Probability = key(
        0.95, "a detection outside this confidence region of all modes starts a new mode"
    )
    switch_probability: Probability = key(
        1e-4, "probability of a landmark to be in another mode at the next look; ignored with a lifetime"
    )
    births: Literal["evidence", "gate"] = key(
        "evidence", "'evidence' keeps a new mode that explains more than it costs, 'gate' every one, as the paper does"
    )
    lifetime: str | None = key(
        None, "prior of how long a mode lasts, e.g. 'exponential:half-life=30d'; unset: constant"
    )
    rounds: int = key(10, "maximum rounds of selecting modes and relinearising", ge=1, le=100)
    mcts_budget: int = key(200, "iterations of the tree search for every decision", ge=1)
    mcts_window_s: Positive | None = key(40.0, "window of the tree search [s]; unset: from the start")


class ChangesConfig(Section):
    """The joint search over changes."""

    p_moved: float = key(0.01, "prior probability that anything moved at all", gt=0, lt=1)
    move_sigma_m: Positive = key(0.7, "standard deviation of a displacement, each axis [m]")
    p_rotated: Probability = key(0.1, "share of moves with a rotation")
    turn_sigma_rad: Positive = key(0.5, "standard deviation of such a rotation [rad]")
    rigid_m: Positive = key(0.005, "members of a group keep their distances to within this [m]")
    p_swapped: Share = key(1e-5, "probability that any two landmarks of a map were mixed up")
    displaced_log_odds: float = key(
        7.0, "prior log odds against a temporary displacement of a landmark [nats]", gt=0, le=50
    )
    map_factor_spread: Positive = key(0.35, "standard deviation of the logarithm of a factor on the sigmas of a map")
    softness_m: tuple[Positive, ...] = key(
        (0.005, 0.01, 0.02, 0.04),
        "candidate common errors of the sightings of a landmark in a part of the session; chosen by evidence [m]",
        min_length=1,
    )
    usual_softness_m: Positive = key(0.02, "the same during the search for swaps and temporary displacements [m]")
    most_groups: Count = key(4, "maximum number of moved groups")
    most_candidates: Count = key(40, "maximum number of candidates for moves, the likeliest")
    visit_gap_s: Positive = key(10.0, "gap between sightings after which a new visit begins [s]")
    interval: Share = key(0.95, "probability of the reported interval of a change")
    rival_nats: NotNegative = key(5.0, "maximum distance of a reported alternative from the best explanation [nats]")
    most_rivals: int = key(2, "maximum number of reported alternatives", ge=0)
    disagreement: Positive = key(4.0, "chi-square per degree of freedom above which a map without changes does not fit")
    loose_map_m: Positive = key(1.0, "standard deviation of a map that must not distort the session [m]")

    @property
    def spread(self) -> FloatArray:
        """(3,) standard deviations of a displacement in x [m] and y [m], and of its angle [rad]."""
        return np.array([self.move_sigma_m, self.move_sigma_m, self.turn_sigma_rad])


class CheckConfig(Section):
    """What makes a recording odd; see `slam.check`."""

    lags_s: tuple[Positive, ...] = key(
        (1.0, 4.0), "minimum time between compared sightings; the maximum is twice as long [s]", min_length=1
    )
    most_pairs: Count = key(1000, "pairs of sightings compared for each lag, at most")
    fits: Positive = key(0.03, "usual difference between two readings: share of the range, and rad")
    apart: Positive = key(3.0, "difference in median residuals by which a pair distinguishes two explanations")
    agreed: Share = key(0.8, "share of those pairs that a mistake must explain to be reported")
    fewest: Count = key(20, "minimum number of such pairs")
    gain: Positive = key(20.0, "minimum gain in log likelihood of a mistake over all pairs")
    off: Positive = key(0.3, "median residual above which readings and odometry are unrelated")
    own_ids: Count = key(
        50, "number of landmarks above which hardly any second sighting indicates that ids name detections"
    )
    far_off: Positive = key(5.0, "standard deviations of its prior beyond which a calibration state is reported")


class CleaningConfig(Section):
    """What is left out of the recording of a session as impossible; see `slam.cleaning`."""

    fastest: Positive = key(100.0, "speed above which odometry is dropped [m/s, rad/s]")
    hardest: Positive = key(20.0, "acceleration above which odometry is a spike [m/s^2, rad/s^2]")
    sharpest: Positive = key(2.0, "change of speed that is never a spike [m/s, rad/s]")
    too_far: float = key(2.0, "factor on the maximum range above which a reading is dropped", ge=1.0)
    far_from_median: float = key(100.0, "the same on the median range, for a sensor without a maximum range", ge=1.0)
    ranges_only: Share = key(0.2, "share of readings without a bearing above which a sensor measures ranges only")
    moved: Positive = key(0.1, "motion after which identical readings indicate stale data [m, rad]")
    stray_s: Positive = key(
        10.0, "distance from neighbouring stamps, and of frames from odometry, above which they are dropped [s]"
    )
    step_s: Positive = key(1.0, "smallest step of a clock that is repaired [s]")
    around: int = key(9, "messages that a stamp is compared with; an odd number", ge=3, le=999)

    @field_validator("around")
    @classmethod
    def _odd(cls, around: int) -> int:
        if around % 2 == 0:
            raise ValueError(f"must be an odd number, not {around}")
        return around


class ConstellationConfig(Section):
    """Maps that are aligned by the constellation of their landmarks alone."""

    near_m: Positive = key(0.5, "distance within which two landmarks are a pair, once aligned [m]")
    least_span_m: Positive = key(0.5, "landmarks that are closer than this fix no heading [m]")
    span_slack_m: NotNegative = key(0.2, "tolerance of distances within both maps, beside their uncertainty [m]")
    free_m: Positive = key(5.0, "standard deviation of the offset around a candidate motion [m]")
    free_rad: Positive = key(2.0, "standard deviation of its rotation [rad]")
    certain_nats: NotNegative = key(7.0, "evidence of an alignment over no alignment, and over its best rival [nats]")
    lead_nats: NotNegative = key(20.0, "the same over its best rival, if a large map was searched [nats]")
    stiff_m: Positive = key(0.2, "landmarks known this well relative to each other are one rigid part of a map [m]")
    longest_side_m: Positive = key(25.0, "longest side of an indexed triangle [m]")
    side_sigmas: Positive = key(3.4, "standard deviations by which the sides of matching triangles may differ ...")
    side_slack_m: NotNegative = key(0.02, "... and by this in addition [m]")
    same_place_m: Positive = key(5.0, "motions that differ by less at the centre of a session are one alignment [m]")
    least_found: Share = key(0.4, "least share of a group that must be found in a map")
    reach_m: Positive = key(15.0, "distance within which places are compared, once an alignment is known [m]")


class ReadingsConfig(Section):
    """Columns that describe landmarks, such as radius or colour."""

    misread_nats: NotNegative = key(2.995732273553991, "evidence of one reading for or against a match, at most [nats]")
    most_readings: Count = key(4, "readings that a visit counts as, at most: their errors are correlated")
    least_nats: NotNegative = key(0.1, "mean evidence per pair of visits, below which columns are not used [nats]")
    confidence: Share = key(0.999, "confidence that landmarks differ in a column, to use it")
    fewest_in_halves: int = key(6, "readings of a visit from which its first and second half are compared", ge=2)
    p_wrong: Share = key(0.1, "prior share of visits that are assigned to the wrong landmark ...")
    wrong_worth: Positive = key(2.0, "... and the visits that this prior counts as")
    preferred_nats: NotNegative = key(2.0, "gain in log likelihood that a smaller error of visits needs [nats]")
    fewest_pairs: Positive = key(3.0, "pairs of visits from which that error is learned")


class ParticlesConfig(Section):
    """Whole histories of associations, drawn where many detections are ambiguous."""

    new_nats: NotNegative = key(2.995732273553991, "log odds of clutter against a landmark that is new [nats]")
    wider: tuple[Positive, ...] = key(
        (1.2, 1.5), "factors on the noise of sightings, one after the other", min_length=1
    )
    bent: Positive = key(0.3, "error of known landmarks, as a share of the distance to the nearest one")


class AnonymousInSpaceConfig(Section):
    """The same in space, where it differs."""

    least_extent_m: Positive = key(1.0, "least extent of the landmarks along each axis [m]")
    least_volume_m3: Positive = key(20.0, "least volume that they span [m^3]")
    shared_rad: Positive = key(0.05, "error that all sightings of an orientation have in common [rad]")
    alike_rad: Positive = key(0.2, "spread of the orientations of landmarks on one wall [rad]")
    turn_sigmas: Positive = key(4.0, "standard deviations by which orientations of one landmark may differ ...")
    turn_floor_rad: Positive = key(0.1, "... where their least error is this [rad]")
    same_turn_rad: Positive = key(0.5, "alignments with a map whose orientation differs by less are one [rad]")
    tail: float = key(5.0, "factor on the error of detections in the tail ...", ge=1)
    tail_share: Share = key(0.1, "... and their share")
    widened: Positive = key(1.5, "factor on the variance of a detection, for the uncertainty of the poses")


class AssociationConfig(Section):
    """Landmarks without identities, associated by geometry."""

    gate_confidence: Share = key(0.999, "share of true pairs inside the gates")
    loose_gate: Positive = key(
        60.0, "squared distance up to which landmarks are compared, before shared errors are known"
    )
    p_match: Share = key(0.95, "probability from which a detection is assigned at once ...")
    p_return: Share = key(0.99, "... and to a landmark that was out of view, which closes a loop")
    tight_m2: Positive = key(0.04, "area of a gate in which a wrong choice is harmless for a while [m^2]")
    followed: float = key(2.0, "a landmark is tracked while it at most multiplies the noise of readings by this", ge=1)
    unmet_share: Share = key(0.1, "share of landmarks near tracked ones that are not mapped yet")
    p_new: Share = key(0.1, "probability to be new from which a detection starts a landmark")
    p_merge: Share = key(0.97, "probability from which two landmarks are merged")
    p_own: Share = key(0.5, "least probability of the landmark that a detection ends with")
    forget_s: Positive = key(20.0, "gap after which a new visit begins, and landmarks with too few sightings go [s]")
    fewest_to_pair: Count = key(2, "sightings from which two landmarks may be merged")
    least_landmarks: Positive = key(2.0, "least number of landmarks in their density ...")
    least_area_m2: Positive = key(20.0, "... and the least area that they span [m^2]")
    odometry_caution: Positive = key(2.0, "factor on the odometry noise during association")
    slip: Positive = key(3.0, "factor on that in a step with slipping wheels ...")
    slip_nats: NotNegative = key(2.995732273553991, "... and its prior log odds [nats]")
    noise_caution: Positive = key(1.3, "factor on the learned noise of sightings")
    noise_floor: Positive = key(0.5, "prior of that noise, as a share of the stated one ...")
    pseudo_sightings: Positive = key(100.0, "... and the sightings that this counts as")
    clipped_at: Positive = key(9.0, "squared normalised residual that counts in full where variances are learned")
    shared_m: Positive = key(0.02, "error that all sightings of a landmark have in common [m] ...")
    shared_share: NotNegative = key(0.5, "... and as a share of their range noise")
    name_nats: NotNegative = key(
        4.605170185988092, "evidence of an identity that two landmarks share, per reading [nats] ..."
    )
    most_names: Count = key(10, "... of which so many count, at most")
    rise_nats: NotNegative = key(7.0, "rise of the cost that is accepted for a merge [nats] ...")
    rise_per_sighting: NotNegative = key(1.75, "... for each sighting of the lesser one [nats] ...")
    most_rise_nats: NotNegative = key(100.0, "... and in all, at most [nats]")
    landmark_nats: NotNegative = key(7.0, "cost of a further landmark [nats]")
    few_nats: NotNegative = key(7.0, "evidence for merging two pairs or one, while later frames may tell more [nats]")
    double_nats: NotNegative = key(5.0, "evidence against a pair for each frame that shows both [nats]")
    in_turn_nats: NotNegative = key(0.2, "evidence for a pair for each frame that shows only one of them [nats] ...")
    most_in_turn_nats: NotNegative = key(10.0, "... and in all, at most: one may hide the other")
    around_frames: Count = key(3, "frames before and after, in which it should have been seen")
    contradiction: Share = key(0.95, "confidence from which a visit contradicts all others")
    fewest_displaced: Count = key(4, "landmarks from which a stretch is displaced as a whole")
    least_seen: Share = key(1.0 / 3.0, "sightings below this share of the usual number are of no landmark")
    doubtful_share: Probability = key(0.008, "share of ambiguous detections from which particles are drawn")
    p_closed: Probability = key(1e-4, "chance of so bent an odometry, if all closed loops are right, below which, too")
    bent_nats: Positive = key(3.0, "... and nats for each landmark met again above which it is told; 1 is right")
    dropped_share: Share = key(0.4, "share of detections of no landmark above which it is told")
    constellation: ConstellationConfig = part(ConstellationConfig, "aligned maps")
    readings: ReadingsConfig = part(ReadingsConfig, "columns of detections")
    particles: ParticlesConfig = part(ParticlesConfig, "drawn histories")
    space: AnonymousInSpaceConfig = part(AnonymousInSpaceConfig, "points and tags")


class MapInSpaceConfig(Section):
    """What of a given map in space stands where it says, and what was moved."""

    sigma: Positive = key(0.02, "standard deviation of landmarks that state none [m, rad]")
    scale_sigma: float = key(
        0.02,
        "standard deviation of the odometry's scale, if unstated, where a given map tells it; 0: exact",
        ge=0,
        le=1,
    )
    loose_m: Positive = key(0.05, "least standard deviation of a map before static landmarks are identified [m, rad]")
    pseudo_count: Positive = key(6.0, "residuals that the accuracy which a map states counts for where that is learned")
    p_moved: Share = key(0.03, "probability that a landmark moved since the map was made")
    moved_m: tuple[Positive, ...] = key((0.15, 0.5, 2.0), "standard deviations of how far, all alike [m]", min_length=1)
    moved_rad: tuple[Positive, ...] = key((0.05, 0.5), "standard deviations of its turn, all alike [rad]", min_length=1)
    moved_nats: NotNegative = key(5.0, "what it costs that a landmark was moved, instead of the robot [nats]")
    least_seen: Positive = key(1.0, "sum of inlier probabilities below which a landmark was not seen at its place")
    drift_rad: Positive = key(0.02, "standard deviation of the orientation of unmoved landmarks between sessions [rad]")
    p_told: Share = key(0.5, "probability from which a landmark is reported as moved")


class RepairConfig(Section):
    """Other explanations of the same views in space: poses, orientations, and identities that several carry."""

    stretch_nats: Positive = key(6.0, "by which a stretch of frames must prefer other poses to try them [nats]")
    gain_nats: Positive = key(3.0, "by which all must be more probable in the end [nats]")
    jumps: Count = key(4, "stretches between jumps of the odometry that are tried without these together, at most")
    other_rad: Positive = key(0.3, "orientations that differ by more are two [rad]")
    same_rad: Positive = key(0.05, "orientations that agree to within this are the same [rad]")
    together_m: Positive = key(0.5, "outliers of one identity that are this close are another landmark [m]")
    fewest: Count = key(5, "detections that this takes")
    fewest_frames: Count = key(3, "frames that it takes")


class TrafficConfig(Section):
    """Boxes without identity around a robot with odometry: errors that repeat themselves, by what stands."""

    sigma_scale: Positive = key(0.05, "standard deviation of the scale of ranges, a share")
    sigma_bend: Positive = key(
        1e-3, "angle that the odometry turns too little by the metre, standard deviation [rad/m]"
    )
    error_log_odds: float = key(-3.0, "prior log odds that there is such an error [nats]", ge=-50, le=50)
    still_mps: Positive = key(0.1, "standard deviation of the measured velocity of a static object [m/s]")
    moving_mps: Positive = key(3.0, "the same of what moves [m/s]")
    witnesses: Count = key(10, "fewest objects that must show a drift of the odometry")
    better_by: float = key(2.0, "factor by which their residuals must become smaller", ge=1.0)
    tilt_rad: Positive = key(0.05, "boxes are upright to within this [rad]")


class BodiesConfig(Section):
    """Bodies that carry landmarks, and may move while the robot is there."""

    limit_mps: Positive = key(0.15, "speed at which it is as probable that a body stands as that it moves [m/s]")
    margin_s: NotNegative = key(0.5, "time before and after a motion in which nothing of it is used [s]")
    unseen_s: Positive = key(5.0, "a body that was not seen for longer may have moved in the meantime [s]")


class UpConfig(Section):
    """Where up is in a map in space, which its floor, figures from above and Nav2's files need."""

    direction: tuple[float, float, float] | None = key(
        None, "direction of up in the frame of the map, as [0, 0, 1]; without: as measured, or as the robot moved"
    )
    spread_m: Positive = key(
        0.5,
        "least standard deviation of positions along the second axis of a plane of motion [m]: within the reach of "
        "an arm, 1.7 m, a hand may move a camera in any plane",
    )
    flatness: Share = key(0.25, "greatest standard deviation across a plane of motion over that along its second axis")
    turned: Share = key(
        0.5, "least variance of the headings on the circle that shows an axis of all turns: 160 degrees evenly"
    )
    sway_rad: Positive = key(0.2, "greatest standard deviation about such an axis [rad]: what is carried level")
    wheels_rad: Positive = key(0.01, "the same of an odometry of wheels, which has no other turns [rad]")
    tags: Count = key(3, "fewest tags on walls that show that a camera is not upside down ...")
    tags_agree: Share = key(0.8, "... if at least this share of them hang upright in it")
    evident: Share = key(
        0.5,
        "least cosine between an axis and the sensors' up that tells which end of it is up, and of a mean direction",
    )

    @field_validator("direction")
    @classmethod
    def _check_direction(cls, given: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if given is not None and not 0.0 < math.hypot(*given) < math.inf:
            raise ValueError("three numbers, not all zero, as [0, 0, 1]")
        return given


class SpaceConfig(Section):
    """What is believed of sensors in space, and estimated beside poses and landmarks."""

    mount_sigma_m: float = key(
        0.0, "standard deviation of the mounts' positions [m]; 0: exactly as stated", ge=0, le=10
    )
    mount_sigma_rad: float = key(
        0.0, "standard deviation of the mounts' orientations [rad]; 0: exactly as stated", ge=0, le=3
    )
    scale_sigma: float = key(
        0.005,
        "standard deviation of the odometry's scale, where tags of known sizes tell it, or nothing does (directions); "
        "0: exact",
        ge=0,
        le=1,
    )
    delay_sigma_s: float = key(
        0.3, "standard deviation of the delay of the sensors' stamps [s]; 0: no delay", ge=0, le=10
    )
    range_scale: float | None = key(
        None,
        "factor on the ranges of boxes without identity; unset: estimated from static objects, in the odometry's scale",
        gt=0.5,
        lt=2.0,
    )
    kinds: dict[SensorKind, InSpace] = key(
        KINDS_IN_SPACE,
        "of a stated kind of sensor: standard deviation of the scale of its ranges, a share, and the next three keys",
    )
    sigma_m: Positive = key(
        0.005, "noise of unstated positions at no range [m], to start from: it is learned by range ..."
    )
    sigma_along: NotNegative = key(0.02, "... along the ray, as a share of the range ...")
    sigma_across: NotNegative = key(0.01, "... and across")
    sigma_rad: Positive = key(0.05, "standard deviation of an orientation that states none [rad]")
    sigma_px: Positive = key(2.0, "noise of a tag's corners in the image, to start from [px]")
    corner_m: Positive = key(1e-3, "position of a tag by its corners is no better than this [m]")
    widest: Positive = key(3.0, "corners farther off the axis than this, over the depth, are not used")
    nearest_m: Positive = key(0.02, "nothing nearer to a sensor than this is used [m]")
    range_within_s: Positive = key(15.0, "views within this time give a detection without range one [s]")
    least_parallax: Positive = key(0.25, "largest standard deviation of such a range, as a share of it")
    drift_m: Positive = key(0.05, "drift of odometry to start from [m/sqrt(s)]")
    drift_rad: Positive = key(0.02, "the same of its heading [rad/sqrt(s)]")
    steady_m: Positive = key(3e-4, "no odometry drifts less than this [m/sqrt(s)]")
    steady_rad: Positive = key(1e-5, "the same of its heading [rad/sqrt(s)]")
    hand_mps: Positive = key(1.0, "how fast a camera without odometry may go [m/s]")
    hand_radps: Positive = key(0.7, "and turn [rad/s]")
    tied_s: NotNegative = key(0.25, "frames without odometry this close are tied by how far it may go between them [s]")
    pseudo_count: Positive = key(10.0, "residuals that noise levels to start from count for in what is learned")
    least_noise: tuple[Positive, Positive, Positive, Positive, Positive, Positive] = key(
        (1e-4, 1e-5, 0.05, 0.05, 0.05, 0.03),
        "least noise levels that are learned: drift [m, rad by sqrt(s)], across, along, turn, corners [px]",
    )
    outlier_log_odds: tuple[Positive, Positive, Positive] = key(
        (10.5, 14.0, 16.0), "half the squared residual at which positions, poses and corners are as likely outliers"
    )
    jump_log_odds: Positive = key(
        28.0, "the same of odometry, which may slip: six numbers, each a hundred times as wide"
    )
    inlier: Share = key(0.5, "inlier probability, or sum of such, from which something was seen")
    field_margin_rad: NotNegative = key(0.02, "a field of view is as wide as what was seen in it, and this wider [rad]")
    range_margin: float = key(1.1, "nothing is expected farther than this times the farthest", ge=1.0)
    usual_range: Share = key(0.9, "share of sightings that were nearer than what a look at an empty place reaches")
    faced: Share = key(0.2, "median cosine of incidence from which landmarks are taken to have a face")
    widest_rad: float = key(1.4835298641951802, "incidence from which a face is hardly seen [rad]", gt=0, lt=1.6)
    up: UpConfig = part(UpConfig, "where up is")
    map: MapInSpaceConfig = part(MapInSpaceConfig, "a map that is given")
    repair: RepairConfig = part(RepairConfig, "other explanations")
    traffic: TrafficConfig = part(TrafficConfig, "boxes without identity")
    bodies: BodiesConfig = part(BodiesConfig, "landmarks on bodies that move")

    @field_validator("kinds")
    @classmethod
    def _all_kinds(cls, given: dict[SensorKind, InSpace]) -> dict[SensorKind, InSpace]:
        return KINDS_IN_SPACE | given


class ExplainConfig(Section):
    """Causes other than changes of landmarks: when they are asked, and what they must gain."""

    on: bool = key(True, "ask for causes where a session contradicts what was stated")
    rejected: Share = key(0.08, "share of rejected detections from which causes are asked")
    innovations: Positive = key(1.35, "mean squared normalised innovation, a number, from which causes are asked")
    states: Positive = key(4.0, "standard deviations of a calibration state from its prior from which causes are asked")
    noise: Positive = key(3.0, "factor of a noise level on what is stated from which causes are asked")
    late_s: Positive = key(0.1, "delay of a clock from which it is told as a cause, though estimated anyway [s]")
    map_changed: Share = key(0.4, "share of a given map that has changed from which the map itself is asked")
    lead_nats: NotNegative = key(6.0, "log evidence by which a cause must win, its price paid [nats]")
    most_causes: Count = key(2, "causes that are combined, at most")
    most_tried: Count = key(4, "causes under which a session is solved again, for each that is added, at most")
    most_solutions: Count = key(12, "solutions in all, at most")


class NoiseConfig(Section):
    """Noise levels that a run starts from, where the sensor states none."""

    sigma_range_m: Positive = key(0.1, "standard deviation of ranges [m]")
    sigma_bearing_rad: Positive = key(0.02, "standard deviation of bearings [rad]")
    forward_by_distance: Positive = key(0.05, "of forward motion, by distance [m/sqrt(m)]")
    forward_by_turn: Positive = key(0.05, "of forward motion, by angle turned [m/sqrt(rad)]")
    sideways_by_distance: Positive = key(0.03, "of sideways motion, by distance [m/sqrt(m)]")
    turn_by_time: Positive = key(0.01, "of turning, by time [rad/sqrt(s)]")
    turn_by_turn: Positive = key(0.05, "of turning, by angle turned [rad/sqrt(rad)]")
    pseudo_count: Positive = key(1.0, "pseudo-residuals of these levels")


class SlamConfig(Section):
    """The estimator."""

    method: Literal["nohyp", "max-mixture", "nn", "em", "mcts", "viterbi", "joint"] = key(
        "joint", "method that finds moved landmarks; 'nohyp' assumes a static world"
    )

    sensor_model: Literal["calibrated", "plain"] = key(
        "calibrated", "'calibrated' estimates sensor and odometry errors with the map, 'plain' trusts all readings"
    )
    unknown_ids: bool | Literal["empty"] = key(
        False, "associate by geometry: true ignores all identities, 'empty' associates only detections without one"
    )
    vote_ids: bool = key(
        True,
        "remove identities that other detections at the same place within seconds contradict, and those on "
        "two landmarks",
    )
    robust: bool = key(True, "down-weight detections with a wrong identity; off only for comparison")
    outlier_log_odds: float = key(
        7.0, "an outlier is as likely as an inlier at a squared normalised residual of twice this", gt=0, le=50
    )
    fewest_sightings: Count = key(3, "fewest sightings that locate a landmark: one or two may have a wrong identity")
    rejected_in_a_row: Count = key(
        5, "sightings of a landmark in a row, rejected as outliers, from which another optimum is sought"
    )
    narrowing: tuple[Positive, ...] = key(
        (10.0, 3.0), "noise of detections on the way to that optimum, as multiples of what it is"
    )
    estimate_noise: bool = key(True, "learn noise levels from the recording; off: keep the nominal ones")
    odometry_noise_factor: Positive = key(1.0, "factor on the initial odometry noise, kept if estimate_noise is off")
    online: bool = key(False, "also compute what the robot knew at the time of each frame: `online.tum`, step times")
    plane: bool | None = key(
        None, "estimate a recording in space in the plane, or not; without: where it is one of a robot on a floor"
    )
    seed: int = key(0, "random seed", ge=0)
    calibration: CalibrationConfig = part(CalibrationConfig, "calibration states")
    modes: ModesConfig = part(ModesConfig, "methods 'max-mixture' to 'viterbi': landmarks with several positions")
    changes: ChangesConfig = part(ChangesConfig, "method 'joint': groups of moved landmarks")
    noise: NoiseConfig = part(NoiseConfig, "noise levels to start from")
    explain: ExplainConfig = part(ExplainConfig, "causes other than changes of landmarks")
    odometry: OdometryConfig = part(OdometryConfig, "silences and jitter of the odometry")
    votes: VotesConfig = part(VotesConfig, "identities that were read wrongly")
    association: AssociationConfig = part(AssociationConfig, "landmarks without identities")
    ranges: RangesConfig = part(RangesConfig, "detections without a bearing")
    localize: LocalizeConfig = part(LocalizeConfig, "where a robot is in a map")
    space: SpaceConfig = part(SpaceConfig, "sensors in space")
    check: CheckConfig = part(CheckConfig, "thresholds of the recording check")
    cleaning: CleaningConfig = part(CleaningConfig, "limits for dropping defects of a recording")


class SensorConfig(Section):
    """Corrections of what the recording says about its sensor; unset fields keep the recording's value."""

    range_min_m: float | None = key(None, "minimum range [m]", ge=0)
    range_max_m: Positive | None = key(None, "maximum range [m]")
    bearing_min_rad: float | None = key(None, "right edge of the field of view [rad]", ge=-3.2, le=3.2)
    bearing_max_rad: float | None = key(None, "left edge of the field of view [rad]", ge=-3.2, le=3.2)
    sigma_range_m: Positive | None = key(None, "nominal range noise [m]; a starting value")
    sigma_bearing_rad: Positive | None = key(None, "nominal bearing noise [rad]; a starting value")
    p_detect: Probability | None = key(None, "probability of detecting a landmark in view")
    p_false: Probability | None = key(None, "probability of a false detection in a frame")
    mount_robot_sensor: tuple[float, float, float] | None = key(
        None, "pose of the sensor on the robot: x [m], y [m], theta [rad]"
    )
    kind: SensorKind | None = key(None, "kind of sensor, which sets the priors of its errors")
    sigma_scale: float | None = key(None, "relative standard deviation of the scale of its ranges", ge=0, le=1)
    sigma_offset_m: float | None = key(None, "standard deviation of the offset of its ranges [m]", ge=0)
    sigma_angle_rad: float | None = key(None, "standard deviation of its mounting angle [rad]", ge=0, le=6.3)
    sigma_position_m: float | None = key(
        None, "standard deviation of its position on the robot, along each axis [m]", ge=0, le=1e3
    )
    sigma_odometer_scale: float | None = key(
        None, "relative standard deviation of the scale of the odometer", ge=0, le=1
    )
    sigma_askew_rad: float | None = key(
        None, "standard deviation of the driving direction relative to the front [rad]", ge=0, le=6.3
    )

    def applied_to(self, sensor: Sensor) -> Sensor:
        """Return the recording's sensor with the fields that are set here; ConfigError if then nothing can be in
        view.
        """
        merged = replace(sensor, **self.model_dump(exclude_none=True))
        for low, high in (("range_min_m", "range_max_m"), ("bearing_min_rad", "bearing_max_rad")):
            if getattr(merged, low) >= getattr(merged, high):
                problem = f"{getattr(merged, low):g} is not below {high} = {getattr(merged, high):g}"
                raise ConfigError(problem, field=f"sensor.{low}")
        return merged

    def applied_in_space(self, sensors: Sequence[SpatialSensor]) -> tuple[SpatialSensor, ...]:
        """Return the sensors of a recording in space with the fields that are set here, each the same.

        Raises:
            ConfigError: a field that means nothing in space, or nothing can be in range.
        """
        given = self.model_dump(exclude_none=True)
        for name, hint in NOT_IN_SPACE.items():
            if name in given:
                raise ConfigError("is not used for a recording in space", field=f"sensor.{name}", hint=hint)
        merged = tuple(replace(sensor, **given) for sensor in sensors)
        for one in merged:
            if one.range_min_m >= one.range_max_m:
                problem = f"{one.range_min_m:g} is not below range_max_m = {one.range_max_m:g}"
                raise ConfigError(problem, field="sensor.range_min_m")
        return merged


class OutputConfig(Section):
    """What is written beside the numbers."""

    figures: bool = key(True, "draw the figures")
    report: bool = key(True, "write report.html")
    rerun: bool = key(False, "write scene.rrd for the rerun viewer, if rerun-sdk is installed")
    mcap: bool = key(False, "write run.mcap for Foxglove and ROS 2, which needs rosbags")
    score_rate_hz: float = key(2.0, "rate at which a trajectory is compared with truth", gt=0, le=1000)


class FitConfig(Section):
    """When a session is believed to lie in the map, and which of its landmarks are believed."""

    least_fit: Share = key(0.75, "share of the sightings consistent within the session that must also fit the map")
    most_lost: Share = key(
        0.03, "if this larger share of sightings fits within the session than with the map, the session is distorted"
    )
    inlier: Share = key(0.5, "inlier probability above which a sighting counts")
    sightings: Positive = key(1.5, "inliers that a landmark needs to be accepted")
    sightings_in_place: Positive = key(0.5, "the same for a landmark at its place in the map")
    misread_m: Positive = key(0.3, "distance within which a landmark may be another one with a misread identity [m]")
    misread_share: Share = key(
        0.2, "maximum share of sightings for that, if it is never in one frame with the other one"
    )
    glimpse_m: Positive = key(0.4, "a landmark seen once this close to its place is present [m]")
    bent_m: Positive = key(0.15, "tolerance within which bodies with a common motion indicate a distorted session [m]")
    bent_cliques: int = key(3, "minimum number of bodies with a common motion for that", ge=2)
    window: Count = key(12, "sightings by which each pose of a distorted session is aligned")
    bent_windows: Count = key(3, "so many of these that contradict the rest are wrong poses, not misread identities")
    placing_m: Positive = key(0.3, "residual above which sightings are down-weighted in that [m]")
    loose_m: Positive = key(0.5, "position uncertainty above which silent odometry splits a session into parts [m]")
    loose_rad: Positive = key(0.1, "the same for the heading [rad]")


class OverlayConfig(RoomConfig):
    """Priors of the search for what stands where the map has it."""

    nudge_m: Positive = key(0.7, "standard deviation of a small move, each axis [m]")
    share_nudged: Share = key(0.5, "share of moves that are small; the others are unbounded")
    turn_m: Positive = key(0.35, "standard deviation of the rotation of a moved body, at its members [m]")
    share_turned: Share = key(0.1, "share of moves in space that are turns of a landmark in its place")
    turned_m: Positive = key(0.05, "standard deviation of the position of one turned in its place, each axis [m]")
    p_split: Share = key(1e-3, "probability that landmarks assigned to one body are not")
    drifts_m: tuple[Positive, ...] = key(
        (0.01, 0.02, 0.04, 0.08),
        "candidate standard deviations of unmoved landmarks from session to session, the likeliest first [m]",
        min_length=1,
    )
    drifts_in_space_m: tuple[Positive, ...] = key(
        (0.003, 0.001), "more of these in space, less likely than the others [m]"
    )
    free_m: Positive = key(20.0, "standard deviation of a session's place around the one agreed on, each axis [m]")
    free_rad: Positive = key(3.0, "the same of its heading [rad]")
    stood_rad: tuple[Positive, ...] = key(
        (0.02, 0.06, 0.15),
        "standard deviations of a common apparent turn of unmoved landmarks in space [rad]",
        min_length=1,
    )
    turned_rad: tuple[Positive, ...] = key((0.2, 1.0), "the same of landmarks that were moved [rad]", min_length=1)
    p_coarser: Share = key(0.5, "probability of each of these drifts, relative to the one before")


class MetreConfig(Section):
    """What sessions and robots say of the length of a metre, together."""

    walk: Positive = key(0.002, "standard deviation by which a map's metre wanders in a session, as a share")
    contradicts: Positive = key(4.0, "standard deviations from which a session's metre contradicts the map's")
    p_drifted: Share = key(0.05, "probability that a robot's metre is not what its sensor is said to know")
    drifted: float = key(4.0, "times by which it is off then, as standard deviation", ge=1.0)
    p_told: Share = key(0.95, "probability from which a robot is reported as drifted")


class NamelessConfig(Section):
    """Landmarks without identities in a map: by their constellation."""

    fewest: Count = key(4, "landmarks that must be found in the map together")
    farthest_m: Positive = key(2.0, "how far a landmark that is the same may be off [m]")
    bent_m: Positive = key(2.0, "the same behind a stretch that is bent [m]")
    p_found: Share = key(0.9, "probability that a landmark next to a detected one is detected, too")
    share_exchanged: Share = key(0.01, "share of landmarks that are where another one of their class was")
    fewest_compared: Count = key(5, "certain matches that tell by how much columns differ between sessions")


class BoxesConfig(Section):
    """Boxes without identity in a map: which are the same from session to session."""

    drift_m: Positive = key(0.2, "standard deviation of the position of an unmoved box between sessions, each axis [m]")
    height_m: Positive = key(0.5, "the same of its height over a street that is not flat [m]")
    far_share: Share = key(0.3, "share of boxes that are off by more ...")
    far_factor: float = key(3.0, "... namely by so many times that", ge=1.0)
    sigma_size_m: tuple[Positive, Positive, Positive] = key(
        (0.4, 0.15, 0.15), "standard deviations of one box's size, session to session [m]"
    )
    sigma_class_m: tuple[Positive, Positive, Positive] = key(
        (0.6, 0.2, 0.25), "standard deviations of the sizes of boxes of one class [m]"
    )
    size_nats: Positive = key(8.0, "evidence of size or heading against a match, at most [nats]")
    heading_rad: Positive = key(0.15, "standard deviation of headings [rad]")
    round: Positive = key(1.3, "boxes less long than this times their width have no heading")
    odd_share: Share = key(0.05, "share of boxes that one of two sessions sees with any size of their class")
    other_class_nats: float = key(-3.0, "log odds of being detected as of another class", le=0.0)
    density: Positive = key(0.02, "least density of static boxes [1/m^2]")
    p_taken: Share = key(0.2, "usual probability that another box takes the place of one that left")
    beside_m: Positive = key(0.5, "usual standard deviation of where that stands, each axis [m]")
    haste_nats: Positive = key(1.0, "standard deviation of the logarithm of a factor on the hazards of a session")
    p_stands: Share = key(0.9, "probability that a box is detected at its place again")
    returns: Share = key(0.5, "prior probability that an arrival at a former place of a box is that box")
    least_gone: Share = key(0.02, "least probability that a box left a place now taken")
    same_share: Positive = key(0.6, "boxes closer than this share of their widths are merged")
    at_once_s: NotNegative = key(5.0, "a box that is detected again at its place within this time had not left [s]")
    named_m: Positive = key(0.5, "a landmark with an identity is where the map has it, if this near [m]")
    shared_pairs: int = key(3, "boxes that must agree with the odometry's frame ...", ge=2)
    shared_nats: NotNegative = key(4.0, "... and evidence that it takes [nats]")
    found_pairs: int = key(4, "boxes that must agree with a place that was searched for ...", ge=2)
    enough_pairs: int = key(8, "... and so many end the search", ge=2)
    lead_nats: NotNegative = key(12.0, "by which that place must beat all others [nats]")
    metre_sigmas: NotNegative = key(2.0, "standard deviations by which a session's metre must be off to be corrected")
    near_m: Positive = key(30.0, "how far boxes may be off behind a stretch in which nothing was seen [m]")
    largest_turn_rad: Positive = key(0.3, "how far they may be turned then [rad]")
    drift_share: NotNegative = key(0.02, "how far odometry may be off from one box to the next, of the distance")
    most_drift_m: Positive = key(0.5, "the same, at most [m]")
    misfit: Positive = key(3.0, "mean squared deviation of boxes from which the odometry is believed less")
    among_m: Positive = key(15.0, "boxes of the map this near: a session was here before [m]")
    least_share: Share = key(0.3, "share of the boxes seen among those of the map that must be boxes of it")
    perhaps: Share = key(0.2, "belief from which a box of the map counts for that")
    tied_m: Positive = key(80.0, "beyond this distance from the landmarks shared with the map, misses are ignored [m]")
    glimpse_m: Positive = key(1.0, "a detection this near to a box of the map may be of it, at no range [m] ...")
    glimpse_share: NotNegative = key(0.01, "... and farther off by this share of its range")
    fewest_glimpses: Count = key(2, "such detections that a session takes")
    behind_m: Positive = key(1.5, "what is this much farther than another box is hidden [m] ...")
    covered: Positive = key(0.4, "... within this share of that box's length from its middle")


class LooksConfig(Section):
    """What counts as having looked at a place of the map."""

    range_margin_m: Positive = key(
        0.2, "softness of the edge of a sensor's range, where errors of pose and map decide [m]"
    )
    bearing_margin_rad: Positive = key(0.05, "the same of its field of view [rad]")
    worth_a_look: Share = key(0.3, "share of a sensor's detection probability from which a landmark is looked at")
    settled_s: NotNegative = key(300.0, "a landmark seen this close to a look was there [s]")
    settled_online_s: NotNegative = key(10.0, "the same while the robot drives, as long as the session is not over [s]")
    beside_m: Positive = key(1.0, "sightings this close to a place are along its line [m]")
    beside_rad: Positive = key(0.15, "so is a landmark seen behind it within this angle [rad]")
    along_m: Positive = key(0.3, "distance from a line of sight within which a sighting shows it to be clear [m]")
    witnesses: Count = key(3, "frames in which another landmark must be seen along a line")
    sides: Count = key(6, "number of sectors around a place")
    most_sides: Count = key(3, "sectors from which a place counts as seen from all sides")
    together_m: NotNegative = key(2.0, "cliques missed from places this close may be hidden by one object [m]")
    near_m: NotNegative = key(0.6, "a place is visible from positions this close to one from which it was seen [m]")
    least_expected: Positive = key(2.0, "minimum expected detections of earlier looks")
    sure: Share = key(0.9, "probability from which something new is told to have come after a look, not an earlier one")
    lasting: Share = key(0.5, "share of the places hidden in a session that are hidden in all earlier ones")
    sticky: float = key(2.0, "consecutive frames that count as one independent one", ge=1.0)
    flank_rad: Positive = key(
        0.7, "angle within which something is seen on both sides of what a map has and is missed [rad]"
    )
    flank_share: Share = key(0.6, "least range of that, as a share of the range of what is missed")
    elsewhere_m: Positive = key(
        1.0, "distance between positions from which something narrow hides different places [m]"
    )
    one_sided_rad: Positive = key(2.1, "angle over which a landmark of unknown orientation must be missed [rad]")
    p_flanked_hidden: Share = key(0.05, "probability that it is hidden from one position all the same")
    p_always_hidden: Share = key(0.003, "probability that it is hidden from all")
    p_gone: Share = key(0.03, "probability that a landmark of a given map is nowhere")


class DecisionConfig(Section):
    """What is told of a session, and what a map forgets."""

    least_evidence: NotNegative = key(
        1.5, "log likelihood ratio of looks against a clique before it is reported as vanished"
    )
    least_looks: NotNegative = key(
        0.9, "detections that its misses stand for, each by how probably its line was clear, before it is reported so"
    )
    credible: Share = key(
        0.6, "a missed clique is gone only if it also is under the upper bound of this lifetime interval"
    )
    same_place_m: Positive = key(0.3, "bodies this close to the former place of another one have taken its place [m]")
    same_turn_rad: Positive = key(0.3, "bodies turned by less than this have not turned [rad]")
    same_spot_m: Positive = key(0.1, "bodies this close to their former place have not moved [m]")
    new_clique_p: Share = key(0.9, "belief in a new body before its sightings are counted")
    surely_away: Probability = key(0.02, "belief below which a clique may be forgotten")
    forgotten_p: Probability = key(0.05, "probability of a return below which it is forgotten")
    most_away: int = key(20, "absent cliques that are kept, in addition to the number of present ones", ge=0)
    most_stays: Count = key(5000, "newest stays from which lifetimes are learned")


class GroupingConfig(Section):
    """Which landmarks are on one body, by how they moved."""

    p_one_body: Share = key(0.9, "probability that two landmarks of a clique are on one body")
    p_split_before: Share = key(0.05, "the same for two nearby ones of different cliques")
    p_other_class: Share = key(0.001, "the same for two nearby ones of different classes")
    p_moved: Share = key(0.1, "probability that a body moves between two sessions")
    move_sigma_m: Positive = key(2.0, "standard deviation of displacements, each axis [m]")
    misses_in_a_row: float = key(4.0, "misses of one session that count as one independent one", ge=1.0)
    p_wrong: Share = key(1e-3, "probability that a landmark's identity is misread for a whole session")


class LifetimeConfig(Section):
    """How lifetimes are learned from the history of a map."""

    newest: Count = key(300, "newest stays of a class from which its lifetime is learned")
    strength: Positive = key(2.0, "pseudo-events of the average over classes in each class")
    least_ended: Count = key(5, "ends in a chunk before it has its own lifetimes")
    sure: Share = key(0.999, "probability above which an end of a stay counts as certain")
    firmness: tuple[Positive, ...] = key(
        (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0),
        "candidate numbers of pseudo-ends of a class in its chunks; learned",
        min_length=1,
    )


class SightConfig(Section):
    """What is believed of lines of sight, and how it is learned."""

    most_looks: Positive = key(
        200.0, "maximum looks along one line; beyond it, old ones fade, so that a moved wall is learned"
    )
    strength: Positive = key(4.0, "pseudo-looks of the rate of all clear lines of that length")
    nominal_looks: Positive = key(20.0, "pseudo-looks of the nominal rate")
    p_blocked_detect: Share = key(0.03, "detection rate along blocked lines")
    least_rate: Share = key(0.002, "minimum detection rate of any kind of line")
    highest_rate: Share = key(0.98, "maximum detection rate of any kind of line")
    rate_sigma: NotNegative = key(
        1.0, "standard deviation of the log of the factor by which a sensor may detect less than others; 0: never"
    )
    rate_looks: Positive = key(5.0, "maximum looks at one place in a session from which this is learned")
    neighbour: Probability = key(0.35, "weight of looks from the eight cells around, in looks along the line")
    clear: Share = key(0.9, "probability above which a line is known to be clear")
    blocked: Share = key(0.25, "probability below which a line is known to be blocked")
    p_hidden_unseen: Share = key(
        0.1, "probability that a place is hidden for a whole session (a shut door) if its lines were clear before"
    )
    p_hidden_beside: Share = key(0.03, "the same if another landmark is seen along them now")
    p_hidden_unknown: Share = key(0.2, "the same if they were unknown, but a landmark close to them and behind is seen")
    hidden_looks: Positive = key(5.0, "pseudo-sessions of these probabilities")
    most_sessions: Positive = key(2000.0, "sessions of cliques after which old ones fade")

    @property
    def p_hidden(self) -> tuple[float, float, float]:
        """That a place cannot be seen for a whole session, by what is known of its lines; see `SightLines.hidden`."""
        return self.p_hidden_unseen, self.p_hidden_beside, self.p_hidden_unknown

    @property
    def rates(self) -> tuple[float, float]:
        """Bounds of detection rates along lines."""
        return self.least_rate, self.highest_rate


class LivingConfig(Section):
    """A map that lives on from session to session; parts are switched off only to see what they contribute."""

    search: Literal["joint", "gate", "none"] = key(
        "joint",
        "how a session is aligned with the map: 'joint' searches over all moves together, with the "
        "trajectory marginalised; 'gate' tests one clique after the other, at the aligned poses; 'none': "
        "nothing moves",
    )
    accept: Literal["sound", "weak", "any"] = key(
        "sound",
        "verdicts with which a session enters the map by itself: 'sound' ones only, 'weak' ones, too, or 'any', "
        "whatever is wrong with it",
    )
    existence: bool = key(True, "misses lower P(exists); off: landmarks exist permanently")
    returns: bool = key(True, "absent landmarks may return; off: they never do (Rosen 2016)")
    misses: bool = key(True, "use misses as evidence")
    cliques: bool = key(True, "landmarks on one body share one belief")
    clique_reach_m: Positive = key(1.6, "largest extent of a body that landmarks may share [m]")
    learn_lifetimes: bool = key(True, "learn lifetimes from this map's history; off: a wide prior")
    prior_stays: int = key(
        20, "pseudo-stays of a given lifetime prior, in addition to those of the map", ge=1, le=100_000
    )
    learn_sight: bool = key(True, "learn lines of sight; off: the nominal field of view")
    whole_places: Count = key(
        600,
        "maximum places of a map that is updated as a whole; in a larger one a session updates only its surroundings",
    )
    near_m: Positive = key(10.0, "margin beyond the sensor's range of the surroundings of a session [m]")
    most_sites: int = key(3, "maximum sites of one clique", ge=1, le=100)
    clock_gap_s: NotNegative | None = key(
        None,
        "time between two sessions whose clocks start anew: each begins so long after the last one [s]; not set: "
        "sessions of one robot that overlap in time are refused",
    )
    fit: FitConfig = part(FitConfig, "acceptance of a session")
    overlay: OverlayConfig = part(OverlayConfig, "priors of moves")
    sight: SightConfig = part(SightConfig, "lines of sight")
    looks: LooksConfig = part(LooksConfig, "definition of a look")
    decisions: DecisionConfig = part(DecisionConfig, "reporting and forgetting")
    grouping: GroupingConfig = part(GroupingConfig, "assignment of landmarks to bodies")
    metre: MetreConfig = part(MetreConfig, "the length of a metre")
    nameless: NamelessConfig = part(NamelessConfig, "landmarks without identities")
    boxes: BoxesConfig = part(BoxesConfig, "boxes without identities")
    lifetimes: LifetimeConfig = part(LifetimeConfig, "learning of lifetimes")


class LiveConfig(Section):
    """A session that is fed while the robot drives."""

    reorder_s: NotNegative = key(0.1, "maximum delay of a reading behind the newest one, by their stamps [s]")
    checkpoint_s: Positive = key(
        5.0, "interval at which readings are written to the disk: a crash loses so much, and some tenths more [s]"
    )
    revision_s: NotNegative = key(
        300.0, "interval at which the drive enters the map as a revision; 0: only at the end [s]"
    )
    readings_hz: Positive = key(
        300.0, "maximum mean rate of readings that enter the map; above it, whole frames are left out"
    )
    idle_s: Positive = key(60.0, "odometry that is kept where nothing is mapped, at least [s]")
    clocks_s: Positive = key(5.0, "more than the clocks of one robot are apart [s]")
    beliefs_s: Positive = key(300.0, "looks over so long become beliefs, and are not asked again [s]")
    judge_s: Positive = key(5.0, "interval between searches for changes [s]")
    look_s: Positive = key(0.5, "time between two frames whose looks are used for that [s]")


NO_RECURRENCE = "none"


class PersistConfig(Section):
    """Beliefs, changes and forecasts of a table of looks."""

    prior: str = key(DEFAULT_PRIOR, "lifetime of features that stay once")
    class_priors: dict[str, str] = key({}, "the same for single classes, by name")
    recurrent: str = key(NO_RECURRENCE, "how features return: 'none' for one stay, a kind of model to learn, or 'auto'")
    per: Literal["auto", "all", "class", "feature"] = key("auto", "which features share a learned model")
    model: str = key("", "file of a learned model; '' learns it from the table")
    learn_from: int = key(
        100_000, "maximum number of looks to learn from: all looks at a random subset of features", ge=2
    )
    most_features_alone: Count = key(32, "with more features, 'auto' learns one model for all")
    fewest_looks_alone: Count = key(200, "looks per feature above which 'auto' learns a model for each")
    query: Literal["times", "grid"] = key(
        "times", "'times' asks for the belief at the time of every row, 'grid' at regular times"
    )
    step_s: Positive | None = key(None, "step of grid and forecasts [s]; unset: chosen")
    horizon_s: Positive | None = key(
        None, "how far to forecast beyond the latest look [s]; unset: a share of the looks' span"
    )
    forecast_steps: Count = key(10, "steps of a forecast, where step_s is unset")
    grid_steps: Count = key(200, "about so many steps of the grid, where step_s is unset")
    horizon_share: Positive = key(0.25, "horizon as a share of the span, where none is given")
    confidence: float = key(0.9, "belief above which a change is reported", gt=0.5, lt=1.0)
    tail: float = key(
        0.025, "probability that a change lies before the interval given for it, and as much after it", gt=0.0, lt=0.5
    )
    p_miss: Probability = key(0.1, "P(no detection | there) if the table has no p_miss")
    p_false: Probability = key(0.1, "P(detection | not there) if the table has no p_false")
    figures: int = key(12, "number of features with an individual figure", ge=0)
    rows_at_once: int = key(5_000_000, "rows that are held in memory; a larger Parquet table is done in parts", ge=1)

    @property
    def stays_once(self) -> bool:
        """Whether features have one lifetime and never return."""
        return self.recurrent == NO_RECURRENCE and not self.model

    @property
    def learns(self) -> bool:
        """Whether a model is learned from the looks."""
        return self.recurrent != NO_RECURRENCE and not self.model


class StillConfig(Section):
    """Which tracks of boxes stand and which move, by all of their detections."""

    sigma_m: Positive = key(0.1, "error of where a box is detected, at no range [m] ...")
    sigma_share: NotNegative = key(0.01, "... and as a share of its range")
    alike_s: NotNegative = key(0.5, "for how long such errors are alike [s]")
    still: Positive = key(0.25, "standard deviation of a static object's velocity, over its class's speed limit")
    moving: Positive = key(4.8, "the same of what moves; at the limit both are as probable")
    window_s: Positive = key(2.0, "time over which a velocity is estimated [s]")
    least_s: Positive = key(0.4, "time that a track or a stay must last [s] ...")
    fewest: Count = key(4, "... and detections that it takes")
    p_stands: Share = key(0.9, "probability from which an object is taken to be static")
    same_m: Positive = key(0.5, "stays this close are one [m]")
    elsewhere_m: Positive = key(2.0, "what left was farther away than this [m]")
    when_s: NotNegative = key(0.5, "when a thing came to rest, or left, is known to within this to both sides [s]")


class ShapeConfig(Section):
    """Sizes and headings of boxes, and what a detector makes of them."""

    misplaced: float = key(16.0, "times the variance of its noise, of a box that is found beside its place ...", ge=1.0)
    p_misplaced: Share = key(0.02, "... and how often that is")
    other_size: Positive = key(0.25, "sizes of other objects differ by this share")
    p_misshapen: Share = key(0.05, "share of detections with an arbitrary size or heading")
    turning: NotNegative = key(0.5, "random walk of a heading: the end of a box moves sideways by this [m/sqrt(s)]")
    resizing: NotNegative = key(0.01, "random walk of a size, as a share of it [1/sqrt(s)]")
    forward_nats: Positive = key(3.0, "log odds that the heading of a detection is not reversed: one in 20 is")
    most_forward_nats: Positive = key(
        7.0, "log odds that this may be sure by: three opposite detections turn it, two do not"
    )
    sure_of_way: Positive = key(
        9.0, "squared forward speed over its variance from which the motion decides the heading"
    )


class TrackerConfig(Section):
    """What the tracker assumes about objects and their detector."""

    motion: Literal["acceleration", "velocity"] = key(
        "acceleration", "constant quantity of the motion model: nine states, or six"
    )
    motion_density: Positive = key(
        0.1, "spectral density, each axis, of white jerk [m^2/s^5] or white acceleration [m^2/s^3]"
    )
    sigma_velocity_mps: Positive = key(1.0, "standard deviation of a new object's velocity, each axis [m/s]")
    sigma_acceleration_mps2: Positive = key(0.5, "the same for its acceleration [m/s^2]")
    sigma_position_m: Positive = key(0.3, "noise of a detection without a covariance, each axis [m]")
    gate_probability: Share = key(0.9999, "share of an object's own detections within its gate")
    p_detect: Share = key(0.9, "probability to detect an object in view, without a detection model")
    clutter_per_m3: Positive = key(1e-4, "false detections and first sightings per frame and cubic metre")
    p_real: Share = key(0.5, "probability that an unassigned detection is an object, not a false alarm")
    sigma_face_m: NotNegative = key(0.05, "noise of the position of a face of a detected box [m] ...")
    sigma_face_share: NotNegative = key(0.035, "... and as a share of the box's size")
    speed_per_length_hz: NotNegative = key(
        3.0, "standard deviation of a new box's speed along its heading, in its lengths per second [Hz]"
    )
    score_midpoint: float = key(
        3.7, "score at which a first detection is as likely real as false, unless all are in [0, 1]"
    )
    score_scale: Positive = key(1.2, "increase of the score that adds one to the log odds of that")
    score_memory: float = key(0.85, "weight of an object's older scores after each newer one", gt=0.0, le=1.0)
    seen_nats: NotNegative = key(0.4, "factor on the log of the number of detections in the log odds of being real")
    missed_nats: NotNegative = key(1.0, "reduction of the log odds of being real by every frame without a detection")
    p_believed: Share = key(0.5, "belief by scores above which a tracklet is ALIVE, for detections with scores")
    p_confirm: Share = key(0.999, "belief above which a tracklet is ALIVE")
    p_dead: Share = key(0.01, "belief below which a tracklet is DEAD")
    warm_up: Count = key(3, "detections that a tracklet needs to be ALIVE")
    lost_after: Count = key(3, "consecutive frames without a detection until a tracklet is LOST")
    max_missed: Count = key(
        10, "consecutive frames without a detection until it is deleted, or stored if it is at rest"
    )
    vanish_rate_hz: NotNegative = key(1e-3, "rate at which objects in view cease to exist [1/s]")
    class_speed_mps: Positive | tuple[Positive, ...] = key(
        0.5, "speed above which an object is dynamic [m/s]: one for all, or one per class"
    )
    rest_for_s: NotNegative = key(2.0, "time without motion before an object is static [s]")
    p_off_class: Share = key(0.05, "probability of a wrong class, without a confusion matrix")
    appearance_nats: NotNegative = key(20.0, "log likelihood ratio between equal appearances and unrelated ones")
    appearance_neutral: float = key(0.7, "cosine of two appearances that is no evidence", ge=-1.0, lt=1.0)
    appearance_memory: float = key(0.9, "weight of the old appearance after a new detection", ge=0.0, lt=1.0)
    place_sigma_m: Positive = key(0.2, "position tolerance of re-identification at rest, in addition to the noise [m]")
    moved_reach_m: NotNegative = key(
        0.0, "how far objects may be moved while out of view, 0 if never; needs appearances [m]"
    )
    p_moved: Share = key(0.01, "probability of that")
    chunk_m: Positive = key(10.0, "side of the working set's square chunks [m]")
    judge_every_s: NotNegative = key(
        1.0, "time between two looks that are independent evidence about the working set [s]"
    )

    least_p_detect: Share = key(1e-3, "least probability to detect an object: a model of the view is not exact")
    fast_sigmas: Positive = key(2.33, "standard deviations above its class's speed from which an object is dynamic")
    displaced: Positive = key(
        30.66, "squared normalised distance at which a position is another place: one in a million"
    )
    most_counted: Count = key(50, "largest number of detections that counts as evidence")
    p_empty: Share = key(1e-3, "probability of misses in a row at which a place has been seen to be empty")
    leave_rates_hz: tuple[Positive, Positive] = key(
        (1e-8, 1e-2), "rates of leaving a place, where nothing is known: from, to [1/s]"
    )
    slow_step_s: Positive = key(2.0, "frame interval beyond which a warning says that motion is poorly observed [s]")
    shape: ShapeConfig = part(ShapeConfig, "sizes and headings of boxes")
    still: StillConfig = part(StillConfig, "static objects beside a moving robot")

    @property
    def order(self) -> int:
        """Derivatives of the position that are estimated, itself included: 3 or 2."""
        return 3 if self.motion == "acceleration" else 2

    def confusion_matrix(self, n_classes: int, given: FloatArray | None) -> FloatArray:
        """Return (C, C) `P(detected class | true class)`, a row a true class: the given one, or one of equal mistakes.

        Raises:
            ConfigError: a matrix of another shape, or rows that are not distributions.
        """
        if given is None:
            if n_classes == 1:
                return np.ones((1, 1))
            matrix = np.full((n_classes, n_classes), self.p_off_class / (n_classes - 1))
            np.fill_diagonal(matrix, 1.0 - self.p_off_class)
            return matrix
        matrix = np.ascontiguousarray(given, dtype=np.float64)
        if matrix.shape != (n_classes, n_classes):
            raise ConfigError(f"shape {matrix.shape} instead of ({n_classes}, {n_classes})", field="confusion")
        sums = matrix.sum(axis=1)
        fine = (matrix >= 0.0).all(axis=1) & (np.abs(sums - 1.0) < 1e-6)
        if not fine.all():
            row = int(np.argmin(fine))
            problem = f"row {row} is not a distribution over detected classes (sum {sums[row]:g})"
            raise ConfigError(problem, field="confusion", hint="rows are true classes and sum to 1")
        return matrix

    def class_speeds(self, n_classes: int) -> FloatArray:
        """Return (C,) the speed above which an object of each class is dynamic.

        Raises:
            ConfigError: another number of speeds than of classes.
        """
        speeds = np.atleast_1d(np.asarray(self.class_speed_mps, dtype=np.float64))
        if len(speeds) not in {1, n_classes}:
            raise ConfigError(f"{len(speeds)} speeds for {n_classes} classes", field="class_speed_mps")
        return np.ascontiguousarray(np.broadcast_to(speeds, (n_classes,)))


class TrackConfig(TrackerConfig):
    """Objects over time from a table of detections, and how long they stay."""

    speeds_mps: dict[str, Positive] = key({}, "speed above which objects of single classes are dynamic, by name [m/s]")
    prior: str = key(DEFAULT_PRIOR, "lifetime of objects at rest")
    class_priors: dict[str, str] = key({}, "the same for single classes, by name")
    range_m: Positive | None = key(None, "range of the sensor [m]; unset: misses are no evidence")
    fov_deg: float | None = key(
        None,
        "horizontal field of view, ahead of the sensor [deg], with `range_m` and poses; unset: from the detections",
        gt=0.0,
        le=360.0,
    )
    all_around_deg: float = key(
        225.0, "field of view from which on detections are of a sensor that sees all around [deg]", gt=0.0, le=360.0
    )
    p_all_around: Share = key(
        1e-4, "chance that a sensor that sees all around shows all that close together, below which the view is narrow"
    )
    min_score: float | None = key(None, "minimum score of detections; unset: none")
    gap_s: Positive | None = key(
        None, "a longer time between two frames counts as a gap without looks [s]; unset: chosen"
    )
    gap_steps: float = key(10.0, "that time in usual steps, if gap_s is unset", gt=1.0)


class SurvivalConfig(Section):
    """Lifetimes estimated from a table of which only bounds are known."""

    estimator: str = key("npmle", "estimator, as listed by `evermap survival fit --help`")
    by: str = key("", "groups that are estimated separately: '', 'class', 'chunk', or 'class,chunk'")
    chunk_m: Positive = key(10.0, "side of the square chunks [m]")


UNREAD_IN_THE_PLANE = ("slam.space", "slam.association.space", "track", "living.boxes")
UNREAD_IN_SPACE = (
    "slam.method", "slam.sensor_model", "slam.outlier_log_odds", "slam.rejected_in_a_row",
    "slam.narrowing", "slam.odometry_noise_factor", "slam.calibration", "slam.modes",
    "slam.changes", "slam.noise", "slam.odometry", "slam.ranges", "slam.localize", "slam.cleaning", "slam.check",
    "slam.association.particles", "living.metre",
)  # fmt: skip
UNREAD_WITHOUT_BOXES = ("track", "living.boxes", "slam.space.traffic", "slam.space.range_scale")
UNREAD_WITHOUT_MAP = ("living.search", "living.metre", "living.lifetimes", "living.boxes", "living.prior_stays")
"""Keys and sections that `evermap slam` does not read for some recordings: setting one is refused."""


class Config(Section):
    """The whole configuration, one section a table of the TOML file."""

    slam: SlamConfig = part(SlamConfig, "the estimator")
    living: LivingConfig = part(LivingConfig, "a living map")
    sensor: SensorConfig = part(SensorConfig, "overrides of the recording's sensor")
    output: OutputConfig = part(OutputConfig, "additional outputs")
    persist: PersistConfig = part(PersistConfig, "a table of looks")
    track: TrackConfig = part(TrackConfig, "a table of detections")
    survival: SurvivalConfig = part(SurvivalConfig, "a table of lifetimes")
    live: LiveConfig = part(LiveConfig, "a live session")


def load_config(
    path: str | Path | None = None,
    overrides: Iterable[str] = (),
    values: Mapping[str, Any] | None = None,
    *,
    within: str = "",
) -> Config:
    """Return the configuration of a TOML file (or the defaults), then overridden key by key.

    Args:
        path: TOML file with the tables of `Config`; None for the defaults.
        overrides: `section.key=value` each; the value in TOML notation, or a bare word for a string.
        values: further overrides by key, as values; None leaves a key as it is.
        within: section that keys without a dot are taken to be of.

    Raises:
        ConfigError: unreadable file, unknown key (the nearest known one is named), or a value out of its bounds.
    """
    source = None if path is None else Path(path)
    return _overridden(_validate(_read_toml(source), source), overrides, values or {}, within)


RETIRED = ("living.lifetimes.prior_quantiles", "living.lifetimes.prior_shortest_s", "living.lifetimes.prior_longest_s")
"""Keys of earlier versions which nothing reads any more; maps keep them with the settings of their sessions."""


def parse_config(text: str) -> Config:
    """Return the configuration that `to_toml` wrote, of this version or of an earlier one; '' for the defaults.

    Raises:
        ConfigError: a key or a value that this version does not know.
    """
    content = tomllib.loads(text)
    for key_path in RETIRED:
        *sections, name = key_path.split(".")
        section: Any = content
        for each in sections:
            section = section.get(each, {})
        section.pop(name, None)
    return _validate(content, None)


def with_overrides(config: Config, overrides: Iterable[str]) -> Config:
    """Return `config` with `section.key=value` overrides; errors as `load_config`."""
    return _overridden(config, overrides, {}, "")


def refuse_unread(overrides: Iterable[str], unread: Mapping[str, Iterable[str]], *, within: str = "") -> None:
    """Refuse overrides of what is not read, which would change nothing.

    Args:
        overrides: as of `load_config`.
        unread: keys and sections, by why they are not read.
        within: as of `load_config`.

    Raises:
        ConfigError: names the first such key.
    """
    for override in overrides:
        key = _dotted(override.partition("=")[0], within)
        for why, names in unread.items():
            if any(f"{key}.".startswith(f"{name}.") for name in names):
                raise ConfigError(f"would change nothing: not read {why}", field=key, hint="leave it out")


def to_toml(config: Config) -> str:
    """Return a commented TOML file that `load_config` reads back. Unset fields are commented out."""
    return "\n".join(_table_lines(config, ())).lstrip("\n") + "\n"


def _read_toml(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError("no such file", path=path, hint="print a template with: evermap slam --show-config") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", path=path) from None
    except RecursionError:
        raise ConfigError("not valid TOML: nested too deeply", path=path) from None
    except ValueError as error:  # of TOML, and of numbers with thousands of digits
        raise ConfigError(f"not valid TOML: {error}", path=path, hint="text values need quotes") from None


def _overridden(config: Config, overrides: Iterable[str], values: Mapping[str, Any], within: str) -> Config:
    content = config.model_dump()
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not all(name.strip() for name in key.split(".")):
            raise ConfigError(f"invalid setting '{override}'", hint="section.key=value, for example slam.seed=1")
        _set(content, key, _toml_value(text.strip()), within)
    for key, value in values.items():
        if value is not None:
            _set(content, key, value, within)
    return _validate(content, None)


def _set(content: dict[str, Any], key: str, value: Any, within: str) -> None:
    """Write a value into nested dicts by its dotted key; one without a dot is of the section `within`."""
    names = _dotted(key, within).split(".")
    table: Any = content
    for name in names[:-1]:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise ConfigError("is a value, not a section", field=".".join(names[:-1]))
    table[names[-1]] = value


def _dotted(key: str, within: str) -> str:
    if within and "." not in key and key.strip() not in Config.model_fields:
        key = f"{within}.{key}"
    return ".".join(name.strip() for name in key.split("."))


def _toml_value(text: str) -> Any:
    """A value in TOML notation; anything that is none is a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _validate(values: Mapping[str, Any], path: Path | None) -> Config:
    """Return the checked configuration; the first thing that is wrong becomes one line."""
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        raise config_error(Config, error, path) from None


def _table_lines(section: Section, prefix: tuple[str, ...]) -> Iterable[str]:
    """Plain values first, then sub-tables, as TOML wants them."""
    tables: list[tuple[str, Section]] = []
    if prefix:
        yield ""
        yield f"[{'.'.join(prefix)}]"
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, Section):
            tables.append((name, value))
            continue
        words = " | ".join(_words_of(info.annotation))
        yield f"# {info.description}{f' ({words})' if words else ''}"
        yield f"# {name} =" if value is None else f"{name} = {_toml_text(value)}"
    for name, table in tables:
        yield from _table_lines(table, (*prefix, name))


def _toml_text(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml_text(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_toml_text, value)) + "]"
    return json.dumps(value)
