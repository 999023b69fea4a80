"""Settings of the estimator, corrections of the sensor, and what a run writes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from evermap.config.section import Count, NotNegative, Positive, Probability, Section, Share
from evermap.errors import ConfigError
from evermap.types import FloatArray, Sensor, SensorKind

SIGMAS = {
    "range_bias_m": 0.1,
    "range_slope": 0.02,
    "range_skew_per_rad": 0.1,
    "range_curvature_per_rad2": 0.5,
    "bearing_bias_rad": 0.05,
    "mount_forward_m": 0.1,
    "mount_left_m": 0.1,
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


class CalibrationConfig(Section):
    """Which calibration states are estimated, and what is believed of them before."""

    fix: dict[str, float] = Field(
        default_factory=dict,
        description="calibration states held at a value instead of estimated, by name, e.g. odometry_delay_s = 0.0",
    )
    sigma: dict[str, Positive] = Field(
        default_factory=lambda: dict(SIGMAS), description="standard deviations of their priors, each in its own unit"
    )
    kinds: dict[SensorKind, OfSensor] = Field(
        default_factory=lambda: dict(KINDS),
        description="those of the first five, which depend on the kind of sensor, where it is stated",
    )
    sigma_askew_rad: Positive = Field(
        default=0.03, description="of the direction in which a robot drives, from its front, if unstated [rad]"
    )
    p_needed: Share = Field(default=0.5, description="prior probability that a state is not as stated")
    p_needed_known: Share = Field(
        default=0.9, description="the same of a sensor that is stated to be of another kind than a laser"
    )
    p_needed_mount: Share = Field(
        default=0.1, description="the same of each coordinate of the mount, which one measures, if it has no data sheet"
    )
    p_spare: Share = Field(default=0.01, description="probability to be needed below which a state is held as stated")

    @field_validator("sigma", "kinds")
    @classmethod
    def _all(cls, given: dict[Any, Any], info: ValidationInfo) -> dict[Any, Any]:
        usual: dict[Any, Any] = SIGMAS if info.field_name == "sigma" else KINDS
        if unknown := given.keys() - usual.keys():
            raise ValueError(f"no calibration state is called '{min(unknown)}': {', '.join(usual)}")
        return usual | given


class OdometryConfig(Section):
    """What is believed of the odometry, beside its noise."""

    silence_s: Positive = Field(
        default=1.0, description="gap of the odometry beyond which the last velocity is not continued [s]"
    )
    silent_variance: Positive = Field(
        default=0.25, description="variance that such a silence adds every second, at least [m^2/s, rad^2/s]"
    )
    longest_silence_s: Positive = Field(
        default=60.0, description="after a longer silence no more is unknown than after this [s]"
    )
    turn_s: Positive = Field(default=2.0, description="span over which turns stand out from jitter [s]")
    stands_out: Positive = Field(default=3.0, description="standard deviations of the jitter by which it does")
    loose_rad: Positive = Field(
        default=0.3, description="heading that a silence leaves unknown, from which a recording is in parts [rad]"
    )


class VotesConfig(Section):
    """Identities that were read wrongly, by other detections of the seconds around."""

    window_s: Positive = Field(default=5.0, description="before and after a detection, the odometry hardly drifts [s]")
    sigma_m: Positive = Field(default=0.05, description="error of a detection's place at no distance [m] ...")
    sigma_share: NotNegative = Field(default=0.05, description="... and as a share of its range")
    gate: Positive = Field(
        default=2.0, description="standard deviations within which another detection is of the same place"
    )
    fewest: Count = Field(default=2, description="detections with another id that contradict one, at least ...")
    times: NotNegative = Field(default=3.0, description="... and more than so many times those with its own")
    fewest_doubles: Count = Field(
        default=3, description="frames that have an id at two places, from which on it is on two landmarks"
    )
    surprising: Positive = Field(
        default=50.0, description="squared normalised residual from which a sighting disputes where its landmark is"
    )


class LocalizeConfig(Section):
    """When the place of a robot in a map is known, and when it is lost; landmarks are found by their identity."""

    fewest: Count = Field(default=3, description="landmarks that must have the relative positions of the map")
    enough: Count = Field(default=5, description="so many do by no accident, even if they are fewer than half")
    alone_s: NotNegative = Field(
        default=10.0, description="where no third landmark comes into view for so long, two are enough [s]"
    )
    spread_m: Positive = Field(
        default=1.0, description="how far apart they must be, for a recording that is smoothed afterwards [m]"
    )
    spread_online_m: Positive = Field(
        default=2.0, description="the same for a robot that is followed in the map: farther than on one body [m]"
    )
    track_s: Positive = Field(default=30.0, description="age of sightings that odometry still ties to the newest [s]")
    least_belief: Share = Field(
        default=0.05, description="least probability that a landmark is at its known place, if it is seen there"
    )
    believed: Share = Field(default=0.5, description="belief from which not to be seen is a miss")
    sure_m: Positive = Field(
        default=0.5, description="no landmark is expected while the position is less certain than this [m]"
    )
    least_p_detect: Share = Field(default=0.01, description="P(detect) from which a landmark is expected in view")
    doubt: Positive = Field(
        default=1.0, description="by which a place is doubted for each frame that has its landmark elsewhere [nats] ..."
    )
    most_doubt: Positive = Field(default=9.0, description="... and by which in all, at most [nats]")
    remembered: Count = Field(default=8, description="landmarks, compared last, that judge whether the robot is lost")
    least_remembered: Count = Field(default=3, description="the same, at least")
    memory_s: Positive = Field(default=20.0, description="age up to which they do [s]")
    better_by: float = Field(default=1.5, ge=1.0, description="times that another pose must fit better than this one")


class ModesConfig(Section):
    """Landmarks with several positions (Nielsen and Hendeby 2024): gates, switching, selectors."""

    gate_probability: Probability = Field(
        default=0.95, description="a detection outside this confidence region of all modes starts a new mode"
    )
    switch_probability: Probability = Field(
        default=1e-4,
        description="probability of a landmark to be in another mode at the next look; ignored with a lifetime",
    )
    births: Literal["evidence", "gate"] = Field(
        default="evidence",
        description="'evidence' keeps a new mode that explains more than it costs, 'gate' every one, as the paper does",
    )
    lifetime: str | None = Field(
        default=None, description="prior of how long a mode lasts, e.g. 'exponential:half-life=30d'; unset: constant"
    )
    rounds: int = Field(default=10, ge=1, le=100, description="maximum rounds of selecting modes and relinearising")
    mcts_budget: int = Field(default=200, ge=1, description="iterations of the tree search for every decision")
    mcts_window_s: Positive | None = Field(
        default=40.0, description="window of the tree search [s]; unset: from the start"
    )


class ChangesConfig(Section):
    """The joint search over changes."""

    p_moved: float = Field(default=0.01, gt=0, lt=1, description="prior probability that anything moved at all")
    move_sigma_m: Positive = Field(default=0.7, description="standard deviation of a displacement, each axis [m]")
    p_rotated: Probability = Field(default=0.1, description="share of moves with a rotation")
    turn_sigma_rad: Positive = Field(default=0.5, description="standard deviation of such a rotation [rad]")
    rigid_m: Positive = Field(default=0.005, description="members of a group keep their distances to within this [m]")
    p_swapped: Share = Field(default=1e-5, description="probability that any two landmarks of a map were mixed up")
    displaced_log_odds: float = Field(
        default=7.0,
        gt=0,
        le=50,
        description="prior log odds against a temporary displacement of a landmark [nats]",
    )
    map_factor_spread: Positive = Field(
        default=0.35, description="standard deviation of the logarithm of a factor on the sigmas of a map"
    )
    softness_m: tuple[Positive, ...] = Field(
        default=(0.005, 0.01, 0.02, 0.04),
        min_length=1,
        description="candidate common errors of the sightings of a landmark in a part of the session; chosen by "
        "evidence [m]",
    )
    usual_softness_m: Positive = Field(
        default=0.02, description="the same during the search for swaps and temporary displacements [m]"
    )
    most_groups: Count = Field(default=4, description="maximum number of moved groups")
    most_candidates: Count = Field(default=40, description="maximum number of candidates for moves, the likeliest")
    visit_gap_s: Positive = Field(default=10.0, description="gap between sightings after which a new visit begins [s]")
    interval: Share = Field(default=0.95, description="probability of the reported interval of a change")
    rival_nats: NotNegative = Field(
        default=5.0, description="maximum distance of a reported alternative from the best explanation [nats]"
    )
    most_rivals: int = Field(default=2, ge=0, description="maximum number of reported alternatives")
    disagreement: Positive = Field(
        default=4.0, description="chi-square per degree of freedom above which a map without changes does not fit"
    )
    loose_map_m: Positive = Field(
        default=1.0, description="standard deviation of a map that must not distort the session [m]"
    )

    @property
    def spread(self) -> FloatArray:
        """(3,) standard deviations of a displacement in x [m] and y [m], and of its angle [rad]."""
        return np.array([self.move_sigma_m, self.move_sigma_m, self.turn_sigma_rad])


class CheckConfig(Section):
    """What makes a recording odd; see `slam.check`."""

    lags_s: tuple[Positive, ...] = Field(
        default=(1.0, 4.0),
        min_length=1,
        description="minimum time between compared sightings; the maximum is twice as long [s]",
    )
    most_pairs: Count = Field(default=1000, description="pairs of sightings compared for each lag, at most")
    fits: Positive = Field(
        default=0.03, description="usual difference between two readings: share of the range, and rad"
    )
    apart: Positive = Field(
        default=3.0, description="difference in median residuals by which a pair distinguishes two explanations"
    )
    agreed: Share = Field(default=0.8, description="share of those pairs that a mistake must explain to be reported")
    fewest: Count = Field(default=20, description="minimum number of such pairs")
    gain: Positive = Field(default=20.0, description="minimum gain in log likelihood of a mistake over all pairs")
    off: Positive = Field(default=0.3, description="median residual above which readings and odometry are unrelated")
    own_ids: Count = Field(
        default=50,
        description="number of landmarks above which hardly any second sighting indicates that ids name detections",
    )
    far_off: Positive = Field(
        default=5.0, description="standard deviations of its prior beyond which a calibration state is reported"
    )


class CleaningConfig(Section):
    """What is left out of the recording of a session as impossible; see `slam.cleaning`."""

    fastest: Positive = Field(default=100.0, description="speed above which odometry is dropped [m/s, rad/s]")
    hardest: Positive = Field(default=20.0, description="acceleration above which odometry is a spike [m/s^2, rad/s^2]")
    sharpest: Positive = Field(default=2.0, description="change of speed that is never a spike [m/s, rad/s]")
    too_far: float = Field(
        default=2.0, ge=1.0, description="factor on the maximum range above which a reading is dropped"
    )
    far_from_median: float = Field(
        default=100.0, ge=1.0, description="the same on the median range, for a sensor without a maximum range"
    )
    moved: Positive = Field(
        default=0.1, description="motion after which identical readings indicate stale data [m, rad]"
    )
    stray_s: Positive = Field(
        default=10.0,
        description="distance from neighbouring stamps, and of frames from odometry, above which they are dropped [s]",
    )
    step_s: Positive = Field(default=1.0, description="smallest step of a clock that is repaired [s]")
    around: int = Field(default=9, ge=3, le=999, description="messages that a stamp is compared with; an odd number")

    @field_validator("around")
    @classmethod
    def _odd(cls, around: int) -> int:
        if around % 2 == 0:
            raise ValueError(f"must be an odd number, not {around}")
        return around


class ConstellationConfig(Section):
    """Maps that are aligned by the constellation of their landmarks alone."""

    near_m: Positive = Field(
        default=0.5, description="distance within which two landmarks are a pair, once aligned [m]"
    )
    least_span_m: Positive = Field(default=0.5, description="landmarks that are closer than this fix no heading [m]")
    span_slack_m: NotNegative = Field(
        default=0.2, description="tolerance of distances within both maps, beside their uncertainty [m]"
    )
    free_m: Positive = Field(default=5.0, description="standard deviation of the offset around a candidate motion [m]")
    free_rad: Positive = Field(default=2.0, description="standard deviation of its rotation [rad]")
    certain_nats: NotNegative = Field(
        default=7.0, description="evidence of an alignment over no alignment, and over its best rival [nats]"
    )
    lead_nats: NotNegative = Field(
        default=20.0, description="the same over its best rival, if a whole map was searched [nats]"
    )
    stiff_m: Positive = Field(
        default=0.2, description="landmarks known this well relative to each other are one rigid part of a map [m]"
    )
    longest_side_m: Positive = Field(default=25.0, description="longest side of an indexed triangle [m]")
    side_sigmas: Positive = Field(
        default=3.4, description="standard deviations by which the sides of matching triangles may differ ..."
    )
    side_slack_m: NotNegative = Field(default=0.02, description="... and by this in addition [m]")
    same_place_m: Positive = Field(
        default=5.0, description="motions that differ by less at the centre of a session are one alignment [m]"
    )
    least_found: Share = Field(default=0.4, description="least share of a group that must be found in a map")
    reach_m: Positive = Field(
        default=15.0, description="distance within which places are compared, once an alignment is known [m]"
    )


class ReadingsConfig(Section):
    """Columns that describe landmarks, such as radius or colour."""

    misread_nats: NotNegative = Field(
        default=2.995732273553991, description="evidence of one reading for or against a match, at most [nats]"
    )
    most_readings: Count = Field(
        default=4, description="readings that a visit counts as, at most: their errors are correlated"
    )
    least_nats: NotNegative = Field(
        default=0.1, description="mean evidence per pair of visits, below which columns are not used [nats]"
    )
    confidence: Share = Field(default=0.999, description="confidence that landmarks differ in a column, to use it")
    fewest_in_halves: int = Field(
        default=6, ge=2, description="readings of a visit from which its first and second half are compared"
    )
    p_wrong: Share = Field(default=0.1, description="prior share of visits that are assigned to the wrong landmark ...")
    wrong_worth: Positive = Field(default=2.0, description="... and the visits that this prior counts as")
    preferred_nats: NotNegative = Field(
        default=2.0, description="gain in log likelihood that a smaller error of visits needs [nats]"
    )
    fewest_pairs: Positive = Field(default=3.0, description="pairs of visits from which that error is learned")


class ParticlesConfig(Section):
    """Whole histories of associations, drawn where many detections are ambiguous."""

    new_nats: NotNegative = Field(
        default=2.995732273553991, description="log odds of clutter against a landmark that is new [nats]"
    )
    wider: tuple[Positive, ...] = Field(
        default=(1.2, 1.5), min_length=1, description="factors on the noise of sightings, one after the other"
    )
    bent: Positive = Field(
        default=0.3, description="error of known landmarks, as a share of the distance to the nearest one"
    )


class AnonymousInSpaceConfig(Section):
    """The same in space, where it differs."""

    least_extent_m: Positive = Field(default=1.0, description="least extent of the landmarks along each axis [m]")
    least_volume_m3: Positive = Field(default=20.0, description="least volume that they span [m^3]")
    shared_rad: Positive = Field(
        default=0.05, description="error that all sightings of an orientation have in common [rad]"
    )
    alike_rad: Positive = Field(default=0.2, description="spread of the orientations of landmarks on one wall [rad]")
    turn_sigmas: Positive = Field(
        default=4.0, description="standard deviations by which orientations of one landmark may differ ..."
    )
    turn_floor_rad: Positive = Field(default=0.1, description="... where their least error is this [rad]")
    tail: float = Field(default=5.0, ge=1, description="factor on the error of detections in the tail ...")
    tail_share: Share = Field(default=0.1, description="... and their share")
    widened: Positive = Field(
        default=1.5, description="factor on the variance of a detection, for the uncertainty of the poses"
    )


class AssociationConfig(Section):
    """Landmarks without identities, associated by geometry."""

    gate_confidence: Share = Field(default=0.999, description="share of true pairs inside the gates")
    loose_gate: Positive = Field(
        default=60.0, description="squared distance up to which landmarks are compared, before shared errors are known"
    )
    p_match: Share = Field(default=0.95, description="probability from which a detection is assigned at once ...")
    p_return: Share = Field(default=0.99, description="... and to a landmark that was out of view, which closes a loop")
    tight_m2: Positive = Field(
        default=0.04, description="area of a gate in which a wrong choice is harmless for a while [m^2]"
    )
    followed: float = Field(
        default=2.0, ge=1, description="a landmark is tracked while it at most multiplies the noise of readings by this"
    )
    unmet_share: Share = Field(default=0.1, description="share of landmarks near tracked ones that are not mapped yet")
    p_new: Share = Field(default=0.1, description="probability to be new from which a detection starts a landmark")
    p_merge: Share = Field(default=0.97, description="probability from which two landmarks are merged")
    p_own: Share = Field(default=0.5, description="least probability of the landmark that a detection ends with")
    forget_s: Positive = Field(
        default=20.0, description="gap after which a new visit begins, and landmarks with too few sightings go [s]"
    )
    fewest_to_pair: Count = Field(default=2, description="sightings from which two landmarks may be merged")
    least_landmarks: Positive = Field(default=2.0, description="least number of landmarks in their density ...")
    least_area_m2: Positive = Field(default=20.0, description="... and the least area that they span [m^2]")
    odometry_caution: Positive = Field(default=2.0, description="factor on the odometry noise during association")
    slip: Positive = Field(default=3.0, description="factor on that in a step with slipping wheels ...")
    slip_nats: NotNegative = Field(default=2.995732273553991, description="... and its prior log odds [nats]")
    noise_caution: Positive = Field(default=1.3, description="factor on the learned noise of sightings")
    noise_floor: Positive = Field(default=0.5, description="prior of that noise, as a share of the stated one ...")
    pseudo_sightings: Positive = Field(default=100.0, description="... and the sightings that this counts as")
    clipped_at: Positive = Field(
        default=9.0, description="squared normalised residual that counts in full where variances are learned"
    )
    shared_m: Positive = Field(
        default=0.02, description="error that all sightings of a landmark have in common [m] ..."
    )
    shared_share: NotNegative = Field(default=0.5, description="... and as a share of their range noise")
    name_nats: NotNegative = Field(
        default=4.605170185988092,
        description="evidence of an identity that two landmarks share, per reading [nats] ...",
    )
    most_names: Count = Field(default=10, description="... of which so many count, at most")
    rise_nats: NotNegative = Field(default=7.0, description="rise of the cost that is accepted for a merge [nats] ...")
    rise_per_sighting: NotNegative = Field(
        default=1.75, description="... for each sighting of the lesser one [nats] ..."
    )
    most_rise_nats: NotNegative = Field(default=100.0, description="... and in all, at most [nats]")
    landmark_nats: NotNegative = Field(default=7.0, description="cost of a further landmark [nats]")
    few_nats: NotNegative = Field(
        default=7.0, description="evidence for merging two pairs or one, while later frames may tell more [nats]"
    )
    double_nats: NotNegative = Field(
        default=5.0, description="evidence against a pair for each frame that shows both [nats]"
    )
    in_turn_nats: NotNegative = Field(
        default=0.2, description="evidence for a pair for each frame that shows only one of them [nats] ..."
    )
    most_in_turn_nats: NotNegative = Field(default=10.0, description="... and in all, at most: one may hide the other")
    around_frames: Count = Field(default=3, description="frames before and after, in which it should have been seen")
    contradiction: Share = Field(default=0.95, description="confidence from which a visit contradicts all others")
    fewest_displaced: Count = Field(default=4, description="landmarks from which a stretch is displaced as a whole")
    least_seen: Share = Field(
        default=1.0 / 3.0, description="sightings below this share of the usual number are of no landmark"
    )
    doubtful_share: Probability = Field(
        default=0.02, description="share of ambiguous detections from which particles are drawn"
    )
    constellation: ConstellationConfig = Field(default_factory=ConstellationConfig, description="aligned maps")
    readings: ReadingsConfig = Field(default_factory=ReadingsConfig, description="columns of detections")
    particles: ParticlesConfig = Field(default_factory=ParticlesConfig, description="drawn histories")
    space: AnonymousInSpaceConfig = Field(default_factory=AnonymousInSpaceConfig, description="points and tags")


class MapInSpaceConfig(Section):
    """What of a given map in space stands where it says, and what was moved."""

    sigma: Positive = Field(default=0.02, description="standard deviation of landmarks that state none [m, rad]")
    loose_m: Positive = Field(
        default=0.05, description="least standard deviation of a map before static landmarks are identified [m, rad]"
    )
    pseudo_count: Positive = Field(
        default=6.0, description="residuals that the accuracy which a map states counts for where that is learned"
    )
    p_moved: Share = Field(default=0.03, description="probability that a landmark moved since the map was made")
    moved_m: tuple[Positive, ...] = Field(
        default=(0.15, 0.5, 2.0), min_length=1, description="standard deviations of how far, all alike [m]"
    )
    moved_rad: tuple[Positive, ...] = Field(
        default=(0.05, 0.5), min_length=1, description="standard deviations of its turn, all alike [rad]"
    )
    moved_nats: NotNegative = Field(
        default=5.0, description="what it costs that a landmark was moved, instead of the robot [nats]"
    )
    least_seen: Positive = Field(
        default=1.0, description="sum of inlier probabilities below which a landmark was not seen at its place"
    )
    drift_rad: Positive = Field(
        default=0.02, description="standard deviation of the orientation of unmoved landmarks between sessions [rad]"
    )
    p_told: Share = Field(default=0.5, description="probability from which a landmark is reported as moved")


class RepairConfig(Section):
    """Other explanations of the same views in space: poses, orientations, and identities that several carry."""

    stretch_nats: Positive = Field(
        default=6.0, description="by which a stretch of frames must prefer other poses to try them [nats]"
    )
    gain_nats: Positive = Field(default=3.0, description="by which all must be more probable in the end [nats]")
    other_rad: Positive = Field(default=0.3, description="orientations that differ by more are two [rad]")
    same_rad: Positive = Field(default=0.05, description="orientations that agree to within this are the same [rad]")
    together_m: Positive = Field(
        default=0.5, description="outliers of one identity that are this close are another landmark [m]"
    )
    fewest: Count = Field(default=5, description="detections that this takes")
    fewest_frames: Count = Field(default=3, description="frames that it takes")


class TrafficConfig(Section):
    """Boxes without identity around a robot with odometry: errors that repeat themselves, by what stands."""

    sigma_scale: Positive = Field(default=0.05, description="standard deviation of the scale of ranges, a share")
    sigma_bend: Positive = Field(
        default=1e-3, description="angle that the odometry turns too little by the metre, standard deviation [rad/m]"
    )
    error_log_odds: float = Field(
        default=-3.0, ge=-50, le=50, description="prior log odds that there is such an error [nats]"
    )
    still_mps: Positive = Field(
        default=0.1, description="standard deviation of the measured velocity of a static object [m/s]"
    )
    moving_mps: Positive = Field(default=3.0, description="the same of what moves [m/s]")
    witnesses: Count = Field(default=10, description="fewest objects that must show a drift of the odometry")
    better_by: float = Field(default=2.0, ge=1.0, description="factor by which their residuals must become smaller")
    tilt_rad: Positive = Field(default=0.05, description="boxes are upright to within this [rad]")


class SpaceConfig(Section):
    """What is believed of sensors in space, and estimated beside poses and landmarks."""

    mount_sigma_m: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="standard deviation of the mounts' positions [m]; 0: exactly as stated",
    )
    mount_sigma_rad: float = Field(
        default=0.0,
        ge=0,
        le=3,
        description="standard deviation of the mounts' orientations [rad]; 0: exactly as stated",
    )
    delay_sigma_s: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="standard deviation of the delay of the sensors' stamps [s]; 0: no delay",
    )
    range_scale: float | None = Field(
        default=None,
        gt=0.5,
        lt=2.0,
        description="factor on the ranges of boxes without identity; unset: estimated from static objects, in the "
        "odometry's scale",
    )
    sigma_m: Positive = Field(default=0.005, description="noise of unstated positions at no range [m] ...")
    sigma_along: NotNegative = Field(default=0.02, description="... along the ray, as a share of the range ...")
    sigma_across: NotNegative = Field(default=0.01, description="... and across")
    sigma_rad: Positive = Field(default=0.05, description="standard deviation of an orientation that states none [rad]")
    sigma_px: Positive = Field(default=2.0, description="noise of a tag's corners in the image, to start from [px]")
    corner_m: Positive = Field(default=1e-3, description="position of a tag by its corners is no better than this [m]")
    widest: Positive = Field(
        default=3.0, description="corners farther off the axis than this, over the depth, are not used"
    )
    nearest_m: Positive = Field(default=0.02, description="nothing nearer to a sensor than this is used [m]")
    range_within_s: Positive = Field(
        default=15.0, description="views within this time give a detection without range one [s]"
    )
    least_parallax: Positive = Field(
        default=0.25, description="largest standard deviation of such a range, as a share of it"
    )
    drift_m: Positive = Field(default=0.05, description="drift of odometry to start from [m/sqrt(s)]")
    drift_rad: Positive = Field(default=0.02, description="the same of its heading [rad/sqrt(s)]")
    steady_m: Positive = Field(default=3e-4, description="no odometry drifts less than this [m/sqrt(s)]")
    steady_rad: Positive = Field(default=1e-5, description="the same of its heading [rad/sqrt(s)]")
    hand_mps: Positive = Field(default=1.0, description="how fast a camera without odometry may go [m/s]")
    hand_radps: Positive = Field(default=0.7, description="and turn [rad/s]")
    tied_s: NotNegative = Field(
        default=0.25, description="frames without odometry this close are tied by how far it may go between them [s]"
    )
    pseudo_count: Positive = Field(
        default=10.0, description="residuals that noise levels to start from count for in what is learned"
    )
    least_noise: tuple[Positive, Positive, Positive, Positive, Positive, Positive] = Field(
        default=(1e-4, 1e-5, 0.05, 0.05, 0.05, 0.03),
        description="least noise levels that are learned: drift [m, rad by sqrt(s)], across, along, turn, corners [px]",
    )
    outlier_log_odds: tuple[Positive, Positive, Positive] = Field(
        default=(10.5, 14.0, 16.0),
        description="half the squared residual at which positions, poses and corners are as likely outliers",
    )
    jump_log_odds: Positive = Field(default=14.0, description="the same of odometry, which may slip")
    inlier: Share = Field(default=0.5, description="inlier probability, or sum of such, from which something was seen")
    field_margin_rad: NotNegative = Field(
        default=0.02, description="a field of view is as wide as what was seen in it, and this wider [rad]"
    )
    range_margin: float = Field(
        default=1.1, ge=1.0, description="nothing is expected farther than this times the farthest"
    )
    usual_range: Share = Field(
        default=0.9, description="share of sightings that were nearer than what a look at an empty place reaches"
    )
    faced: Share = Field(
        default=0.2, description="median cosine of incidence from which landmarks are taken to have a face"
    )
    widest_rad: float = Field(
        default=1.4835298641951802, gt=0, lt=1.6, description="incidence from which a face is hardly seen [rad]"
    )
    map: MapInSpaceConfig = Field(default_factory=MapInSpaceConfig, description="a map that is given")
    repair: RepairConfig = Field(default_factory=RepairConfig, description="other explanations")
    traffic: TrafficConfig = Field(default_factory=TrafficConfig, description="boxes without identity")


class NoiseConfig(Section):
    """Noise levels that a run starts from, where the sensor states none."""

    sigma_range_m: Positive = Field(default=0.1, description="standard deviation of ranges [m]")
    sigma_bearing_rad: Positive = Field(default=0.02, description="standard deviation of bearings [rad]")
    forward_by_distance: Positive = Field(default=0.05, description="of forward motion, by distance [m/sqrt(m)]")
    forward_by_turn: Positive = Field(default=0.05, description="of forward motion, by angle turned [m/sqrt(rad)]")
    sideways_by_distance: Positive = Field(default=0.03, description="of sideways motion, by distance [m/sqrt(m)]")
    turn_by_time: Positive = Field(default=0.01, description="of turning, by time [rad/sqrt(s)]")
    turn_by_turn: Positive = Field(default=0.05, description="of turning, by angle turned [rad/sqrt(rad)]")
    pseudo_count: Positive = Field(default=1.0, description="pseudo-residuals of these levels")


class SlamConfig(Section):
    """The estimator."""

    method: Literal["nohyp", "max-mixture", "nn", "em", "mcts", "viterbi", "joint"] = Field(
        default="joint", description="method that finds moved landmarks; 'nohyp' assumes a static world"
    )

    sensor_model: Literal["calibrated", "plain"] = Field(
        default="calibrated",
        description="'calibrated' estimates sensor and odometry errors with the map, 'plain' trusts all readings",
    )
    unknown_ids: bool | Literal["empty"] = Field(
        default=False,
        description="associate by geometry: true ignores all identities, 'empty' associates only detections without "
        "one",
    )
    vote_ids: bool = Field(
        default=True,
        description="remove identities that other detections at the same place within seconds contradict, and those on "
        "two landmarks",
    )
    robust: bool = Field(
        default=True, description="down-weight detections with a wrong identity; off only for comparison"
    )
    outlier_log_odds: float = Field(
        default=7.0,
        gt=0,
        le=50,
        description="an outlier is as likely as an inlier at a squared normalised residual of twice this",
    )
    fewest_sightings: Count = Field(
        default=3, description="fewest sightings that locate a landmark: one or two may have a wrong identity"
    )
    estimate_noise: bool = Field(
        default=True, description="learn noise levels from the recording; off: keep the nominal ones"
    )
    odometry_noise_factor: Positive = Field(
        default=1.0,
        description="factor on the initial odometry noise, kept if estimate_noise is off",
    )
    seed: int = Field(default=0, ge=0, description="random seed")
    calibration: CalibrationConfig = Field(default_factory=CalibrationConfig, description="calibration states")
    modes: ModesConfig = Field(
        default_factory=ModesConfig, description="methods 'max-mixture' to 'viterbi': landmarks with several positions"
    )
    changes: ChangesConfig = Field(
        default_factory=ChangesConfig, description="method 'joint': groups of moved landmarks"
    )
    noise: NoiseConfig = Field(default_factory=NoiseConfig, description="noise levels to start from")
    odometry: OdometryConfig = Field(default_factory=OdometryConfig, description="silences and jitter of the odometry")
    votes: VotesConfig = Field(default_factory=VotesConfig, description="identities that were read wrongly")
    association: AssociationConfig = Field(
        default_factory=AssociationConfig, description="landmarks without identities"
    )
    localize: LocalizeConfig = Field(default_factory=LocalizeConfig, description="where a robot is in a map")
    space: SpaceConfig = Field(default_factory=SpaceConfig, description="sensors in space")
    check: CheckConfig = Field(default_factory=CheckConfig, description="thresholds of the recording check")
    cleaning: CleaningConfig = Field(
        default_factory=CleaningConfig, description="limits for dropping defects of a recording"
    )


class SensorConfig(Section):
    """Corrections of what the recording says about its sensor; unset fields keep the recording's value."""

    range_min_m: float | None = Field(default=None, ge=0, description="minimum range [m]")
    range_max_m: Positive | None = Field(default=None, description="maximum range [m]")
    bearing_min_rad: float | None = Field(
        default=None, ge=-3.2, le=3.2, description="right edge of the field of view [rad]"
    )
    bearing_max_rad: float | None = Field(
        default=None, ge=-3.2, le=3.2, description="left edge of the field of view [rad]"
    )
    sigma_range_m: Positive | None = Field(default=None, description="nominal range noise [m]; a starting value")
    sigma_bearing_rad: Positive | None = Field(
        default=None, description="nominal bearing noise [rad]; a starting value"
    )
    p_detect: Probability | None = Field(default=None, description="probability of detecting a landmark in view")
    p_false: Probability | None = Field(default=None, description="probability of a false detection in a frame")
    mount_robot_sensor: tuple[float, float, float] | None = Field(
        default=None, description="pose of the sensor on the robot: x [m], y [m], theta [rad]"
    )
    kind: SensorKind | None = Field(default=None, description="kind of sensor, which sets the priors of its errors")
    sigma_scale: float | None = Field(
        default=None, ge=0, le=1, description="relative standard deviation of the scale of its ranges"
    )
    sigma_offset_m: float | None = Field(
        default=None, ge=0, description="standard deviation of the offset of its ranges [m]"
    )
    sigma_angle_rad: float | None = Field(
        default=None, ge=0, le=6.3, description="standard deviation of its mounting angle [rad]"
    )
    sigma_position_m: float | None = Field(
        default=None, ge=0, le=1e3, description="standard deviation of its position on the robot, along each axis [m]"
    )
    sigma_odometer_scale: float | None = Field(
        default=None, ge=0, le=1, description="relative standard deviation of the scale of the odometer"
    )
    sigma_askew_rad: float | None = Field(
        default=None,
        ge=0,
        le=6.3,
        description="standard deviation of the driving direction relative to the front [rad]",
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


class OutputConfig(Section):
    """What is written beside the numbers."""

    figures: bool = Field(default=True, description="draw the figures")
    report: bool = Field(default=True, description="write report.html")
    rerun: bool = Field(default=False, description="write scene.rrd for the rerun viewer, if rerun-sdk is installed")
    mcap: bool = Field(default=False, description="write run.mcap for Foxglove and ROS 2, which needs rosbags")
    score_rate_hz: float = Field(
        default=2.0, gt=0, le=1000, description="rate at which a trajectory is compared with truth"
    )
