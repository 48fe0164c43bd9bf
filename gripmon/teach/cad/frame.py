"""The gripper frame of a CAD model: x across the jaws, z out of the gripper, origin at the TCP."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gripmon.model.errors import InputError
from gripmon.model.geometry import make_transform
from gripmon.model.records import Array
from gripmon.teach.cad.surface import Surface

TIP_M = 1e-4
"""Corners up to this far behind the foremost one are at the tip, too: a gripper model's tolerance for equal z."""

AXES = {sign + name: scale * np.eye(3)[k] for k, name in enumerate("xyz") for sign, scale in (("+", 1.0), ("-", -1.0))}
SNAP_COSINE = 0.985
"""Cosine of about 10 degrees: jaws that move this close to an axis of the CAD frame move along it; fingers differ."""


def axes_of(fingers: Sequence[Surface], approach: str) -> Array:
    """Rotation (3, 3) from the CAD frame to the gripper's: rows x, y, z.  ``approach``: a key of :data:`AXES`."""
    z = AXES[approach]
    across = np.eye(3)[0 if abs(z[0]) < 0.5 else 1]
    if len(fingers) > 1:
        first, last = (0.5 * (f.points_m.min(axis=0) + f.points_m.max(axis=0)) for f in (fingers[0], fingers[-1]))
        across = (last - first) - ((last - first) @ z) * z
        if not np.linalg.norm(across) > 1e-3:
            raise InputError(
                f"{approach}: the fingers stand behind each other along it; the axis out of the gripper", "approach"
            )
        across /= np.linalg.norm(across)
        nearest = int(np.abs(across).argmax())
        if abs(across[nearest]) > SNAP_COSINE:
            across = np.eye(3)[nearest]
        elif across[nearest] < 0.0:
            across = -across
    return np.stack([across, np.cross(z, across), z])


def approach_of(fingers: Sequence[Surface], around: Sequence[Surface]) -> str:
    """The axis along which the fingers reach farthest from the body that holds them, or from the CAD frame's origin,
    which in a URDF is at the flange.
    """
    middles = [0.5 * (f.points_m.min(axis=0) + f.points_m.max(axis=0)) for f in fingers]
    across = int(np.abs(middles[0] - middles[-1]).argmax()) if len(fingers) > 1 else -1
    held = np.concatenate([s.points_m for s in around]) if around else np.zeros((1, 3))
    reach = np.mean(middles, axis=0) - 0.5 * (held.min(axis=0) + held.max(axis=0))
    reach[across] = 0.0 if across >= 0 else reach[across]
    k = int(np.abs(reach).argmax())
    return ("+" if reach[k] > 0.0 else "-") + "xyz"[k]


def inner_tip(surface: Surface, grip_R_cad: Array, towards: float) -> tuple[Array, int]:
    """The mean (3,) of a fingertip's two innermost corners, gripper axes, and the number of corners used; ``towards``
    is the sign of x towards the other finger, 0 for a single finger: then the middle of all corners at its tip.

    With fewer than two corners at the tip: of its foremost millimetre the innermost x (of a single finger the middle),
    the middle y and the foremost z.
    """
    sharp = np.unique(surface.edges[surface.sharp])
    places = surface.points_m @ grip_R_cad.T
    corners = places[_corners(surface, sharp)]
    foremost = float(places[:, 2].max())
    at_tip = corners[corners[:, 2] > foremost - TIP_M] if len(corners) else corners
    if len(at_tip) >= 2:
        if towards == 0.0:
            return 0.5 * (at_tip.min(axis=0) + at_tip.max(axis=0)), len(at_tip)
        inner = at_tip[np.argsort(-towards * np.round(at_tip[:, 0], 6), kind="stable")[:2]]
        return inner.mean(axis=0), 2
    near = places[places[:, 2] > foremost - 1e-3]
    low, high = near.min(axis=0), near.max(axis=0)
    x = 0.5 * (low[0] + high[0]) if towards == 0.0 else (high[0] if towards > 0.0 else low[0])
    return np.array([x, 0.5 * (low[1] + high[1]), foremost]), 0


def _corners(surface: Surface, sharp: NDArray[np.intp]) -> NDArray[np.intp]:
    """Points in which three sharp edges meet, or two at an angle."""
    edges = surface.edges[surface.sharp]
    count = np.bincount(edges.ravel(), minlength=len(surface.points_m))
    found = [p for p in sharp.tolist() if count[p] >= 3]
    two = set(np.flatnonzero(count == 2).tolist())
    if len(two) > 20_000:  # a rough scan: its borders aren't corners
        return np.array(found, dtype=np.intp)
    ends: dict[int, list[int]] = {}
    for a, b in edges.tolist():
        for p, other in ((a, b), (b, a)):
            if p in two:
                ends.setdefault(p, []).append(other)
    for p, (a, b) in ends.items():
        u, v = surface.points_m[a] - surface.points_m[p], surface.points_m[b] - surface.points_m[p]
        if u @ v > -0.866 * np.linalg.norm(u) * np.linalg.norm(v):  # a turn of 30 degrees
            found.append(p)
    return np.array(sorted(found), dtype=np.intp)


def frame_of(fingers: Sequence[Surface], grip_R_cad: Array) -> tuple[Array, list[int]]:
    """``grip_T_cad`` (4, 4) with the TCP between the fingertips, and the number of corners that gave each tip."""
    if len(fingers) == 1:
        tips = [inner_tip(fingers[0], grip_R_cad, 0.0)]
    else:
        x = [float((0.5 * (f.points_m.min(axis=0) + f.points_m.max(axis=0)) @ grip_R_cad.T)[0]) for f in fingers]
        middle = 0.5 * (min(x) + max(x))
        tips = [inner_tip(f, grip_R_cad, 1.0 if own < middle else -1.0) for f, own in zip(fingers, x, strict=True)]
    tcp = np.mean([place for place, _ in tips], axis=0)
    return make_transform(grip_R_cad, -tcp), [count for _, count in tips]
