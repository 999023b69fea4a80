"""Landmarks without identities."""

from __future__ import annotations

from evermap.config.section import Count, NotNegative, Positive, Probability, Section, Share, key, part, rule


class ConstellationConfig(Section):
    """Maps that are aligned by the constellation of their landmarks alone."""

    near_m: Positive = rule(0.5, "distance within which two landmarks are a pair, once aligned [m]")
    least_span_m: Positive = rule(0.5, "landmarks that are closer than this fix no heading [m]")
    span_slack_m: NotNegative = rule(0.2, "tolerance of distances within both maps, beside their uncertainty [m]")
    free_m: Positive = rule(5.0, "standard deviation of the offset around a candidate motion [m]")
    free_rad: Positive = rule(2.0, "standard deviation of its rotation [rad]")
    certain_nats: NotNegative = rule(7.0, "evidence of an alignment over no alignment, and over its best rival [nats]")
    lead_nats: NotNegative = rule(20.0, "the same over its best rival, if a large map was searched [nats]")
    stiff_m: Positive = rule(0.2, "landmarks known this well relative to each other are one rigid part of a map [m]")
    longest_side_m: Positive = rule(25.0, "longest side of an indexed triangle [m]")
    side_sigmas: Positive = rule(3.4, "standard deviations by which the sides of matching triangles may differ ...")
    side_slack_m: NotNegative = rule(0.02, "... and by this in addition [m]")
    same_place_m: Positive = rule(5.0, "motions that differ by less at the centre of a session are one alignment [m]")
    least_found: Share = rule(0.4, "least share of a group that must be found in a map")
    reach_m: Positive = rule(15.0, "distance within which places are compared, once an alignment is known [m]")


class ReadingsConfig(Section):
    """Columns that describe landmarks, such as radius or colour."""

    misread_nats: NotNegative = rule(
        2.995732273553991, "evidence of one reading for or against a match, at most [nats]"
    )
    most_readings: Count = rule(4, "readings that a visit counts as, at most: their errors are correlated")
    least_nats: NotNegative = rule(0.1, "mean evidence per pair of visits, below which columns are not used [nats]")
    confidence: Share = rule(0.999, "confidence that landmarks differ in a column, to use it")
    fewest_in_halves: int = rule(6, "readings of a visit from which its first and second half are compared", ge=2)
    p_wrong: Share = rule(0.1, "prior share of visits that are assigned to the wrong landmark ...")
    wrong_worth: Positive = rule(2.0, "... and the visits that this prior counts as")
    preferred_nats: NotNegative = rule(2.0, "gain in log likelihood that a smaller error of visits needs [nats]")
    fewest_pairs: Positive = rule(3.0, "pairs of visits from which that error is learned")


class ParticlesConfig(Section):
    """Whole histories of associations, drawn where many detections are ambiguous."""

    new_nats: NotNegative = rule(2.995732273553991, "log odds of clutter against a landmark that is new [nats]")
    wider: tuple[Positive, ...] = rule(
        (1.2, 1.5), "factors on the noise of sightings, one after the other", min_length=1
    )
    bent: Positive = rule(0.3, "error of known landmarks, as a share of the distance to the nearest one")


class AnonymousInSpaceConfig(Section):
    """The same in space, where it differs."""

    least_extent_m: Positive = rule(1.0, "least extent of the landmarks along each axis [m]")
    least_volume_m3: Positive = rule(20.0, "least volume that they span [m^3]")
    shared_rad: Positive = rule(0.05, "error that all sightings of an orientation have in common [rad]")
    alike_rad: Positive = rule(0.2, "spread of the orientations of landmarks on one wall [rad]")
    turn_sigmas: Positive = rule(4.0, "standard deviations by which orientations of one landmark may differ ...")
    turn_floor_rad: Positive = rule(0.1, "... where their least error is this [rad]")
    same_turn_rad: Positive = rule(0.5, "alignments with a map whose orientation differs by less are one [rad]")
    tail: float = rule(5.0, "factor on the error of detections in the tail ...", ge=1)
    tail_share: Share = rule(0.1, "... and their share")
    widened: Positive = rule(1.5, "factor on the variance of a detection, for the uncertainty of the poses")


class AssociationConfig(Section):
    """Landmarks without identities, associated by geometry."""

    gate_confidence: Share = rule(0.999, "share of true pairs inside the gates")
    loose_gate: Positive = rule(
        60.0, "squared distance up to which landmarks are compared, before shared errors are known"
    )
    p_match: Share = key(0.95, "probability from which a detection is assigned at once ...")
    p_return: Share = rule(0.99, "... and to a landmark that was out of view, which closes a loop")
    tight_m2: Positive = rule(0.04, "area of a gate in which a wrong choice is harmless for a while [m^2]")
    followed: float = rule(2.0, "a landmark is tracked while it at most multiplies the noise of readings by this", ge=1)
    unmet_share: Share = rule(0.1, "share of landmarks near tracked ones that are not mapped yet")
    p_new: Share = key(0.1, "probability to be new from which a detection starts a landmark")
    p_merge: Share = key(0.97, "probability from which two landmarks are merged")
    p_own: Share = rule(0.5, "least probability of the landmark that a detection ends with")
    forget_s: Positive = rule(20.0, "gap after which a new visit begins, and landmarks with too few sightings go [s]")
    fewest_to_pair: Count = rule(2, "sightings from which two landmarks may be merged")
    least_landmarks: Positive = rule(2.0, "least number of landmarks in their density ...")
    least_area_m2: Positive = rule(20.0, "... and the least area that they span [m^2]")
    odometry_caution: Positive = rule(2.0, "factor on the odometry noise during association")
    slip: Positive = rule(3.0, "factor on that in a step with slipping wheels ...")
    slip_nats: NotNegative = rule(2.995732273553991, "... and its prior log odds [nats]")
    noise_caution: Positive = rule(1.3, "factor on the learned noise of sightings")
    noise_floor: Positive = rule(0.5, "prior of that noise, as a share of the stated one ...")
    pseudo_sightings: Positive = rule(100.0, "... and the sightings that this counts as")
    clipped_at: Positive = rule(9.0, "squared normalised residual that counts in full where variances are learned")
    shared_m: Positive = rule(0.02, "error that all sightings of a landmark have in common [m] ...")
    shared_share: NotNegative = rule(0.5, "... and as a share of their range noise")
    name_nats: NotNegative = rule(
        4.605170185988092, "evidence of an identity that two landmarks share, per reading [nats] ..."
    )
    most_names: Count = rule(10, "... of which so many count, at most")
    rise_nats: NotNegative = rule(7.0, "rise of the cost that is accepted for a merge [nats] ...")
    rise_per_sighting: NotNegative = rule(1.75, "... for each sighting of the lesser one [nats] ...")
    most_rise_nats: NotNegative = rule(100.0, "... and in all, at most [nats]")
    landmark_nats: NotNegative = rule(7.0, "cost of a further landmark [nats]")
    few_nats: NotNegative = rule(7.0, "evidence for merging two pairs or one, while later frames may tell more [nats]")
    double_nats: NotNegative = rule(5.0, "evidence against a pair for each frame that shows both [nats]")
    in_turn_nats: NotNegative = rule(0.2, "evidence for a pair for each frame that shows only one of them [nats] ...")
    most_in_turn_nats: NotNegative = rule(10.0, "... and in all, at most: one may hide the other")
    around_frames: Count = rule(3, "frames before and after, in which it should have been seen")
    contradiction: Share = rule(0.95, "confidence from which a visit contradicts all others")
    fewest_displaced: Count = rule(4, "landmarks from which a stretch is displaced as a whole")
    least_seen: Share = rule(1.0 / 3.0, "sightings below this share of the usual number are of no landmark")
    doubtful_share: Probability = rule(0.008, "share of ambiguous detections from which particles are drawn")
    p_closed: Probability = rule(1e-4, "chance of so bent an odometry, if all closed loops are right, below which, too")
    bent_nats: Positive = rule(3.0, "... and nats for each landmark met again above which it is told; 1 is right")
    dropped_share: Share = rule(0.4, "share of detections of no landmark above which it is told")
    constellation: ConstellationConfig = part(ConstellationConfig, "aligned maps")
    readings: ReadingsConfig = part(ReadingsConfig, "columns of detections")
    particles: ParticlesConfig = part(ParticlesConfig, "drawn histories")
    space: AnonymousInSpaceConfig = part(AnonymousInSpaceConfig, "points and tags")
