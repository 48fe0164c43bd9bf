"""Which of a URDF's joints open the jaws, which links they move, and where these are at every opening.

The joints are settled before any mesh is read, and only what the gripper's own base carries is read: an arm isn't.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.model.errors import InputError
from gripmon.model.geometry import invert
from gripmon.model.records import Array
from gripmon.teach.cad.files import joined
from gripmon.teach.cad.urdf import Joint, Urdf

if TYPE_CHECKING:
    from trimesh import Trimesh

STEPS = 41
"""Number of joint positions that are evaluated: an arc of 57 mm over 0.8 rad is 2.8 um off a table of 41 rows."""

TURNS_RAD = 1e-3
"""Largest turn, over the joint's range, of a link that counts as not turning: 0.02 mm at 20 mm."""

PAIR_COSINE = 0.9998
"""Axes of two jaws' joints are along one line to 1.1 degrees."""

PAIR_SHARE = 0.02
"""Largest difference of the ranges of two joints that move as a pair, over the range."""


@dataclass(frozen=True, slots=True)
class Drive:
    """What moves the jaws: by joint the position at the start and at the end of their way, and the positions of joints
    that ``stand``.
    """

    ways: dict[str, tuple[float, float]]
    stand: dict[str, float]
    notes: tuple[str, ...] = ()

    def values(self, share: float) -> dict[str, float]:
        return {**self.stand, **{name: a + share * (b - a) for name, (a, b) in self.ways.items()}}


@dataclass(frozen=True, slots=True)
class LinkGroup:
    """Links that move together: ``body`` in the base's frame as drawn, at the middle of the jaws' way or where the
    joints stand, ``path_m`` (s, 3) its shifts along the way, ``turns_rad`` its largest turn on it.
    """

    links: tuple[str, ...]
    body: Trimesh
    path_m: Array
    turns_rad: float


@dataclass(frozen=True, slots=True)
class Linkage:
    """A URDF gripper in the frame of ``base``, the link that carries it: what the joints move, what stays (by link),
    and ``pivot``, place and direction (2, 3) of the first joint's axis if it turns.  ``moves``: whether the jaws move
    in the file.
    """

    joint: str
    base: str
    moving: list[LinkGroup]
    still: dict[str, Trimesh]
    pivot: Array | None
    moves: bool
    notes: list[str] = field(default_factory=list)


def read_urdf(path: Path, joint: str | None) -> Linkage:
    """Read a URDF's gripper.  ``joint``: NAME of the joint that opens the jaws, NAME=POSITION of one that stands there
    (m or rad), or two of these with a comma.  None: the only joint that moves by itself, or the only two if they are a
    pair: siblings that run the same way in opposite directions.

    :class:`InputError` for a file that isn't a URDF, or whose joints don't determine which opens the jaws; it comes
    before any mesh is read.
    """
    urdf = Urdf(path)
    drive = _driving(urdf, joint)
    first = next(j for j in urdf.joints if j.name == next(iter({**drive.ways, **drive.stand})))
    base = urdf.base_of(first.parent)
    # Where the jaws stand, a sweep of the joint tells what it moves.
    swept = drive if drive.ways else Drive({name: (v - 0.1, v + 0.1) for name, v in drive.stand.items()}, {})
    poses = [urdf.placed(base, swept.values(share)) for share in np.linspace(0.0, 1.0, STEPS).tolist()]
    drawn = poses[STEPS // 2]
    bodies = {name: urdf.body(name).apply_transform(drawn[name]) for name in drawn}
    groups: dict[bytes, list[str]] = {}
    still = {}
    for name in drawn:
        way = np.array([pose[name] for pose in poses])
        if np.abs(way - way[0]).max() < 1e-9:
            still[name] = bodies[name]
        else:  # links with the same motion are one body
            motion = np.round(way @ invert(drawn[name]), 9) + 0.0  # no negative zero
            groups.setdefault(motion.tobytes(), []).append(name)
    moving = []
    for names in groups.values():
        way = np.array([pose[names[0]] for pose in poses])
        turned = Rotation.from_matrix(way[:, :3, :3]) * Rotation.from_matrix(drawn[names[0]][:3, :3]).inv()
        body = joined([bodies[name] for name in names])
        moving.append(
            LinkGroup(tuple(names), body, way[:, :3, 3] - drawn[names[0]][:3, 3], float(turned.magnitude().max()))
        )
    left = [j.name for j in _free(urdf) if base in urdf.up(j.parent) and j.name not in swept.values(0.0)]
    if left:
        drive = replace(drive, notes=(*drive.notes, f"joints that nothing moves stand at 0: {', '.join(left)}"))
    if not moving:
        raise urdf.refuse(f"joint '{first.name}'", "moves no link that has a geometry; the joint of the jaws")
    pivot = None
    if first.kind != "prismatic":
        at = _carried(urdf, base, first)
        pivot = np.stack([at[:3, 3], at[:3, :3] @ first.axis])
    return Linkage(first.name, base, moving, still, pivot, bool(drive.ways), [*drive.notes, *urdf.notes])


def _carried(urdf: Urdf, base: str, joint: Joint) -> Array:
    """``base_T_joint`` (4, 4), all joints at zero."""
    return urdf.carried(base, joint.parent, {}) @ joint.origin


def _free(urdf: Urdf) -> list[Joint]:
    """The joints that move by themselves, and something with a geometry."""
    return [j for j in urdf.joints if j.kind != "fixed" and j.mimic is None and urdf.moved_by(j)]


def _driving(urdf: Urdf, text: str | None) -> Drive:
    """What opens the jaws: what ``--joint`` names, and with it its twin."""
    free = {j.name: j for j in _free(urdf)}
    if text is None:
        if not free:
            right = "prismatic or revolute joints, or its meshes by themselves"
            raise InputError(f"{urdf.path}: no joint moves; {right}")
        if len(free) == 1 or (len(free) == 2 and _twin(urdf, *free.values())):
            return _ways(urdf, list(free.values()), {}, ())
        leading = {j.mimic[0] for j in urdf.joints if j.mimic} & set(free)
        hint = f" ({', '.join(sorted(leading))} also leads others)" if leading else ""
        raise InputError(
            f"is missing: {urdf.path} has {len(free)} joints that move by themselves; one of {', '.join(free)}{hint}",
            "joint",
        )
    asked = _asked(text)
    strange = next((name for name in asked if name not in free), None)
    if strange is not None:
        follows = next((j.mimic[0] for j in urdf.joints if j.name == strange and j.mimic), None)
        raise InputError(
            f"{strange}: {urdf.path} has no such joint that drives others; "
            + (follows or f"one of {', '.join(free) or 'none'}"),
            "joint",
        )
    stand = {name: value for name, value in asked.items() if value is not None}
    chosen = [free[name] for name in asked if name not in stand]
    if len(chosen) > 2:
        raise InputError(
            f"{text}: opens the jaws by {len(chosen)} joints; one or two, the others as NAME=0.01", "joint"
        )
    first = free[next(iter(asked))]
    notes: tuple[str, ...] = ()
    others = [j for name, j in free.items() if name not in asked and _siblings(urdf, first, j)]
    if others:
        if len(others) == len(chosen) == 1 and _twin(urdf, chosen[0], others[0]):
            chosen.append(others[0])
            notes = (f"joint '{others[0].name}' opens the jaws together with '{first.name}'",)
        else:
            left = others[0]
            link = urdf.moved_by(left)[0]
            raise InputError(
                f"{text}: leaves out link '{link}', which joint '{left.name}' moves; {first.name},{left.name} if both "
                f"open the jaws, or {text},{left.name}=POSITION where it stands",
                "joint",
            )
    return _ways(urdf, chosen, stand, notes)


def _asked(text: str) -> dict[str, float | None]:
    """Joints by name, with their positions where they stand."""
    asked: dict[str, float | None] = {}
    for word in text.split(","):
        name, equals, position = word.strip().partition("=")
        try:
            asked[name] = float(position) if equals else None
        except ValueError:
            raise InputError(f"'{word}' isn't NAME=POSITION; a number, in metres or radians", "joint") from None
        if equals and not np.isfinite(float(position)):
            raise InputError(f"'{word}': is not a position; an ordinary number, in metres or radians", "joint")
    return asked


def _siblings(urdf: Urdf, one: Joint, other: Joint) -> bool:
    return urdf.base_of(one.parent) == urdf.base_of(other.parent)


def _against(urdf: Urdf, one: Joint, other: Joint) -> float:
    """Cosine between the axes of two joints on one base."""
    base = urdf.base_of(one.parent)
    a, b = (_carried(urdf, base, j)[:3, :3] @ j.axis for j in (one, other))
    return float(a @ b)


def _twin(urdf: Urdf, one: Joint, other: Joint) -> bool:
    """Whether two joints move a pair of jaws: on one base, along (or about) parallel axes, over ranges of one size."""
    alike = one.kind == other.kind and _siblings(urdf, one, other) and one.range > 0.0
    return (
        alike
        and abs(one.range - other.range) <= PAIR_SHARE * one.range
        and abs(_against(urdf, one, other)) >= PAIR_COSINE
    )


def _ways(urdf: Urdf, chosen: list[Joint], stand: dict[str, float], notes: tuple[str, ...]) -> Drive:
    """The way of each joint over its range; of two the second in the other direction in space."""
    for joint in chosen:
        if not joint.range > 0.0:
            raise urdf.refuse(
                f"joint '{joint.name}'",
                f"moves from {joint.limits[0]:g} to {joint.limits[1]:g}; limit lower < upper",
            )
    ways = {joint.name: joint.limits for joint in chosen}
    if len(chosen) == 2 and _siblings(urdf, *chosen) and _against(urdf, *chosen) > 0.0:
        ways[chosen[1].name] = (chosen[1].limits[1], chosen[1].limits[0])
    return Drive(ways, stand, notes)
