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

CLEAR = 0.75
"""Of two lengths that decide on an axis, the smaller over the larger: a larger share decides nothing."""

WIDER = 1.5
"""Cross-section of a finger's front quarter over that of its rear one, above which its tip may be the other end."""

ALIKE = 0.05
"""Largest difference of the sizes of two fingers that count as one shape, or its mirror image."""


def axes_of(fingers: Sequence[Surface], approach: str | None, along: Array | None, pivot: Array | None) -> Array:
    """Rotation (3, 3) from the CAD frame to the gripper's: rows x, y, z; x from the first finger to the last.

    ``approach``: z, or z and x with a comma, keys of :data:`AXES`; None: +z.  ``along`` (3,): the direction in which
    the jaws move; ``pivot`` (2, 3): place and axis about which one turns.  Of meshes alone x is from middle to middle,
    which holds for two fingers of one shape; for others it has to be an axis of the CAD frame.
    """
    first, *second = (approach or "+z").split(",")
    z = AXES[first]
    if second:
        x = AXES[second[0]]
        if along is not None and abs(along @ x) < SNAP_COSINE:
            raise InputError(f"{approach}: the jaws don't move along {second[0]}; the axis across them", "approach")
        if len(fingers) > 1 and (_middle(fingers[-1].points_m) - _middle(fingers[0].points_m)) @ x <= 0.0:
            raise InputError(f"{approach}: points from the right finger to the left one; the other way", "approach")
        return _rows(x, z)
    if len(fingers) < 2 and along is None and pivot is None:
        across = np.eye(3)[0 if abs(z[0]) < 0.5 else 1]
        if approach is None:
            _check_out(fingers, _rows(across, z))
        return _rows(across, z)
    apart = _middle(fingers[-1].points_m) - _middle(fingers[0].points_m)
    known = along if along is not None else None if pivot is None else np.cross(pivot[1], z)
    across = apart if known is None else known
    across = across - (across @ z) * z
    if not np.linalg.norm(across) > (1e-3 if known is None else 1e-3 * np.linalg.norm(known)):
        wrong = "the fingers stand behind each other along it" if known is None else "the jaws move along it"
        raise InputError(f"{first}: {wrong}; the axis out of the gripper, as --approach=-y", "approach")
    across /= np.linalg.norm(across)
    nearest = int(np.abs(across).argmax())
    if abs(across[nearest]) > SNAP_COSINE:
        across = np.sign(across[nearest]) * np.eye(3)[nearest]
    elif known is None and not _alike(fingers[0], fingers[-1]):
        names = ", ".join(f"{v:.2f}" for v in across)
        raise InputError(
            f"is missing: the fingers differ in shape, and from middle to middle is ({names}), no axis of the CAD "
            "frame; the axis out of the gripper and the one from the first finger to the last, as --approach=+z,+x",
            "approach",
        )
    if known is not None and across @ apart < 0.0:
        across = -across
    axes = _rows(across, z)
    if approach is None and known is None:
        _check_out(fingers, axes)
    return axes


def _rows(x: Array, z: Array) -> Array:
    return np.stack([x, np.cross(z, x), z])


def _middle(points_m: Array) -> Array:
    return np.asarray(0.5 * (points_m.min(axis=0) + points_m.max(axis=0)))


def _check_out(fingers: Sequence[Surface], axes: Array) -> None:
    """Nobody said that z points out of the gripper: fingers are longest along it and don't widen towards their tips."""
    for finger in fingers:
        places = finger.points_m @ axes.T
        low, size = places.min(axis=0), np.ptp(places, axis=0)
        share = (places[:, 2] - low[2]) / max(float(size[2]), 1e-9)
        rear, front = (float(np.prod(np.ptp(places[own], axis=0)[:2])) for own in (share <= 0.25, share >= 0.75))
        others = size[1] if len(fingers) > 1 else max(size[0], size[1])
        wrong = "which isn't longest along z" if size[2] < CLEAR * others else ""
        wrong = wrong or ("which is wider at its upper end in z" if front > WIDER * rear else "")
        if wrong:
            extent = " x ".join(f"{1e3 * v:.1f}" for v in np.ptp(finger.points_m, axis=0))
            raise InputError(
                f"is missing: a finger of {extent} mm (x, y, z), {wrong}; the axis of the CAD frame out of the "
                "gripper, as --approach=+y",
                "approach",
            )


def _alike(one: Surface, other: Surface) -> bool:
    """Whether two surfaces have the same shape, or mirrored ones: by the moments of their areas."""
    if not (len(one.triangles) and len(other.triangles)):
        return False
    found = []
    for surface in (one, other):
        corners = surface.points_m[surface.triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        places = corners.mean(axis=1)
        beside = places - area @ places / area.sum()
        spread = np.einsum("t,ti,tj->ij", area / area.sum(), beside, beside)
        found.append([np.sqrt(area.sum()), *np.sqrt(np.maximum(np.linalg.eigvalsh(spread), 0.0))])
    a, b = np.array(found)
    return bool((np.abs(a - b) <= ALIKE * a.max()).all())


def approach_of(moving: Sequence[Array], still: Sequence[Array], along: Array | None, pivot: Array | None) -> str:
    """The axis along which the fingers that move reach farthest from what stands (points (n, 3) of each), or from the
    CAD frame's origin, which in a URDF is at the flange.  ``along`` (3,): the jaws' direction, if it is known.

    Of a single jaw that turns (``pivot``, place and direction (2, 3)) it is the axis along which what stands, the other
    finger, reaches farthest beyond the pivot.
    """
    held = np.concatenate(still) if still else np.zeros((1, 3))
    reach = np.mean([_middle(f) for f in moving], axis=0) - 0.5 * (held.min(axis=0) + held.max(axis=0))
    if pivot is not None and len(moving) == 1 and still:
        size = np.concatenate([held.max(axis=0) - pivot[0], pivot[0] - held.min(axis=0)])
        reach = _middle(moving[0]) - pivot[0]
    else:
        size = np.concatenate([reach, -reach])
    excluded = along if pivot is None else pivot[1]
    if excluded is not None:
        k = int(np.abs(excluded).argmax())
        size[[k, k + 3]] = 0.0
    first, second = np.argsort(-size)[:2].tolist()
    names = [sign + axis for sign in "+-" for axis in "xyz"]
    if size[second] > CLEAR * size[first] or not min(size[first], np.concatenate([reach, -reach])[first]) > 1e-3:
        raise InputError(
            "is missing: how far the fingers reach from what holds them tells none; the axis out of the gripper, as "
            f"--approach={names[first]} or --approach={names[second]}",
            "approach",
        )
    return names[first]


def check_level(surfaces: Sequence[Surface], z: Array) -> None:
    """Fingers of a gripper end near each other: otherwise z isn't the axis out of it."""
    lengths = [float(np.ptp(s.points_m @ z)) for s in surfaces]
    ends = [float((s.points_m @ z).max()) for s in surfaces]
    if max(ends) - min(ends) > 0.5 * min(lengths):
        raise InputError(
            f"the fingers end {1e3 * (max(ends) - min(ends)):.0f} mm from each other along it; the axis out of the "
            "gripper, and if it is this one the one across the jaws, too, as --approach=+z,+x",
            "approach",
        )


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
        x = [float((_middle(f.points_m) @ grip_R_cad.T)[0]) for f in fingers]
        middle = 0.5 * (min(x) + max(x))
        tips = [inner_tip(f, grip_R_cad, 1.0 if own < middle else -1.0) for f, own in zip(fingers, x, strict=True)]
    tcp = np.mean([place for place, _ in tips], axis=0)
    return make_transform(grip_R_cad, -tcp), [count for _, count in tips]
