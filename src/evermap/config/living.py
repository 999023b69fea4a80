"""A living map: where a session lies in it, what it looked at, what changed, how long things stay."""

from __future__ import annotations

from typing import Literal

from evermap.config.section import Count, NotNegative, Positive, Probability, Section, Share, key, part, rule
from evermap.config.slam import RoomConfig


class FitConfig(Section):
    """When a session is believed to lie in the map, and which of its landmarks are believed."""

    least_fit: Share = rule(0.75, "share of the sightings consistent within the session that must also fit the map")
    most_lost: Share = rule(
        0.03, "if this larger share of sightings fits within the session than with the map, the session is distorted"
    )
    inlier: Share = rule(0.5, "inlier probability above which a sighting counts")
    sightings: Positive = rule(1.5, "inliers that a landmark needs to be accepted")
    sightings_in_place: Positive = rule(0.5, "the same for a landmark at its place in the map")
    misread_m: Positive = rule(0.3, "distance within which a landmark may be another one with a misread identity [m]")
    misread_share: Share = rule(
        0.2, "maximum share of sightings for that, if it is never in one frame with the other one"
    )
    glimpse_m: Positive = rule(0.4, "a landmark seen once this close to its place is present [m]")
    bent_m: Positive = rule(0.15, "tolerance within which bodies with a common motion indicate a distorted session [m]")
    bent_cliques: int = rule(3, "minimum number of bodies with a common motion for that", ge=2)
    window: Count = rule(12, "sightings by which each pose of a distorted session is aligned")
    bent_windows: Count = rule(3, "so many of these that contradict the rest are wrong poses, not misread identities")
    placing_m: Positive = rule(0.3, "residual above which sightings are down-weighted in that [m]")
    loose_m: Positive = rule(0.5, "position uncertainty above which silent odometry splits a session into parts [m]")
    loose_rad: Positive = rule(0.1, "the same for the heading [rad]")


class OverlayConfig(RoomConfig):
    """Priors of the search for what stands where the map has it."""

    nudge_m: Positive = key(0.7, "standard deviation of a small move, each axis [m]")
    share_nudged: Share = rule(0.5, "share of moves that are small; the others are unbounded")
    share_turned: Share = rule(0.1, "share of moves in space that are turns of a landmark in its place")
    turned_m: Positive = rule(0.05, "standard deviation of the position of one turned in its place, each axis [m]")
    drifts_m: tuple[Positive, ...] = rule(
        (0.01, 0.02, 0.04, 0.08),
        "candidate standard deviations of unmoved landmarks from session to session, the likeliest first [m]",
        min_length=1,
    )
    drifts_in_space_m: tuple[Positive, ...] = rule(
        (0.003, 0.001), "more of these in space, less likely than the others [m]"
    )
    free_m: Positive = rule(20.0, "standard deviation of a session's place around the one agreed on, each axis [m]")
    free_rad: Positive = rule(3.0, "the same of its heading [rad]")
    stood_rad: tuple[Positive, ...] = rule(
        (0.02, 0.06, 0.15),
        "standard deviations of apparent turns of unmoved landmarks in space, one for all of a session [rad]",
        min_length=1,
    )
    turned_rad: tuple[Positive, ...] = rule((0.2, 1.0), "the same of landmarks that were moved [rad]", min_length=1)
    p_coarser: Share = rule(0.5, "probability of each of these drifts, relative to the one before")


class MetreConfig(Section):
    """What sessions and robots say of the length of a metre, together."""

    walk: Positive = rule(0.002, "standard deviation by which a map's metre wanders in a session, as a share")
    contradicts: Positive = rule(4.0, "standard deviations from which a session's metre contradicts the map's")
    p_drifted: Share = rule(0.05, "probability that a robot's metre is not what its sensor is said to know")
    drifted: float = rule(4.0, "times by which it is off then, as standard deviation", ge=1.0)
    p_told: Share = rule(0.95, "probability from which a robot is reported as drifted")


class NamelessConfig(Section):
    """Landmarks without identities in a map: by their constellation."""

    fewest: Count = key(4, "landmarks that must be found in the map together")
    farthest_m: Positive = rule(2.0, "how far a landmark that is the same may be off [m]")
    bent_m: Positive = rule(2.0, "the same behind a stretch that is bent [m]")
    p_found: Share = rule(0.9, "probability that a landmark next to a detected one is detected, too")
    share_exchanged: Share = rule(0.01, "share of landmarks that are where another one of their class was")
    fewest_compared: Count = rule(5, "certain matches that tell by how much columns differ between sessions")


class BoxesConfig(Section):
    """Boxes without identity in a map: which are the same from session to session."""

    drift_m: Positive = rule(
        0.2, "standard deviation of the position of an unmoved box between sessions, each axis [m]"
    )
    height_m: Positive = rule(0.5, "the same of its height over a street that is not flat [m]")
    far_share: Share = rule(0.3, "share of boxes that are off by more ...")
    far_factor: float = rule(3.0, "... namely by so many times that", ge=1.0)
    sigma_size_m: tuple[Positive, Positive, Positive] = rule(
        (0.4, 0.15, 0.15), "standard deviations of one box's size, session to session [m]"
    )
    sigma_class_m: tuple[Positive, Positive, Positive] = rule(
        (0.6, 0.2, 0.25), "standard deviations of the sizes of boxes of one class [m]"
    )
    size_nats: Positive = rule(8.0, "evidence of size or heading against a match, at most [nats]")
    heading_rad: Positive = rule(0.15, "standard deviation of headings [rad]")
    round: Positive = rule(1.3, "boxes less long than this times their width have no heading")
    odd_share: Share = rule(0.05, "share of boxes that one of two sessions sees with any size of their class")
    other_class_nats: float = rule(-3.0, "log odds of being detected as of another class", le=0.0)
    density: Positive = rule(0.02, "least density of static boxes [1/m^2]")
    p_taken: Share = key(0.2, "usual probability that another box takes the place of one that left")
    beside_m: Positive = rule(0.5, "usual standard deviation of where that stands, each axis [m]")
    haste_nats: Positive = rule(1.0, "standard deviation of the logarithm of a factor on the hazards of a session")
    p_stands: Share = rule(0.9, "probability that a box is detected at its place again")
    returns: Share = rule(0.5, "prior probability that an arrival at a former place of a box is that box")
    least_gone: Share = rule(0.02, "least probability that a box left a place now taken")
    same_share: Positive = rule(0.6, "boxes closer than this share of their widths are merged")
    at_once_s: NotNegative = rule(5.0, "a box that is detected again at its place within this time had not left [s]")
    named_m: Positive = rule(0.5, "a landmark with an identity is where the map has it, if this near [m]")
    shared_pairs: int = rule(3, "boxes that must agree with the odometry's frame ...", ge=2)
    shared_nats: NotNegative = rule(4.0, "... and evidence that it takes [nats]")
    found_pairs: int = rule(4, "boxes that must agree with a place that was searched for ...", ge=2)
    enough_pairs: int = rule(8, "... and so many end the search", ge=2)
    lead_nats: NotNegative = rule(12.0, "by which that place must beat all others [nats]")
    metre_sigmas: NotNegative = rule(2.0, "standard deviations by which a session's metre must be off to be corrected")
    near_m: Positive = rule(30.0, "how far boxes may be off behind a stretch in which nothing was seen [m]")
    largest_turn_rad: Positive = rule(0.3, "how far they may be turned then [rad]")
    drift_share: NotNegative = rule(0.02, "how far odometry may be off from one box to the next, of the distance")
    most_drift_m: Positive = rule(0.5, "the same, at most [m]")
    misfit: Positive = rule(3.0, "mean squared deviation of boxes from which the odometry is believed less")
    among_m: Positive = rule(15.0, "boxes of the map this near: a session was here before [m]")
    least_share: Share = rule(0.3, "share of the boxes seen among those of the map that must be boxes of it")
    perhaps: Share = rule(0.2, "belief from which a box of the map counts for that")
    tied_m: Positive = rule(80.0, "beyond this distance from the landmarks shared with the map, misses are ignored [m]")
    glimpse_m: Positive = rule(1.0, "a detection this near to a box of the map may be of it, at no range [m] ...")
    glimpse_share: NotNegative = rule(0.01, "... and farther off by this share of its range")
    fewest_glimpses: Count = rule(2, "such detections that a session takes")
    behind_m: Positive = rule(1.5, "what is this much farther than another box is hidden [m] ...")
    covered: Positive = rule(0.4, "... within this share of that box's length from its middle")


class LooksConfig(Section):
    """What counts as having looked at a place of the map."""

    range_margin_m: Positive = rule(
        0.2, "softness of the edge of a sensor's range, where errors of pose and map decide [m]"
    )
    bearing_margin_rad: Positive = rule(0.05, "the same of its field of view [rad]")
    worth_a_look: Share = rule(0.3, "share of a sensor's detection probability from which a landmark is looked at")
    settled_s: NotNegative = key(300.0, "a landmark seen this close to a look was there [s]")
    settled_online_s: NotNegative = rule(
        10.0, "the same while the robot drives, as long as the session is not over [s]"
    )
    beside_m: Positive = rule(1.0, "sightings this close to a place are along its line [m]")
    beside_rad: Positive = rule(0.15, "so is a landmark seen behind it within this angle [rad]")
    along_m: Positive = rule(0.3, "distance from a line of sight within which a sighting shows it to be clear [m]")
    witnesses: Count = rule(3, "frames in which another landmark must be seen along a line")
    sides: Count = rule(6, "number of sectors around a place")
    most_sides: Count = rule(3, "sectors from which a place counts as seen from all sides")
    together_m: NotNegative = rule(2.0, "cliques missed from places this close may be hidden by one object [m]")
    near_m: NotNegative = rule(0.6, "a place is visible from positions this close to one from which it was seen [m]")
    most_unseen_m: Positive = rule(100.0, "metres that earlier sessions are worth in what is said of new lines [m]")
    most_new: Positive = rule(30.0, "cliques that they are worth in it")
    least_expected: Positive = rule(2.0, "minimum expected detections of earlier looks")
    sure: Share = rule(
        0.9, "probability from which something new is told to have come after a look, not an earlier one"
    )
    lasting: Share = rule(0.5, "share of the places hidden in a session that are hidden in all earlier ones")
    sticky: float = rule(2.0, "consecutive frames that count as one independent one", ge=1.0)
    fewest_beats: Count = rule(20, "views with detections that tell how often a sensor looks")
    most_beats: Count = rule(30, "looks in a row that see nothing until it is not known any more when it looks")
    off_beat: Share = rule(0.1, "share of the time between two looks by which stamps may be off")
    flank_rad: Positive = rule(
        0.7, "angle within which something is seen on both sides of what a map has and is missed [rad]"
    )
    flank_share: Share = rule(0.6, "least range of that, as a share of the range of what is missed")
    elsewhere_m: Positive = rule(
        1.0, "distance between positions from which something narrow hides different places [m]"
    )
    one_sided_rad: Positive = rule(2.1, "angle over which a landmark of unknown orientation must be missed [rad]")
    p_flanked_hidden: Share = rule(0.05, "probability that it is hidden from one position all the same")
    p_always_hidden: Share = rule(0.003, "probability that it is hidden from all")
    p_gone: Share = rule(0.03, "probability that a landmark of a given map is nowhere")


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
    same_place_m: Positive = rule(0.3, "bodies this close to the former place of another one have taken its place [m]")
    same_turn_rad: Positive = rule(0.3, "bodies turned by less than this have not turned [rad]")
    same_spot_m: Positive = rule(0.1, "bodies this close to their former place have not moved [m]")
    new_clique_p: Share = rule(0.9, "belief in a new body before its sightings are counted")
    surely_away: Probability = rule(0.02, "belief below which a clique may be forgotten")
    forgotten_p: Probability = rule(0.05, "probability of a return below which it is forgotten")
    most_away: int = key(20, "absent cliques that are kept, in addition to the number of present ones", ge=0)
    most_stays: Count = rule(5000, "newest stays from which lifetimes are learned")


class GroupingConfig(Section):
    """Which landmarks are on one body, by how they moved."""

    p_one_body: Share = key(0.9, "probability that two landmarks of a clique are on one body")
    p_split_before: Share = rule(0.05, "the same for two nearby ones of different cliques")
    p_other_class: Share = rule(0.001, "the same for two nearby ones of different classes")
    p_moved: Share = rule(0.1, "probability that a body moves between two sessions")
    move_sigma_m: Positive = rule(2.0, "standard deviation of displacements, each axis [m]")
    misses_in_a_row: float = rule(4.0, "misses of one session that count as one independent one", ge=1.0)
    p_wrong: Share = rule(1e-3, "probability that a landmark's identity is misread for a whole session")


class LifetimeConfig(Section):
    """How lifetimes are learned from the history of a map."""

    newest: Count = key(300, "newest stays of a class from which its lifetime is learned")
    strength: Positive = rule(2.0, "pseudo-events of the average over classes in each class")
    least_ended: Count = rule(5, "ends in a chunk before it has its own lifetimes")
    sure: Share = rule(0.999, "probability above which an end of a stay counts as certain")
    firmness: tuple[Positive, ...] = rule(
        (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0),
        "candidate numbers of pseudo-ends of a class in its chunks; learned",
        min_length=1,
    )


class SightConfig(Section):
    """What is believed of lines of sight, and how it is learned."""

    most_looks: Positive = rule(
        200.0, "maximum looks along one line; beyond it, old ones fade, so that a moved wall is learned"
    )
    strength: Positive = rule(4.0, "pseudo-looks of the rate of all clear lines of that length")
    nominal_looks: Positive = rule(20.0, "pseudo-looks of the nominal rate")
    p_blocked_detect: Share = rule(0.03, "detection rate along blocked lines")
    least_rate: Share = rule(0.002, "minimum detection rate of any kind of line")
    highest_rate: Share = rule(0.98, "maximum detection rate of any kind of line")
    rate_sigma: NotNegative = key(
        1.0, "standard deviation of the log of the factor by which a sensor may detect less than others; 0: never"
    )
    rate_looks: Positive = rule(5.0, "maximum looks at one place in a session from which this is learned")
    neighbour: Probability = rule(0.35, "weight of looks from the eight cells around, in looks along the line")
    clear: Share = rule(0.9, "probability above which a line is known to be clear")
    blocked: Share = rule(0.25, "probability below which a line is known to be blocked")
    p_hidden_unseen: Share = rule(
        0.1, "probability that a place is hidden for a whole session (a shut door) if its lines were clear before"
    )
    p_hidden_beside: Share = rule(0.03, "the same if another landmark is seen along them now")
    p_hidden_unknown: Share = rule(
        0.2, "the same if they were unknown, but a landmark close to them and behind is seen"
    )
    open_space: tuple[Positive, Positive, Positive, Positive] = rule(
        (0.5, 0.05, 0.2, 0.8),
        "what is believed of new lines at first: half a wall in 5 cm, and of one place a fifth hidden",
    )
    hidden_looks: Positive = rule(5.0, "pseudo-sessions of these probabilities")
    most_sessions: Positive = rule(2000.0, "sessions of cliques after which old ones fade")

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
    near_m: Positive = rule(10.0, "margin beyond the sensor's range of the surroundings of a session [m]")
    most_sites: int = rule(3, "maximum sites of one clique", ge=1, le=100)
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
