"""Landmarks are laid over landmarks in one room: who else fits a motion to points is on this list, with the reason."""

from __future__ import annotations

import ast
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[2] / "src" / "evermap"

OWN_FITS = {
    # fits to pairs that are known: nothing is chosen, nothing accepted
    "estimate/measurements/gnss.py": "fixes and poses of the same instants",
    "explain/shape.py": "how much of a map is in its place in any frame: nothing is placed by it",
    "maps/bodies.py": "how a body moved whose members are known",
    "maps/diff.py": "the same, between two revisions",
    "maps/sessions/gaussian.py": "the ratio of the sizes of two maps",
    "maps/sessions/overlay.py": "the motion by the landmarks that the joint search let stand",
    "maps/sessions/placing.py": "stretches of a bent session, reweighted",
    "maps/sessions/planar.py": "the motion by the places that a session was solved with",
    "metrics/trajectory.py": "the estimate to the truth",
    "slam/votes.py": "what one sensor sees over what another sees of the same names",
    # identities are unknown: candidates by constellations
    "maps/sessions/box_search.py": "boxes",
    "maps/sessions/nameless.py": "landmarks without identities in a map",
    "slam/association/constellation.py": "parts of one map",
    "slam/association/place_index.py": "a large map",
    "slam/association/wrong_associations.py": "a stretch with wrong identities",
    # one pose of a frame, predicted, among places in the making
    "slam/space/solve.py": "frame after frame",
    "slam/space/starts.py": "the frame that is known best next, refined by covariances",
}
"""Modules outside `align` and `geometry` that call `rigid`; when one goes, it leaves the list."""
ALIGNERS = ("accept_alignment", "find_consensus", "rank_motions")


def calls(path: Path, names: tuple[str, ...]) -> set[str]:
    """Which of some functions a module calls."""
    text = path.read_text(encoding="utf-8")
    if not any(name in text for name in names):
        return set()  # most modules, which need not be parsed
    tree = ast.parse(text)
    called = (node.func for node in ast.walk(tree) if isinstance(node, ast.Call))
    return {func.id for func in called if isinstance(func, ast.Name)} & set(names)


def modules() -> dict[str, Path]:
    """Modules by their path, without those of the rooms that hold the functions."""
    found = {path.relative_to(SOURCE).as_posix(): path for path in SOURCE.rglob("*.py")}
    return {name: path for name, path in found.items() if not name.startswith(("align/", "geometry/"))}


def test_who_fits_motions_outside_align_is_listed() -> None:
    assert sorted(name for name, path in modules().items() if calls(path, ("rigid",))) == sorted(OWN_FITS)


def test_known_identities_are_laid_over_a_map_by_align_alone() -> None:
    users = {name: calls(path, ALIGNERS) for name, path in modules().items()}
    accepted = {name for name, called in users.items() if "accept_alignment" in called}
    proposed = {name for name, called in users.items() if called - {"accept_alignment"}}
    assert accepted == {
        "maps/sessions/boxes.py", "slam/batch.py", "slam/known_places.py", "slam/space/localize.py",
        "slam/together.py",
    }  # fmt: skip
    # starts of a search that is judged by all measurements
    assert proposed == {
        "maps/sessions/overlay.py", "maps/sessions/placing.py", "slam/batch.py", "slam/changes/joint.py",
        "slam/space/map_consensus.py", "slam/space/moved_groups.py", "slam/space/solve.py",
    }  # fmt: skip
