"""The answer to 'why is this gone?', of a map whose history was written by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evermap.errors import InputError
from evermap.existence.lifetimes import Lifetimes
from evermap.existence.sites import Evidence
from evermap.maps.learning import with_priors
from evermap.maps.lives import EVERYWHERE, Life, Lives
from evermap.maps.living import LivingMap, Members, Places, Sites, Stays
from evermap.maps.store import DamagedMapError, MapStore, Provenance, RevisionKind, open_store
from evermap.maps.store.measured import LOOKS, pack_looks
from evermap.maps.why import probability_text, why
from evermap.survival import Exponential, never_leaves
from evermap.types import ChangeKind, Clock, MapChange

HOUR_S = 3600.0
LIFE_S = 10 * HOUR_S


def the_map(
    stamp_s: float, p: tuple[float, float], stays: list[tuple[int, int, float, float, float, float]]
) -> LivingMap:
    """Landmarks 5 and 6 on body 1 at site 1, landmark 9 on body 2 at site 2; beliefs by body."""
    rows = np.array(stays, dtype=np.float64).reshape(-1, 6)
    life = Life(stay=Exponential(1 / LIFE_S), n_stays=12, n_ended=3)
    return LivingMap(
        stamp_s=stamp_s,
        members=Members(
            np.array([5, 6, 9]), np.array([0, 0, -1]), np.array([1, 1, 2]), np.zeros(3, bool), np.zeros(3, bool)
        ),
        sites=Sites(np.array([1, 2]), np.array([1, 2]), *np.array([p, p]), np.zeros(2), np.full(2, stamp_s)),
        places=Places(
            np.array([1, 1, 2]), np.array([5, 6, 9]), np.array([[0.0, 0], [1, 0], [5, 5]]), *np.ones((2, 3), int)
        ),
        stays=Stays(
            rows[:, 0].astype(int), rows[:, 1].astype(int), np.zeros(len(rows), int), np.zeros((len(rows), 2)),
            *rows[:, 2:].T.copy(), np.isfinite(rows[:, 5]).astype(float),
        ),
        covariance_m2=1e-4 * np.eye(6),
        lives=Lives(np.array([0]), np.array([[EVERYWHERE, EVERYWHERE]]), (life,)),
        class_names=("pallet",),
        clock=Clock.RECORDING,
        n_cliques_ever=3,
        n_sites_ever=3,
    )  # fmt: skip


def seen(clique: int, rows: list[tuple[float, int, int, float, float, float]]) -> Evidence:
    """Stamp, hits, misses, expected, log odds, P(exists)."""
    stamp, hits, misses, expected, said, p = np.array(rows).reshape(-1, 6).T
    return Evidence(np.full(len(rows), clique), stamp, hits.astype(int), misses.astype(int), expected, said, p)


@pytest.fixture
def store(tmp_path: Path) -> MapStore:
    """Body 1 stands for two sessions, and is missed in the third; body 2 is always seen."""
    first = seen(1, [(100.0, 2, 0, 1.8, 9.0, 0.99), (160.0, 1, 1, 1.8, 4.0, 0.999)])
    second = seen(1, [(HOUR_S, 2, 0, 1.8, 9.0, 0.9999)])
    other = seen(2, [(HOUR_S, 1, 0, 0.9, 4.0, 0.95)])
    third = seen(1, [(5 * HOUR_S, 0, 2, 1.75, -3.0, 0.6), (5 * HOUR_S + 60.0, 0, 1, 0.5, -4.5, 0.02)])
    gone = MapChange((5, 6), ChangeKind.VANISHED, HOUR_S, 5 * HOUR_S, (np.nan, np.nan), 0.0, 0.98, 0, 3)
    store = open_store(tmp_path / "m.evermap", create=True)
    stay, other_stay = (1, 1, -np.inf, 100.0, HOUR_S, np.inf), (2, 2, -np.inf, HOUR_S, HOUR_S, np.inf)
    store.commit(the_map(160.0, (0.999, 0.5), [stay]), Provenance(recording="monday"), (), first, parent=0)
    store.commit(
        the_map(HOUR_S, (0.9999, 0.95), [stay, other_stay]),
        Provenance(recording="tuesday"),
        (),
        second.joined(other),
        parent=1,
    )
    ended = (*stay[:-1], 5 * HOUR_S)
    last = the_map(6 * HOUR_S, (0.02, 0.9), [ended, other_stay])
    store.commit(last, Provenance(recording="friday"), (gone,), third, parent=2)
    return store


def test_why_it_is_gone(store: MapStore) -> None:
    answer = why(store, 5)
    assert answer.headline == "landmark 5 (pallet) is believed gone: P(exists) = 0.02"
    assert answer.companions == (6,)
    assert [(v.revision, v.recording, v.n_looks, v.n_hits, v.n_misses) for v in answer.visits] == [
        (1, "monday", 2, 3, 1),
        (2, "tuesday", 1, 2, 0),
        (3, "friday", 2, 0, 3),
    ]
    np.testing.assert_allclose([v.log_odds for v in answer.visits], [13.0, 9.0, -7.5], rtol=1e-6)
    np.testing.assert_allclose([v.expected for v in answer.visits], [3.6, 1.8, 2.25], rtol=1e-6)
    np.testing.assert_allclose([v.p_exists for v in answer.visits], [0.999, 0.9999, 0.02], rtol=1e-6)
    ((revision, change),) = answer.changes
    assert (revision, change.kind) == (3, ChangeKind.VANISHED)
    text = " / ".join(answer.reasons)
    assert "last detected at 01:00:00; then P(exists) = 0.9999" in text
    # 1.75 + 0.5 expected, -3.0 - 4.5 nats
    assert "looked for in 2 frames: 3 misses and no detection, where 2.2 detections would be expected" in text
    assert "that is 7.5 nats against it" in text
    # of an exponential law with a mean of 10 h, exp(-5 h / 10 h) stay for another 5 h
    assert (
        f"{np.exp(-0.5):.0%} of those that have stayed for 58.3 min stay for another 5 h (learned from 12 stays)"
        in text
    )
    assert "shares a body with landmark 6" in text


def test_why_says_which_stays_taught_its_lifetime(store: MapStore) -> None:
    text = " / ".join(why(store, 5).reasons)
    life = store.load().lives.of(0)
    assert f"known from {life.n_stays} stays of class pallet, {life.n_ended} of which ended" in text
    assert "stated" not in text
    living = store.load()
    told = with_priors(living, {"pallet": Lifetimes(Exponential.from_mean(HOUR_S), never_leaves())}, (), 20)
    store.commit(told, Provenance(), parent=3)
    assert "; what a user stated, which is worth 20 stays" in " / ".join(why(store, 5).reasons)


def test_why_it_is_there(store: MapStore) -> None:
    before = why(store, 6, revision=2)
    assert before.headline == "landmark 6 (pallet) is believed to be there: P(exists) = 0.9999"
    assert [v.revision for v in before.visits] == [1, 2]
    assert before.changes == ()
    assert "in its newest session it was detected 2 times, where 1.8 detections were expected" in " ".join(
        before.reasons
    )
    other = why(store, 9)
    assert other.headline == "landmark 9 is believed to be there: P(exists) = 0.90"
    assert other.companions == ()


def test_an_operators_word_is_part_of_the_answer(store: MapStore) -> None:
    living = store.load()
    edit = Provenance(kind=RevisionKind.EDIT)
    store.commit(living.edited(5, pinned=True), edit, parent=3)
    store.commit(living.edited(5, deleted=True), edit, parent=4)
    answer = why(store, 5)
    assert answer.headline.startswith("landmark 5 (pallet) is not used: an operator deleted it; by its looks, P(")
    assert [(revision, word) for revision, _, word in answer.edits] == [(4, "pinned"), (5, "deleted"), (5, "unpinned")]
    assert "an operator deleted it in revision 5" in " ".join(answer.reasons)
    assert why(store, 6).edits == ()
    store.revert(3)  # what was taken back explains nothing
    assert why(store, 5).edits == ()


def test_a_session_that_was_taken_back_explains_nothing(store: MapStore) -> None:
    store.revert(2)
    answer = why(store, 5)
    assert [v.revision for v in answer.visits] == [1, 2]
    assert answer.changes == ()


def test_time_alone_can_make_it_gone(store: MapStore) -> None:
    faded = replace(store.load(2), stamp_s=60 * HOUR_S)
    faded = replace(faded, sites=replace(faded.sites, p_here=np.array([0.2, 0.9])))
    store.revert(2)
    store.commit(faded, Provenance(), parent=4)
    text = " ".join(why(store, 5).reasons)
    assert "there were no looks since; its age has made it improbable" in text
    assert f"{np.exp(-5.9):.0%} of those" in text


def test_a_landmark_nobody_knows(store: MapStore) -> None:
    with pytest.raises(InputError, match=r"no landmark 7; the nearest ids are 5, 6, 9 \(try: evermap map show"):
        why(store, 7)
    with pytest.raises(InputError, match="no landmark 7: the map is empty"):
        why(store, 7, revision=0)


@pytest.mark.parametrize(
    ("p", "text"),
    [(0.5, "0.50"), (0.99, "0.99"), (0.999, "0.9990"), (1.0, "> 0.9999"), (0.0, "< 0.0001"), (0.002, "0.0020")],
)
def test_probabilities_are_never_certain(p: float, text: str) -> None:
    assert probability_text(p) == text


def test_looks_of_sessions_that_were_entered_again_are_those_of_the_newest(store: MapStore) -> None:
    """A late session between the first two: what they saw of body 1, which then had another number, is weighed anew."""
    members = replace(the_map(HOUR_S, (0.5, 0.5), []).members, clique_id=np.array([1, 1, 8]))
    renumbered = replace(members, clique_id=np.array([8, 8, 2]))
    late = seen(1, [(0.5 * HOUR_S, 1, 1, 1.8, 2.0, 0.97)]).joined(seen(8, [(0.5 * HOUR_S, 1, 0, 0.9, 3.0, 0.9)]))
    again = {0: (late, members), 2: (seen(8, [(HOUR_S, 1, 1, 1.7, 8.0, 0.99)]), renumbered), 3: (seen(1, []), members)}
    data = pack_looks(again)
    origin = Provenance(recording="monday evening", stamp_from_s=0.5 * HOUR_S)
    store.commit(store.load(), origin, (), seen(1, []), parent=3, attachments={LOOKS: data})
    answer = why(store, 5)
    told = [(visit.recording, visit.n_hits, visit.n_misses, visit.p_exists) for visit in answer.visits]
    assert told == [
        ("monday", 3, 1, pytest.approx(0.999)),
        ("monday evening", 1, 1, pytest.approx(0.97)),
        ("tuesday", 1, 1, pytest.approx(0.99)),
    ]
    assert answer.evidence.stamp_s.tolist() == [100.0, 160.0, 0.5 * HOUR_S, HOUR_S]
    assert [visit.recording for visit in why(store, 9).visits] == ["monday evening"]
    assert [visit.recording for visit in why(store, 5, revision=3).visits] == ["monday", "tuesday", "friday"]
    store.commit(store.load(), Provenance(recording="next"), (), seen(1, []), parent=4, attachments={LOOKS: data[:-9]})
    with pytest.raises(DamagedMapError, match="the looks of revision 5 are not valid"):
        why(store, 5)
