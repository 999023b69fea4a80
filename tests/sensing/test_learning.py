"""Does it learn what is so? Detections drawn from the model itself, by truths that it is not told."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap.existence import single
from evermap.sensing import learned
from evermap.sensing.learned import LearnedDetection
from evermap.sensing.profile import Assumed, Profile, facing_middles, range_middles
from evermap.survival import Exponential
from evermap.types import BoolArray, FloatArray
from evermap_studies.worlds.sensors import LIDAR, InField, sight

from .plain_learned import FACES, HIGHEST

FIRM = 1e7
"""Hits that make a ratio stay where it is."""


@dataclass
class Truth:
    """A sensor, and what stands before cliques: rates at the middles of the bins, a chain in continuous time."""

    by_range: FloatArray
    by_facing: FloatArray
    p_false: float
    come_hz: FloatArray | float = 0.0
    go_hz: FloatArray | float = 1.0

    def chances(self, model: LearnedDetection, position: FloatArray, turn: FloatArray, own: FloatArray | float = 1.0):
        """(K,) probability of a detection if there and free, and of a false alarm."""
        view = sight(model.landmark_m, model.outward, position, turn)
        assumed = model.profile.assumed
        inside = InField(assumed.field, assumed.sigma_position_m, assumed.sigma_attitude_rad).probability(view)
        rate = np.interp(view.range_m, range_middles(assumed.field.range_max_m), self.by_range)
        rate *= np.interp(view.facing, facing_middles(), self.by_facing)
        return inside * np.minimum(rate * own, HIGHEST), inside * self.p_false

    def occlusions(self, rng: np.random.Generator, steps: int, cliques: int, step_s: float) -> BoolArray:
        """(steps, cliques) whether each is hidden, every `step_s`."""
        total = np.asarray(self.come_hz) + self.go_hz
        share = np.broadcast_to(self.come_hz / total, cliques)
        hidden = np.empty((steps, cliques), dtype=bool)
        hidden[0] = rng.random(cliques) < share
        for n in range(1, steps):
            hidden[n] = rng.random(cliques) < share + (hidden[n - 1] - share) * np.exp(-total * step_s)
        return hidden


def told(start: Profile, truth: Truth) -> Profile:
    """A profile that knows the rates, and has no doubt of them."""
    return replace(
        start,
        range_hits=FIRM * truth.by_range,
        range_expected=np.full(16, FIRM),
        facing_hits=FIRM * truth.by_facing,
        facing_expected=np.full(16, FIRM),
        false_hits=FIRM * truth.p_false,
        false_looks=FIRM,
    )


def scene(rng: np.random.Generator, cliques: int, each: int):
    """Landmarks (K, 3) all around, and which clique each is of."""
    clique = np.repeat(np.arange(cliques), each)
    bearing, range_m = rng.uniform(-np.pi, np.pi, cliques), rng.uniform(2.0, 14.0, cliques)
    middle = np.column_stack([range_m * np.cos(bearing), range_m * np.sin(bearing), np.zeros(cliques)])
    return middle[clique] + rng.normal(0.0, 0.7, (len(clique), 3)), clique


def all_the_same(model: LearnedDetection) -> LearnedDetection:
    """Landmarks without a detectability of their own."""
    firm = np.full_like(model.hits, FIRM)
    return replace(model, hits=firm, expected=firm.copy())


def watch(
    model: LearnedDetection, truth: Truth, rng: np.random.Generator, steps: int, own=1.0, sure=1.0
) -> LearnedDetection:
    """Look once a second from everywhere at cliques that are there all the time."""
    clique = np.repeat(np.arange(len(model)), np.diff(model.first))
    hidden = truth.occlusions(rng, steps, len(model), 1.0)
    for n in range(steps):
        position = rng.normal(0.0, 3.0, 3) * [1.0, 1.0, 0.3]
        turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
        direction = np.argmax((position - model.landmark_m) @ FACES.T, axis=1)
        factor = own if np.isscalar(own) else own[np.arange(len(clique)), direction]
        p_detect, alarm = truth.chances(model, position, turn, factor)
        detected = (rng.random(len(clique)) < p_detect * ~hidden[n][clique]) | (rng.random(len(clique)) < alarm)
        model, seen = learned.look(model, float(n), position, turn, detected)
        model = learned.confirm(model, seen, np.full(len(model), sure))
    return model


GENTLE = Truth(by_range=np.linspace(0.95, 0.35, 16), by_facing=np.linspace(0.1, 0.9, 16), p_false=0.02)
"""Straight lines, which interpolation between the bins has exactly; other ones than those assumed."""
SOLID = replace(GENTLE, by_facing=np.where(facing_middles() < 0.0, 1e-3, 0.8))
"""What is turned away is not seen, so that its detections are false alarms."""


@pytest.mark.parametrize("occluded", [False, True])
def test_range_and_incidence_come_out_within_their_errors(occluded):
    """From assumptions that are wrong; of two factors only the product is seen, so sizes are compared together."""
    rng = np.random.default_rng(21)
    truth = replace(GENTLE, come_hz=0.03, go_hz=0.2) if occluded else GENTLE
    start = Profile.of(Assumed(LIDAR, fading_m=6.0))
    start = replace(start, false_hits=FIRM * truth.p_false, false_looks=FIRM)
    profile = watch(all_the_same(learned.init(*scene(rng, 40, 12), start)), truth, rng, 300).profile
    size = 0.0
    for name, true in (("range", truth.by_range), ("facing", truth.by_facing)):
        hits = getattr(profile, f"{name}_hits") - getattr(start, f"{name}_hits")
        off = np.log(getattr(profile, f"{name}_rate") / true)
        mean = np.average(off, weights=hits)
        seen = hits > 100.0
        assert seen.sum() >= 12
        assert (np.abs(off - mean)[seen] < 4.0 / np.sqrt(hits[seen])).all()
        wrong = np.log(getattr(start, f"{name}_rate") / true)
        assert np.abs((wrong - np.average(wrong, weights=hits)) * np.sqrt(hits)).max() > 10.0
        size += mean
    assert abs(size) < 4.0 / np.sqrt(hits.sum())


@pytest.mark.parametrize("gone", [False, True])
def test_false_alarms_are_counted_on_what_cannot_be_seen(gone):
    """On what is turned away, or on all of what has gone."""
    rng = np.random.default_rng(22)
    truth = replace(SOLID, by_range=np.zeros(16)) if gone else SOLID
    start = Profile.of(Assumed(LIDAR))
    known = replace(told(start, SOLID), false_hits=start.false_hits, false_looks=start.false_looks)
    model = all_the_same(learned.init(*scene(rng, 40, 12), known))
    profile = watch(model, truth, rng, 150, sure=0.0 if gone else 1.0).profile
    error = np.sqrt(truth.p_false / profile.false_looks)
    # what was assumed still counts as its looks
    looks = profile.false_looks - start.false_looks
    expected = (start.false_hits + truth.p_false * looks) / profile.false_looks
    assert abs(profile.p_false - expected) < 4.0 * error
    assert abs(start.p_false - expected) > 20.0 * error


@pytest.mark.parametrize(("come_hz", "length_s"), [(0.0, 1.0), (0.03, 5.0), (0.01, 12.0), (0.1, 2.0)])
def test_it_finds_out_how_often_and_how_long_somebody_stands_there(come_hz, length_s):
    rng = np.random.default_rng(23)
    truth = replace(GENTLE, come_hz=come_hz, go_hz=1.0 / length_s)
    model = all_the_same(learned.init(*scene(rng, 40, 12), told(Profile.of(Assumed(LIDAR)), truth)))
    chain = watch(model, truth, rng, 250).profile.occlusion
    best = int(np.argmax(chain.weight))
    assert (chain.come_hz[best], chain.go_hz[best]) == pytest.approx((come_hz, 1.0 / length_s))
    assert chain.weight[best] > 0.9
    assert chain.share == pytest.approx(come_hz / (come_hz + 1.0 / length_s), abs=0.02)


def test_a_landmark_that_is_hidden_from_one_side_is_found_out():
    """Something stands before every other landmark towards +x; nothing is wrong with it from elsewhere."""
    rng = np.random.default_rng(24)
    model = learned.init(*scene(rng, 20, 10), told(Profile.of(Assumed(LIDAR)), GENTLE))
    own = np.ones((200, 6))
    own[::2, 0] = 0.0
    after = watch(model, GENTLE, rng, 400, own)
    prior = model.profile.assumed.hits
    hits, expected = np.float64(after.hits - prior), np.float64(after.expected - prior)
    factor = after.hits / after.expected
    seen = expected > 20.0
    hidden = seen & (own == 0.0)
    assert hidden.sum() > 15
    # what is left of the first guess, of 3 hits, and of false alarms, some 2 % of the looks
    assert (factor[hidden] < (2.0 * prior + 0.1 * expected[hidden]) / (prior + expected[hidden])).all()
    assert factor[hidden].mean() < 0.15
    free = seen & (own == 1.0)
    assert free.sum() > 200
    score = (hits - expected)[free] / np.sqrt(expected[free])
    assert np.abs(score).max() < 4.0
    assert abs(score.mean()) < 4.0 / np.sqrt(free.sum())


def test_beliefs_are_right_as_often_as_they_say():
    """20,000 cliques in a world as assumed: of those that are believed to be there with 70 %, 70 % are; and so on.

    Every clique has its own lifetime and its own one of the chains that the profile believes in.
    """
    rng = np.random.default_rng(25)
    count, each, steps, step_s, rate_hz = 20_000, 4, 15, 2.0, 1.0 / 40.0
    truth = Truth(np.linspace(0.6, 0.2, 16), np.linspace(0.2, 0.7, 16), p_false=0.05)
    start = told(Profile.of(Assumed(LIDAR, p_never_occluded=0.2)), truth)
    chain = start.occlusion
    drawn = rng.choice(len(chain.weight), count, p=chain.weight)
    truth = replace(truth, come_hz=chain.come_hz[drawn], go_hz=chain.go_hz[drawn])
    landmark, clique = scene(rng, count, each)
    model = all_the_same(learned.init(landmark, clique, start))
    belief = single.init(count, Exponential(rate_hz))
    death_s = rng.exponential(1.0 / rate_hz, count)
    hidden = truth.occlusions(rng, steps, count, step_s)
    for n in range(steps):
        stamp_s = (n + 1) * step_s
        there = death_s >= stamp_s
        position, turn = rng.normal(0.0, 1.0, 3), Rotation.from_euler("z", rng.uniform(-3.0, 3.0)).as_matrix()
        p_detect, alarm = truth.chances(model, position, turn)
        visible = (there & ~hidden[n])[clique]
        detected = (rng.random(len(clique)) < p_detect * visible) | (rng.random(len(clique)) < alarm)
        model, seen = learned.look(model, stamp_s, position, turn, detected)
        belief = belief.observe(seen.stamp_s, seen.log_there, seen.log_gone)
    looked = seen.expected > 0
    assert looked.sum() > 0.9 * count
    well_calibrated(belief.probability[looked], there[looked])
    # and of those that are there, how many are hidden
    alive = looked & there
    well_calibrated(seen.p_occluded[alive], hidden[-1][alive])


def well_calibrated(probability: FloatArray, happened: BoolArray) -> None:
    """Within three standard errors in every bin, and in most of them there is something to be seen."""
    edges = np.array([0.0, 0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97, 0.99, 1.0])
    which = np.digitize(probability, edges[1:-1])
    tested = 0
    for b in range(len(edges) - 1):
        p, y = probability[which == b], happened[which == b]
        if (p * (1.0 - p)).sum() < 5.0:
            continue
        tested += 1
        assert abs(y.sum() - p.sum()) < 3.0 * np.sqrt((p * (1.0 - p)).sum())
    assert tested >= 8
