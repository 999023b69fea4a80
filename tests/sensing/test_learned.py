"""The learned detection model: against a plain one that does everything slowly, and by the laws that it must obey."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import log_softmax

from evermap.errors import DataError, InputError
from evermap.existence import single
from evermap.sensing import learned
from evermap.sensing.learned import LearnedDetection
from evermap.sensing.profile import Assumed, Field, Profile, Projection
from evermap.survival import Exponential
from evermap_studies.bateman2020 import joint
from evermap_studies.worlds.sensors import CAMERA, LIDAR, sight

from .plain_learned import FACES, PlainModel, chance_in_field

FIELDS = {"lidar": LIDAR, "camera": CAMERA, "ahead": Field(9.0, 1.2, 0.4, Projection.SPHERICAL)}
SHARED = ("range_hits", "range_expected", "facing_hits", "facing_expected", "false_hits", "false_looks")


def cliques(rng, sizes=(1, 7, 12, 5, 9)):
    """Landmarks (K, 3) around a few places, and which clique each is of."""
    clique = np.repeat(np.arange(len(sizes)), sizes)
    middle = rng.uniform(-9.0, 9.0, (len(sizes), 3)) * [1.0, 1.0, 0.2]
    return middle[clique] + rng.normal(0.0, 0.8, (len(clique), 3)), clique


def frames(rng, n, landmarks, *, p_detect=0.35):
    """`n` frames at random instants from random poses: stamp, position, rotation, detections."""
    stamp_s = 50.0 + np.cumsum(rng.exponential(2.0, n))
    for stamp in stamp_s:
        turn = Rotation.from_euler("ZYX", rng.normal(size=3) * [2.0, 0.1, 0.1]).as_matrix()
        yield float(stamp), rng.normal(0.0, 4.0, 3) * [1.0, 1.0, 0.2], turn, rng.random(landmarks) < p_detect


def same(one: LearnedDetection, other: LearnedDetection, rows=slice(None), landmarks=slice(None)) -> None:
    """Bit for bit, in these cliques and landmarks."""
    for name in ("stamp_s", "occluded", "log_chain", "pending"):
        np.testing.assert_array_equal(getattr(one, name)[rows], getattr(other, name)[rows], err_msg=name)
    for name in ("hits", "expected"):
        np.testing.assert_array_equal(getattr(one, name)[landmarks], getattr(other, name)[landmarks], err_msg=name)


def test_a_whole_session_is_its_looks_each_confirmed():
    rng = np.random.default_rng(3)
    landmark = cliques(rng)[0]
    each = np.arange(len(landmark))
    start = learned.init(landmark, each, Assumed(field=LIDAR, p_false=0.02, p_never_occluded=0.3))
    looks = list(frames(rng, 60, len(each)))
    pose = np.tile(np.eye(4), (len(looks), 1, 1))
    pose[:, :3, 3], pose[:, :3, :3] = [look[1] for look in looks], [look[2] for look in looks]
    stamp_s, detected = np.array([look[0] for look in looks]), np.array([look[3] for look in looks])
    there = rng.random(detected.shape) < 0.8
    there[5] = False
    found = learned.watched(start, stamp_s, pose, detected, there)
    model = start
    for (stamp, position, turn, hit), active in zip(looks, there, strict=True):
        model, seen = learned.look(model, stamp, position, turn, hit, active=active)
        model = learned.confirm(model, seen, np.ones(len(each)))
    same(found, model)
    for name in (*SHARED, "log_weight"):
        np.testing.assert_allclose(getattr(found.profile, name), getattr(model.profile, name), rtol=1e-12, atol=1e-12)
    assert found.profile.range_expected.sum() > start.profile.range_expected.sum() + 10.0
    np.testing.assert_array_equal(start.hits, learned.init(landmark, each, start.profile).hits)  # not in place


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("seed", [0, 1])
def test_it_is_the_plain_model_frame_by_frame(name, seed):
    rng = np.random.default_rng(seed)
    landmark, clique = cliques(rng)
    assumed = Assumed(field=FIELDS[name], p_false=0.02, p_never_occluded=0.3)
    model, plain = learned.init(landmark, clique, assumed), PlainModel(landmark, clique, Profile.of(assumed))
    np.testing.assert_allclose(model.outward, plain.outward, atol=1e-12)
    looked = 0
    for stamp_s, position, turn, detected in frames(rng, 25, len(clique)):
        active = rng.random(5) < 0.85
        model, seen = learned.look(model, stamp_s, position, turn, detected, active=active)
        expected = plain.look(stamp_s, position, turn, detected, active)
        for c, row in enumerate(expected):
            if row is None:
                assert seen.expected[c] == 0
                assert np.isnan([seen.stamp_s[c], seen.log_there[c], seen.log_gone[c], seen.p_occluded[c]]).all()
                continue
            looked += 1
            assert seen.stamp_s[c] == stamp_s
            assert seen.expected[c] == row.expected
            found = (seen.log_there[c], seen.log_gone[c], seen.p_occluded[c])
            np.testing.assert_allclose(found, (row.log_there, row.log_gone, row.p_occluded), rtol=1e-6, atol=1e-12)
        # sure that it is there, sure that it has gone, or neither
        probability = rng.choice([0.9999, 0.9, 0.0005], 5, p=[0.5, 0.3, 0.2])
        model = learned.confirm(model, seen, probability)
        plain.confirm(expected, probability)

        np.testing.assert_allclose(model.hits, plain.hits, rtol=1e-5)
        np.testing.assert_allclose(model.expected, plain.expected, rtol=1e-5)
        np.testing.assert_allclose(model.stamp_s, plain.stamp, rtol=0.0)
        np.testing.assert_allclose(model.occluded, np.array(plain.state)[:, :, 1], rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(model.log_chain, plain.log_chain, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(model.pending, [sums.row() for sums in plain.sums], rtol=1e-5, atol=1e-9)
        for name_ in SHARED:
            found, wanted = getattr(model.profile, name_), getattr(plain.profile, name_)
            np.testing.assert_allclose(found, wanted, rtol=1e-5, err_msg=name_)
        weights = (log_softmax(model.profile.log_weight), log_softmax(plain.profile.log_weight))
        np.testing.assert_allclose(*weights, rtol=1e-5, atol=1e-6)
    assert looked > 20
    assert 0.0 < model.profile.false_hits != assumed.p_false * assumed.p_false_looks


def test_where_nobody_stands_in_the_way_it_is_the_joint_clique_filter():
    """Certain that nobody does, and with the miss rates of the model, both believe the same."""
    rng = np.random.default_rng(4)
    landmark, clique = cliques(rng)
    start = Profile.of(Assumed(field=LIDAR, p_false=0.02))
    start = replace(start, log_weight=np.where(np.arange(len(start.log_weight)) == 0, 0.0, -np.inf))
    model = learned.init(landmark, clique, start)
    ours = theirs = single.init(5, Exponential(0.05))
    for stamp_s, position, turn, detected in frames(rng, 12, len(clique)):
        view = sight(landmark, model.outward, position, turn)
        middles = (np.arange(16) + 0.5) / 16
        rate = np.interp(view.range_m / LIDAR.range_max_m, middles, start.range_rate)
        rate *= np.interp(0.5 * (view.facing + 1.0), middles, start.facing_rate)
        face = np.argmax(view.direction @ FACES.T, axis=1)[:, None]
        rate *= (np.take_along_axis(model.hits, face, 1) / np.take_along_axis(model.expected, face, 1))[:, 0]
        one_by_one = [sight(landmark[[k]], model.outward[[k]], position, turn) for k in range(len(clique))]
        inside = np.array([chance_in_field(LIDAR, 0.05, math.radians(1.0), one) for one in one_by_one])
        alarm = inside * 0.02
        p_miss = (1.0 - inside * np.minimum(rate, 0.98)) * (1.0 - alarm)

        model, seen = learned.look(model, stamp_s, position, turn, detected)
        np.testing.assert_array_equal(seen.p_occluded[seen.expected > 0], 0.0)
        ours = ours.observe(seen.stamp_s, seen.log_there, seen.log_gone)
        theirs = joint.jcf(theirs, stamp_s, detected, p_miss, alarm, inside > 0.0, clique)
        np.testing.assert_allclose(ours.log_odds, theirs.log_odds, rtol=1e-5, atol=1e-6)
    assert np.ptp(ours.log_odds) > 5.0


def run_frames(model, looks, *, landmark_of=None, active=None, probability=None):
    """All frames; the model after them, and what each look said."""
    every = []
    for stamp_s, position, turn, detected in looks:
        hit = detected if landmark_of is None else detected[landmark_of]
        model, seen = learned.look(model, stamp_s, position, turn, hit, active=active)
        if probability is not None:
            model = learned.confirm(model, seen, np.full(len(model), probability))
        every.append(seen)
    return model, every


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
def test_a_world_that_is_moved_as_a_whole_is_the_same_world(seed):
    """By quarter turns: directions change their faces, and nothing else changes."""
    rng = np.random.default_rng(seed)
    landmark, clique = cliques(rng)
    turn = Rotation.create_group("O")[rng.integers(24)].as_matrix().round()
    shift = rng.normal(0.0, 100.0, 3)
    looks = list(frames(rng, 10, len(clique)))
    moved = [(t, turn @ p + shift, turn @ r, hit) for t, p, r, hit in looks]
    one, said = run_frames(learned.init(landmark, clique, Assumed(CAMERA)), looks, probability=1.0)
    other, said_too = run_frames(
        learned.init(landmark @ turn.T + shift, clique, Assumed(CAMERA)), moved, probability=1.0
    )
    for here, there in zip(said, said_too, strict=True):
        for name in ("log_there", "log_gone", "p_occluded", "expected"):
            np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=1e-6, atol=1e-9)
    face = np.argmax(FACES @ (turn @ FACES.T), axis=0)
    np.testing.assert_allclose(other.hits[:, face], one.hits, rtol=1e-5)
    np.testing.assert_allclose(other.expected[:, face], one.expected, rtol=1e-5)
    np.testing.assert_allclose(other.profile.facing_rate, one.profile.facing_rate, rtol=1e-6)
    assert (one.hits > 3.0).any()


def test_cliques_that_are_not_looked_at_stay_as_they_are():
    rng = np.random.default_rng(7)
    landmark, clique = cliques(rng)
    landmark[clique == 2] += [500.0, 0.0, 0.0]  # never in the field
    looks = list(frames(rng, 12, len(clique)))
    model, _ = run_frames(learned.init(landmark, clique, Assumed(LIDAR)), looks[:6])
    active = np.array([True, True, True, False, True])
    after, said = run_frames(model, looks[6:], active=active)
    same(after, model, rows=[2, 3], landmarks=np.isin(clique, [2, 3]))
    assert np.isnan(after.stamp_s[2])
    for seen in said:
        np.testing.assert_array_equal(seen.expected[[2, 3]], 0)
        np.testing.assert_array_equal(np.isnan(seen.stamp_s), seen.expected == 0)
    assert (after.stamp_s[[0, 1, 4]] > model.stamp_s[[0, 1, 4]]).any()


def test_looking_and_confirming_leave_the_model_before_them_alone():
    rng = np.random.default_rng(9)
    landmark, clique = cliques(rng)
    looks = list(frames(rng, 6, len(clique)))
    model, _ = run_frames(learned.init(landmark, clique, Assumed(LIDAR)), looks[:5])
    before = {f.name: np.array(getattr(model, f.name)) for f in fields(LearnedDetection) if f.name != "profile"}
    shared = {name: np.array(getattr(model.profile, name)) for name in (*SHARED, "log_weight")}
    run_frames(model, looks[5:], probability=1.0)
    for name, was in before.items():
        np.testing.assert_array_equal(getattr(model, name), was, err_msg=name)
    for name, was in shared.items():
        np.testing.assert_array_equal(getattr(model.profile, name), was, err_msg=name)


def test_cliques_know_nothing_of_each_other():
    """Two in one model, while nothing is confirmed, are two models."""
    rng = np.random.default_rng(11)
    landmark, clique = cliques(rng, sizes=(6, 11))
    looks = list(frames(rng, 15, 17))
    both, said = run_frames(learned.init(landmark, clique, Assumed(LIDAR)), looks)
    for c in range(2):
        of = np.flatnonzero(clique == c)
        alone, said_alone = run_frames(
            learned.init(landmark[of], np.zeros(len(of), dtype=int), Assumed(LIDAR)), looks, landmark_of=of
        )
        for name in ("stamp_s", "occluded", "log_chain", "pending"):
            np.testing.assert_array_equal(getattr(alone, name)[0], getattr(both, name)[c])
        np.testing.assert_array_equal(alone.hits, both.hits[of])
        np.testing.assert_array_equal(alone.expected, both.expected[of])
        for one, two in zip(said, said_alone, strict=True):
            assert (one.log_there[c], one.log_gone[c]) == (two.log_there[0], two.log_gone[0]) or one.expected[c] == 0
    assert both.pending[:, :16].sum() > 5.0


def test_what_two_robots_learned_is_added_up():
    """From the same assumptions, each from its own clique: the sum is what one learned from both."""
    rng = np.random.default_rng(12)
    landmark, clique = cliques(rng, sizes=(6, 11))
    looks = list(frames(rng, 15, 17))

    def profile_of(model, looks, landmark_of=None):
        model, _ = run_frames(model, looks[:-1], landmark_of=landmark_of)
        stamp_s, position, turn, detected = looks[-1]
        hit = detected if landmark_of is None else detected[landmark_of]
        model, seen = learned.look(model, stamp_s, position, turn, hit)
        assert (seen.expected > 0).all()
        return learned.confirm(model, replace(seen, p_occluded=np.zeros(len(model))), np.ones(len(model))).profile

    looks[-1] = (looks[-1][0], landmark.mean(axis=0) + 0.1, np.eye(3), np.ones(17, dtype=bool))
    together = profile_of(learned.init(landmark, clique, Assumed(LIDAR)), looks)
    rows = [np.flatnonzero(clique == c) for c in range(2)]
    one, other = (
        profile_of(learned.init(landmark[of], np.zeros(len(of), dtype=int), Assumed(LIDAR)), looks, of) for of in rows
    )
    added = one + other
    for name in SHARED:
        np.testing.assert_allclose(getattr(added, name), getattr(together, name), rtol=1e-12, err_msg=name)
    np.testing.assert_allclose(added.occlusion.weight, together.occlusion.weight, rtol=1e-9)
    assert together.range_hits.sum() > 10.0 + Profile.of(Assumed(LIDAR)).range_hits.sum()


def test_the_order_of_landmarks_within_a_clique_does_not_matter():
    rng = np.random.default_rng(13)
    landmark, clique = cliques(rng)
    order = np.lexsort((rng.random(len(clique)), clique))
    looks = list(frames(rng, 12, len(clique)))
    one, said = run_frames(learned.init(landmark, clique, Assumed(LIDAR)), looks, probability=1.0)
    other, said_too = run_frames(
        learned.init(landmark[order], clique, Assumed(LIDAR)), looks, landmark_of=order, probability=1.0
    )
    assert (order != np.arange(len(order))).any()
    np.testing.assert_allclose(other.hits, one.hits[order], rtol=1e-5)
    np.testing.assert_allclose(other.profile.range_rate, one.profile.range_rate, rtol=1e-6)
    for here, there in zip(said, said_too, strict=True):
        np.testing.assert_allclose(there.log_there, here.log_there, rtol=1e-6)


@pytest.mark.parametrize("detected", [True, False])
def test_overwhelming_evidence_stays_finite(detected):
    """A thousand landmarks that all say the same, again and again."""
    landmark = np.random.default_rng(0).normal([4.0, 0.0, 0.0], 0.5, (1000, 3))
    model = learned.init(landmark, np.zeros(1000, dtype=int), Assumed(LIDAR))
    for step in range(30):
        model, seen = learned.look(model, float(step), np.zeros(3), np.eye(3), np.full(1000, detected))
        model = learned.confirm(model, seen, np.array([1.0]))
        said = [seen.log_there[0], seen.log_gone[0], seen.p_occluded[0], *model.occluded[0], *model.log_chain[0]]
        assert np.isfinite(said).all()
        assert np.isfinite(model.profile.log_weight).all()
        # misses are explained by somebody in the way; hits by nothing else than its being there
        assert (seen.log_there[0] - seen.log_gone[0] > 500.0) == detected
        assert seen.p_occluded[0] == pytest.approx(0.0 if detected else 1.0, abs=1e-3)


def test_a_landmark_in_the_middle_of_its_clique_faces_nowhere():
    landmark = np.array([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    model = learned.init(landmark, np.zeros(3, dtype=int), Assumed(LIDAR))
    np.testing.assert_array_equal(model.outward, [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert len(model) == 1


PLACES = np.zeros((3, 3))


@pytest.mark.parametrize(
    ("landmark_m", "clique", "said"),
    [
        (np.zeros((3, 2)), [0, 0, 0], "landmark_m"),
        (PLACES, [0, 0], "landmark_m"),
        (np.full((3, 3), np.nan), [0, 0, 0], "row 0"),
        (PLACES, [0, 2, 2], "row 1: clique 2"),
        (PLACES, [0, 1, 0], "row 2: clique 0"),
        (PLACES, [1, 1, 1], "row 0: clique 1"),
        (PLACES, [-1, 0, 1], "clique"),
        (PLACES, [0.0, 0.5, 1.0], "whole numbers"),
        (np.zeros((0, 3)), np.zeros(0, dtype=int), "clique"),
    ],
)
def test_landmarks_that_cannot_be_are_said_in_one_line(landmark_m, clique, said):
    with pytest.raises(InputError, match=said) as error:
        learned.init(landmark_m, np.array(clique), Assumed(LIDAR))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"detected": np.ones(3, dtype=bool)}, "detected"),
        ({"detected": np.ones(4)}, "detected"),
        ({"position_m": np.zeros(2)}, "position_m"),
        ({"position_m": np.array([0.0, np.nan, 0.0])}, "position_m"),
        ({"rotation": np.eye(4)}, "rotation"),
        ({"rotation": 2.0 * np.eye(3)}, "rotation"),
        ({"rotation": np.full((3, 3), np.nan)}, "rotation"),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "rotation"),
        ({"stamp_s": math.nan}, "stamp_s"),
        ({"stamp_s": 4.0}, r"clique 0 at 5\.0 s"),
        ({"active": np.ones(1, dtype=bool)}, "active"),
        ({"active": np.ones(2)}, "active"),
    ],
)
def test_looks_that_cannot_be_are_said_in_one_line(changed, field):
    model = learned.init(np.full((4, 3), 2.0) + np.eye(4, 3), np.array([0, 0, 1, 1]), Assumed(LIDAR))
    look = {"stamp_s": 5.0, "position_m": np.zeros(3), "rotation": np.eye(3), "detected": np.ones(4, dtype=bool)}
    model, _ = learned.look(model, **look)
    with pytest.raises(InputError, match=field) as error:
        learned.look(model, **(look | changed))
    assert "\n" not in str(error.value)


def test_beliefs_that_cannot_be_are_said_in_one_line():
    model = learned.init(np.array([[5.0, 0.0, 0.0], [900.0, 0.0, 0.0]]), np.array([0, 1]), Assumed(LIDAR))
    model, seen = learned.look(model, 0.0, np.zeros(3), np.eye(3), np.ones(2, dtype=bool))
    with pytest.raises(InputError, match="probability"):
        learned.confirm(model, seen, np.ones(3))
    for wrong in (1.5, -0.1, np.nan):
        with pytest.raises(DataError, match=r"row 0.*probability") as error:
            learned.confirm(model, seen, np.array([wrong, 0.5]))
        assert "\n" not in str(error.value)
    # of what was not looked at nobody asks
    after = learned.confirm(model, seen, np.array([1.0, np.nan]))
    assert after.profile.range_hits.sum() > model.profile.range_hits.sum()
