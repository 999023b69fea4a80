"""What landmarks are called: short names that stay, and those that operators give."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from random_maps import assert_same, random_map
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.errors import InputError
from evermap.io import read_prior_map
from evermap.io.map_formats import format_called, write_map
from evermap.maps.diff import diff
from evermap.maps.living import LivingMap
from evermap.maps.names import MOST, Renamed, anonymous_text, distinct_text, name_landmarks
from evermap.maps.store import Provenance, open_store
from evermap.maps.store.content import pack
from evermap.maps.why import why
from evermap.runs.edits import rename_landmark
from evermap.types import ChangeKind, Landmarks, MapChange, landmark_code, landmark_id_of, landmark_label

START_S = 1704105328.074


def names(texts: Sequence[str], renamed: Renamed = Renamed()) -> list[str]:  # noqa: B008
    """What landmarks with these texts are called, in their order."""
    found = name_landmarks(tuple(sorted(texts)), renamed)
    return [found[landmark_id_of(text)] for text in texts]


def nameless(seed: int = 0, kinds: Sequence[str] = ("chair", "", "tag")) -> tuple[LivingMap, dict[str, int]]:
    """A map in which some landmarks were named by the map itself, and one has a text; ids of all by their texts."""
    living = random_map(seed, cliques=6)
    texts = [anonymous_text(kind, k + 1, START_S) for k, kind in enumerate(kinds)] + ["door"]
    ids = living.members.landmark_id.copy()
    new = dict(zip(ids[-len(texts) :].tolist(), map(landmark_id_of, texts), strict=True))
    order = np.argsort([new.get(one, one) for one in ids.tolist()], kind="stable")
    members = replace(living.members[order], landmark_id=np.array([new.get(one, one) for one in ids.tolist()])[order])
    name = np.array([new.get(one, one) for one in living.places.landmark_id.tolist()])
    rows = np.lexsort((name, living.places.site_id))
    both = np.column_stack([2 * rows, 2 * rows + 1]).ravel()
    assert not isinstance(living.covariance_m2, tuple)
    living = replace(
        living,
        members=members,
        places=replace(living.places, landmark_id=name)[rows],
        covariance_m2=np.asarray(living.covariance_m2)[np.ix_(both, both)],
        landmark_texts=tuple(sorted(texts)),
    )
    return living, {text: landmark_id_of(text) for text in texts}


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["map", *map(str, arguments)])


def test_a_name_is_the_class_and_a_code_that_depends_on_nothing_else() -> None:
    texts = [anonymous_text("chair", 53, START_S), anonymous_text("", 7, START_S), "door", "tag-7"]
    assert texts[:2] == ["chair-53@1704105328.074", "landmark-7@1704105328.074"]
    chair, unknown, *given = names(texts)
    assert chair == f"chair {landmark_code(landmark_id_of(texts[0]))}"
    assert unknown == landmark_code(landmark_id_of(texts[1]))  # what is known of it is in no name
    assert given == ["door", "tag-7"]
    assert len(unknown) == 4
    more = [anonymous_text("chair", k, START_S + day) for k in range(40) for day in range(1, 5)]
    assert names(texts + more)[:2] == [chair, unknown]
    assert names(texts[:1]) == [chair]


def test_of_two_with_one_code_the_younger_has_more_digits() -> None:
    """With 24,000 codes some of 700 chairs share one: still every name is there once, and none of the older changes."""
    texts = [anonymous_text("chair", k % 70 + 1, START_S + 86400.0 * (k // 70)) for k in range(700)]
    found = names(texts)
    assert len(set(found)) == 700
    short = [f"chair {landmark_code(landmark_id_of(text))}" for text in texts]
    again = [name in short[:k] for k, name in enumerate(short)]
    assert 2 <= sum(again) <= 30  # 700^2 / 2 / 24,000 are expected
    for name, code, twice in zip(found, short, again, strict=True):
        assert name.startswith(code)
        assert (len(name) > len(code)) == twice
    assert names(texts[:350]) == found[:350]
    assert names(texts[:350] + ["door"])[:350] == found[:350]


def test_the_code_of_more_digits_goes_on_from_that_of_fewer() -> None:
    whole = landmark_code(landmark_id_of("a"), 12)
    assert len(whole) == 13
    for digits in range(1, 12):
        assert landmark_code(landmark_id_of("a"), digits) == whole[: digits + 1]
    codes = {landmark_code(2**52 + k) for k in range(2000)}  # numbers in a row are not in a row
    assert len(codes) > 1850
    assert {code[0] for code in codes} == set("ABCDEFGHJKLMNPQRSTUVWXYZ")


def test_two_robots_that_begin_in_one_instant_name_two_landmarks() -> None:
    text = anonymous_text("box", 3, 0.0)
    assert text == "box-3@0"
    taken = [text]
    for number in (2, 3):
        taken.append(distinct_text(text, taken))
        assert taken[-1] == f"{text}#{number}"
    assert len(set(names(taken))) == 3
    assert all(name.startswith("box ") for name in names(taken))


def test_no_number_of_64_bits_is_said() -> None:
    identity = landmark_id_of("forgotten")
    assert landmark_label(identity, {}) == landmark_code(identity)
    assert landmark_label(586, {}) == "586"
    gone = MapChange((4, identity), ChangeKind.VANISHED, 0.0, 1.0, (np.nan, np.nan), 0.0, 0.9)
    assert gone.labels == ("4", landmark_code(identity))
    assert gone.named({}).names == gone.labels
    assert gone.named({identity: "cart"}).labels == ("4", "cart")
    assert replace(gone, landmark_ids=(4,)).named({identity: "cart"}).names == ()
    assert Landmarks.at([4, identity], np.zeros((2, 2))).labels == ["4", landmark_code(identity)]
    living, ids = nameless()
    living = replace(living, landmark_texts=("door",))  # as if its texts had been lost
    text, chair = next(iter(ids.items()))
    assert living.label(chair) == landmark_code(chair)
    assert living.landmark_called(landmark_code(chair)) == chair
    assert living.landmark_called(text) == -1


def test_a_landmark_is_found_by_all_that_it_was_called() -> None:
    living, ids = nameless()
    text, chair = next(iter(ids.items()))
    short = living.label(chair)
    assert short == f"chair {landmark_code(chair)}"
    for name in (text, short, str(chair)):
        assert living.landmark_called(name) == chair
    renamed = living.with_name(chair, "  the chair at  the door ")
    assert renamed.label(chair) == "the chair at the door"
    for name in (text, short, str(chair), "the chair at the door"):
        assert renamed.landmark_called(name) == chair
    number = int(living.members.landmark_id[0])
    both = renamed.with_name(number, "pillar")
    assert both.label(number) == "pillar"
    assert both.landmark_called("pillar") == both.landmark_called(str(number)) == number
    assert both.landmark_names == {**living.landmark_names, chair: "the chair at the door", number: "pillar"}
    for name in ("", short):  # its own name again
        assert_same(both.with_name(chair, name), living.with_name(number, "pillar"))
    assert_same(both.with_name(number, ""), renamed)
    assert_same(both.with_name(number, str(number)), renamed)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("door", "another landmark is called 'door'"),
        ("17", "taken for the number"),
        ("x" * (MOST + 1), "is not a name"),
        ("a\x1bb", "is not a name"),
        ("own", "another landmark"),
        ("short", "another landmark"),
        ("code", "another landmark"),
    ],
)
def test_what_is_no_name_is_refused(name: str, words: str) -> None:
    living, ids = nameless()
    chair, unknown, tag, door = ids.values()
    living = living.with_name(tag, "own")
    name = {"short": living.label(chair), "code": landmark_code(tag)}.get(name, name)
    with pytest.raises(InputError, match=words):
        living.with_name(unknown, name)
    with pytest.raises(KeyError):
        living.with_name(10**9, "new")
    assert living.with_name(door, "own door").label(door) == "own door"


def test_names_are_kept_in_the_file_and_reverted_with_it(tmp_path: Path) -> None:
    living, ids = nameless()
    chair = next(iter(ids.values()))
    short = living.label(chair)
    with open_store(tmp_path / "site.evermap", create=True) as store:
        store.commit(living, Provenance(), parent=0)
        number, called, told = rename_landmark(store, short, "throne", note="the tall one")
        assert (number, called, told) == (2, "throne", f"renamed landmark {short} to throne: the tall one")
        assert_same(store.load(), living.with_name(chair, "throne"))
        assert store.log()[-1].provenance.note == told
        assert rename_landmark(store, short, "throne") == (2, "throne", "it is called so already")
        assert diff(store, 1, 2).edits == ((chair, f"renamed from {short}"),)
        assert diff(store, 2, 1).edits == ((chair, "renamed from throne"),)
        assert why(store, "throne").headline.startswith("landmark throne is ")
        assert [(number, word) for number, _, word in why(store, "throne").edits] == [(2, f"renamed from {short}")]
        assert f"an operator renamed it from {short} in revision 2 (" in why(store, "throne").reasons[0]
        other = next(one for one in ids.values() if one != chair)
        assert why(store, living.label(other)).edits == ()
        with pytest.raises(InputError, match="no landmark nobody in revision 2"):
            rename_landmark(store, "nobody", "x")
        with pytest.raises(InputError, match="there is throne"):
            why(store, "thron")
        store.revert(1)
        assert store.load().label(chair) == short


def test_a_map_without_such_names_is_written_as_before() -> None:
    """An older evermap reads it."""
    name, chunks = pack(nameless()[0])
    assert b"renamed" not in chunks[name].raw
    name, chunks = pack(nameless()[0].with_name(landmark_id_of("door"), "gate"))
    assert b"renamed.name" in chunks[name].raw


def test_the_command_renames(tmp_path: Path) -> None:
    path = tmp_path / "site.evermap"
    living, ids = nameless()
    chair = next(iter(ids.values()))
    with open_store(path, create=True) as store:
        store.commit(living, Provenance(), parent=0)
    result = run("rename", path, living.label(chair), "throne")
    assert result.exit_code == 0
    assert "revision 2: renamed landmark" in result.stderr
    assert "nothing to do" in run("rename", path, "throne", "throne").stderr
    shown = json.loads(run("show", path, "--all", "--json").stdout)["landmarks"]
    assert {item["landmark"]: item["label"] for item in shown}[chair] == "throne"
    assert "throne renamed from chair" in run("diff", path, "1").stdout
    refused = run("rename", path, "throne", "door")
    assert refused.exit_code == 2
    for command in ("show", "log", "diff"):
        text = run(command, path, *(("0",) if command == "diff" else ())).stdout
        assert not any(str(one) in text or old in text for old, one in ids.items() if old != "door")


def test_exports_keep_the_identity_beside_the_name(tmp_path: Path) -> None:
    """A map that goes on from an exported one knows its landmarks in recordings, and calls them as before."""
    living, ids = nameless()
    chair, door = ids["chair-1@1704105328.074"], ids["door"]
    number = int(living.members.landmark_id[0])
    living = living.with_name(number, "pillar").with_name(door, "gate")
    landmarks = living.landmarks()
    for ending in ("csv", "parquet", "geojson"):
        path = tmp_path / f"map.{ending}"
        write_map(landmarks, path, format_called(None, path))
        again = read_prior_map(path)
        assert set(again.landmark_id.tolist()) == set(landmarks.landmark_id.tolist())
        begun = LivingMap.begun(again)
        here = [one for one in (number, door, chair) if one in landmarks.landmark_id]
        assert [begun.label(one) for one in here] == [living.label(one) for one in here]
        assert here
    path = tmp_path / "columns.csv"
    write_map(landmarks, path, format_called("columns", path))
    with path.open() as file:
        listed = {row["id"] for row in csv.DictReader(file)}
    assert "gate" not in listed  # read as an identity, it would be another
    assert {landmark_id_of(one) if not one.isdecimal() else int(one) for one in listed} == set(
        landmarks.landmark_id.tolist()
    )


def test_names_of_a_file_that_cannot_be_given_are_left_out() -> None:
    every = {1: "shelf", 2: "shelf", 3: "17", 4: "pillar", 5: " "}
    assert [*Renamed.of_file(every).items()] == [(4, "pillar")]


def test_orders_of_texts_make_no_difference() -> None:
    texts = [anonymous_text("chair", k, START_S + k) for k in range(4)]
    wanted = dict(zip(texts, names(texts), strict=True))
    for order in permutations(texts):
        assert dict(zip(order, names(order), strict=True)) == wanted
