"""Rotations after which an object looks the same: any about one of its axes, finitely many, or all.

Stated by generators, as text: `axis:z` (any turn about the object's own z axis), `180:z` (that part of a full turn, in
degrees, and its multiples), `any` (a ball). Several are closed into the group that they generate. Beside an axis, only
which end is up is left to say, so that a group has an axis and turns, either of which may be trivial.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from evermap.geometry import se3
from evermap.types import BoolArray, FloatArray, IntArray

MOST_TURNS = 360
"""Elements of a group that is taken to be finite."""
SAME, ROUNDED = 1e-9, 1e-3
"""Cosines that are equal; parts of a full turn that are a whole number, of degrees with few digits."""
AXES = "xyz"
HINT = "axis:z (any rotation about z), 180:z (half a turn about z, or another integer fraction of 360 degrees), or any"


@dataclass(frozen=True, slots=True)
class Symmetry:
    """A group of rotations in the object's own frame.

    Attributes:
        axis: 0, 1 or 2, about which any turn belongs to it; -1 without.
        turns: (G, 4) quaternions, the identity first; beside an axis one for each of its ends that may be up.
        free: True if all turns belong to it, so that there is no orientation.
    """

    axis: int = -1
    turns: FloatArray = field(default_factory=lambda: se3.NO_TURN[None])
    free: bool = False

    @classmethod
    def generate_group(cls, generators: str | Iterable[str]) -> Symmetry:
        """Return the group that texts generate.

        Raises:
            ValueError: another text, an angle of which no whole number makes a full turn, or turns that together
                generate more than they say.
        """
        texts = (generators,) if isinstance(generators, str) else tuple(generators)
        axes, turns = set[int](), list[FloatArray]()
        for text in texts:
            if text == "any":
                return cls(free=True)
            kind, _, name = str(text).partition(":")
            if len(name) != 1 or name not in AXES:
                raise ValueError(f"unknown symmetry '{text}'")
            if kind == "axis":
                axes.add(AXES.index(name))
            else:
                turns.append(_part(text, kind, AXES.index(name)))
        if len(axes) > 1:
            raise ValueError("two axes generate all rotations; that is 'any'")
        axis = axes.pop() if axes else -1
        return cls(axis, _close_group(turns, axis))

    def twisted(self, pose: FloatArray, reference: FloatArray) -> FloatArray:
        """Return poses (..., 7), turned about the axis to be as near as possible to `reference` (..., 7)."""
        if self.axis < 0:
            return np.broadcast_to(pose, np.broadcast_shapes(pose.shape, reference.shape))
        off = se3.between(pose, reference)
        twist = se3.identity(*off.shape[:-1])
        twist[..., 3 + self.axis], twist[..., 6] = off[..., 3 + self.axis], off[..., 6]
        undefined = np.hypot(twist[..., 3 + self.axis], twist[..., 6]) < SAME  # upside down: all are as far
        twist[undefined] = se3.identity()
        return se3.compose(pose, twist)

    def nearest(self, pose: FloatArray, reference: FloatArray) -> FloatArray:
        """Return poses (..., 7) that look like `pose`, with the orientation nearest to `reference` (..., 7)."""
        if self.free:
            found = np.array(np.broadcast_to(pose, np.broadcast_shapes(pose.shape, reference.shape)))
            found[..., 3:] = reference[..., 3:]
            return found
        best = self.twisted(pose, reference)
        angle = se3.angle_between(best, reference)
        for turn in se3.turn(self.turns[1:]):
            other = self.twisted(se3.compose(pose, turn), reference)
            off = se3.angle_between(other, reference)
            best = np.where((off < angle - SAME)[..., None], other, best)
            angle = np.minimum(off, angle)
        return np.asarray(best)

    def angle_between(self, pose: FloatArray, other: FloatArray) -> FloatArray:
        """Return the least angles [rad] between what looks like `pose` and `other` (..., 7), broadcast."""
        if self.free:
            return np.zeros(np.broadcast_shapes(pose.shape, other.shape)[:-1])
        if self.axis < 0 and len(self.turns) == 1:
            return se3.angle_between(pose, other)
        off = se3.between(pose, other)[..., 3:]
        cosine = np.abs(off @ self.turns.T)
        if self.axis >= 0:
            about = se3.turn(np.eye(4)[self.axis][None])
            cosine = np.hypot(cosine, off @ se3.compose(se3.turn(self.turns), about)[:, 3:].T)
        return np.asarray(2.0 * np.arccos(np.clip(cosine.max(axis=-1), 0.0, 1.0)))


@dataclass(frozen=True, slots=True)
class Symmetries:
    """Symmetries of P objects.

    Attributes:
        kinds: the distinct ones, the first without any symmetry.
        of: (P,) row of these.
    """

    kinds: tuple[Symmetry, ...]
    of: IntArray

    @classmethod
    def none(cls, count: int) -> Symmetries:
        """Return symmetries of objects without any."""
        return cls((Symmetry(),), np.zeros(count, dtype=np.int64))

    @classmethod
    def of_classes(cls, stated: Mapping[str, tuple[str, ...]], names: Iterable[str]) -> Symmetries:
        """Return the symmetries of objects (P,) by the names of their classes.

        Raises:
            ValueError: as of `Symmetry.generate_group`.
        """
        row = {name: 1 + k for k, name in enumerate(stated)}
        kinds = (Symmetry(), *(Symmetry.generate_group(texts) for texts in stated.values()))
        return cls(kinds, np.array([row.get(name, 0) for name in names], dtype=np.int64))

    def __getitem__(self, rows: IntArray | BoolArray) -> Symmetries:
        """Return those of some objects (K,)."""
        return Symmetries(self.kinds, self.of[rows])

    @property
    def axis(self) -> IntArray:
        """Return (P,) the axes about which nothing is seen of a turn; -1 without."""
        return np.array([kind.axis for kind in self.kinds])[self.of]

    @property
    def unseen(self) -> FloatArray:
        """Return (P, 3) 1 for the axes about which nothing is seen of a turn, else 0."""
        return np.vstack([np.eye(3), np.zeros(3)])[self.axis]

    def nearest(self, pose: FloatArray, reference: FloatArray) -> FloatArray:
        """Return poses (P, 7) that look like `pose` (P, 7), with the orientations nearest to `reference` (P, 7)."""
        found = pose.copy()
        for row in np.unique(self.of[self.of > 0]).tolist():
            some = self.of == row
            found[some] = self.kinds[row].nearest(pose[some], reference[some])
        return found

    def twisted(self, pose: FloatArray, reference: FloatArray) -> FloatArray:
        """Return poses (..., P, 7), turned about their axes to be as near as possible to `reference` (..., P, 7)."""
        found = np.array(np.broadcast_to(pose, np.broadcast_shapes(pose.shape, reference.shape)))
        for row in np.unique(self.of).tolist():
            if self.kinds[row].axis >= 0:
                some = self.of == row
                found[..., some, :] = self.kinds[row].twisted(found[..., some, :], reference[..., some, :])
        return found

    def angle_between(self, pose: FloatArray, other: FloatArray) -> FloatArray:
        """Return the least angles (..., P) between what looks like `pose` (..., P, 7) and `other` (..., P, 7)."""
        found = se3.angle_between(pose, other)
        for row in np.unique(self.of[self.of > 0]).tolist():
            some = self.of == row
            both = (np.broadcast_to(one, (*found.shape, 7))[..., some, :] for one in (pose, other))
            found[..., some] = self.kinds[row].angle_between(*both)
        return found


def _part(text: str, degrees: str, axis: int) -> FloatArray:
    """The quaternion of a turn of so many degrees, a whole part of a full one."""
    try:
        angle = float(degrees)
    except ValueError:
        raise ValueError(f"unknown symmetry '{text}'") from None
    parts = 360.0 / angle if 1.0 <= angle <= 180.0 else 0.5
    if abs(parts - round(parts)) > ROUNDED:
        raise ValueError(f"'{text}': {degrees} degrees are not an integer fraction of a full turn")
    return se3.exp(np.eye(6)[3 + axis] * 2.0 * np.pi / round(parts))[3:]


def _close_group(generators: list[FloatArray], axis: int) -> FloatArray:
    """(G, 4) all products; of those that differ by a turn about the axis one."""
    found, new = se3.identity(1), se3.identity(1)
    if axis >= 0:
        up = [abs(se3.rotation_of(se3.turn(one))[axis, axis]) for one in generators]
        if any(cosine < 1.0 - SAME for cosine in up):
            raise ValueError("a rotated axis generates all rotations; that is 'any'")
    group = Symmetry(axis)
    while len(new):
        products = [se3.compose(one, se3.turn(turn)) for one in new for turn in generators]
        new = np.zeros((0, 7))
        for one in products:
            if group.angle_between(found, one).min() > 1e-6:
                found, new = np.vstack([found, one]), np.vstack([new, one])
        if len(found) > MOST_TURNS:
            raise ValueError("the rotations do not generate a finite group")
    return found[:, 3:]
