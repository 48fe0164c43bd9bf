"""Two fingers in space, from their motion with the jaws; and how fingers move that perspective places.

:mod:`~gripmon.teach.jaw_fit` says how far points are away, over the distance of the fingertips; here they get axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.errors import NoResultError
from gripmon.model.records import Array
from gripmon.teach.finger_depth import FLAT_SIGMA_RAD, PlacedOutlines
from gripmon.teach.image_motion import WORST_OUTLINE_PX, FingerMoved, JawMotion, Unfit, along_finger, contact
from gripmon.teach.image_outline import OpeningSeen
from gripmon.teach.jaw_fit import fit_motion
from gripmon.teach.vanishing import Outline

MOST_TOGETHER = 0.55
"""Largest mean motion of the fingers over their relative motion: with one fixed jaw it is 0.5, known to a tenth."""


@dataclass(frozen=True)
class Moved:
    """``by_opening``: each finger's motion; ``measured``: the joint fit of two fingers, if it tells the size; ``why``:
    what stands in the way of that.
    """

    by_opening: Mapping[float, Sequence[FingerMoved]]
    measured: JawMotion | None
    why: str = ""

    def check_opened(self, counts: Sequence[int]) -> None:
        """Raise :class:`~gripmon.model.errors.NoResultError` if sets of images (``counts`` images each), each with
        other static parts, don't show one gripper at several openings, whose fingers would move against each other.
        """
        apart = len(self.by_opening) + 1 == len(counts)
        for fingers in self.by_opening.values():
            shifts = np.array([finger.shift for finger in fingers])
            together = float(np.linalg.norm(0.5 * (shifts.min(axis=0) + shifts.max(axis=0))))
            apart &= together <= MOST_TOGETHER * float(np.linalg.norm(np.ptp(shifts, axis=0)))
        if not apart:
            raise NoResultError(
                f"the images fall into sets of {' and '.join(map(str, counts))}, in which different parts stay the "
                "same, but they don't show fingers that move against each other: the camera moved, or it isn't one "
                "gripper; a camera fixed to the gripper, only the jaws moving"
            )


def move(
    camera: Camera,
    fingers: Sequence[Outline],
    seen: OpeningSeen,
    around: Mapping[float, OpeningSeen],
    placed: PlacedOutlines,
    *,
    pose: tuple[Array, Array] | None = None,
    travel: Mapping[float, tuple[float, float]] | None = None,
    notes: list[str],
) -> tuple[PlacedOutlines, Moved]:
    """The fingers' motion from the ``seen`` opening to those ``around``; fingers that perspective couldn't place are
    placed by it.  ``pose``: rotation (3, 3) and TCP (3,) at unit depth, as a calibration has them, and ``travel`` by
    opening, with its standard deviation, over that depth; adds to ``notes`` what isn't used.
    """
    around = dict(around)
    while around:
        try:
            return _move(camera, fingers, seen, around, placed, pose, travel)
        except Unfit as why:
            if why.opening is None:
                return placed, Moved({}, None, str(why))
            around.pop(why.opening)
            notes.append(f"opening {why.opening:g} isn't used: {why}")
    return placed, Moved({}, None)


def _move(
    camera: Camera,
    fingers: Sequence[Outline],
    seen: OpeningSeen,
    around: Mapping[float, OpeningSeen],
    placed: PlacedOutlines,
    pose: tuple[Array, Array] | None,
    travel: Mapping[float, tuple[float, float]] | None,
) -> tuple[PlacedOutlines, Moved]:
    why = ""
    try:
        direction = None if pose is None else pose[0][:, 0]
        shown = None if placed.flat else placed
        found = fit_motion(camera, fingers, seen, around, placed=shown, travel=travel, direction=direction)
        if found.turned:
            # Which of its points' distance the jaws report isn't known, and a gripper file's fingers don't turn.
            return placed, Moved({}, None, found.turned)
        if found.by_motion:
            placed, found = place_by_motion(fingers, found, pose, absolute=travel is not None)
        else:
            placed, found = _as_they_move(camera, fingers, placed, found, keep=pose is not None)
        return placed, Moved(found.moved, found)
    except Unfit as unfit:
        if unfit.opening is not None:
            raise
        why = str(unfit)
    found = fit_motion(camera, fingers, seen, around, placed=placed, loose=True)
    if found.turned:
        return placed, Moved({}, None, found.turned)
    if placed.flat or len(fingers) == 1:
        return placed, Moved(found.moved, None, why)
    return placed, Moved(found.moved, found)


def _as_they_move(
    camera: Camera, fingers: Sequence[Outline], placed: PlacedOutlines, found: JawMotion, *, keep: bool
) -> tuple[PlacedOutlines, JawMotion]:
    """The fingers where perspective places them, or, where their outlines would then lie beside the images of another
    opening, at the depths by which their motion is explained: that both tips end equally far out, and a round one in
    the plane of its sides, is assumed.  Unless a calibration's axes are to be kept (``keep``), the TCP moves with the
    tips, and x is as the jaws move, square to the fingers: which of the tips' vertices face each other tells less.
    """
    points = _in_space(fingers, found)
    points = [np.where(np.isfinite(old), new, np.nan) for old, new in zip(placed.points, points, strict=True)]
    tcp = placed.tcp
    if _beside_px(camera, placed, points, found) >= WORST_OUTLINE_PX:
        tips, _ = contact(fingers, found.direction[:2] / float(np.linalg.norm(found.direction[:2])))
        moved = [(new - old)[tip] for new, old, tip in zip(points, placed.points, tips, strict=True)]
        moved = [own[np.isfinite(own).all(axis=1)] for own in moved]
        tcp = tcp if keep else tcp + np.mean([own.mean(axis=0) for own in moved if len(own)], axis=0)
        # Of a plane through each finger's points, as they are now.
        tilt_sigma_rad = max(placed.tilt_sigma_rad, float(found.slope_sigma.max()))
        placed = replace(placed, points=tuple(points), tilt_sigma_rad=tilt_sigma_rad)
    if keep:
        return placed, found
    along = placed.rotation[:, 2]
    across = found.direction - along * float(along @ found.direction)
    across *= np.sign(float(across @ placed.rotation[:, 0])) / np.linalg.norm(across)
    rotation = np.column_stack([across, np.cross(along, across), along])
    about_along = float(np.sqrt(rotation[:, 1] @ found.direction_covariance @ rotation[:, 1]))
    sigma = np.hypot(placed.sigma_rad, about_along * np.abs(along))
    depth = float(tcp[2])
    placed = replace(placed, points=tuple(own / depth for own in placed.points), tcp=tcp / depth)
    return replace(placed, rotation=rotation, sigma_rad=sigma), found.over(depth)


def _in_space(fingers: Sequence[Outline], found: JawMotion) -> list[Array]:
    """Vertices (v, 3) of each finger at the depths of a motion."""
    return [np.column_stack([f.xy, np.ones(len(f.xy))]) / q[:, None] for f, q in zip(fingers, found.q, strict=True)]


def _beside_px(camera: Camera, placed: PlacedOutlines, points: Sequence[Array], found: JawMotion) -> float:
    """How far the outlines that perspective places, moved to the other openings, lie beside those at ``points`` (v, 3)
    of each finger, which the motion explains: root mean square across the edges.
    """
    off = []
    for motion in found.moved.values():
        for old, new, kept, own in zip(placed.points, points, placed.kept, motion, strict=True):
            ends = np.reshape(kept, (-1, 2)).astype(int)
            before, after = (p[ends] + own.shift for p in (old, new))  # (e, 2, 3)
            before, after = (p[..., :2] / p[..., 2:] for p in (before, after))
            way = after[:, 1] - after[:, 0]
            normal = np.column_stack([-way[:, 1], way[:, 0]]) / np.linalg.norm(way, axis=1)[:, None]
            off.append(np.einsum("ekc,ec->ek", before - after, normal).ravel())
    return camera.fx_px * float(np.sqrt(np.square(np.concatenate(off)).mean()))


def place_by_motion(
    fingers: Sequence[Outline], found: JawMotion, pose: tuple[Array, Array] | None, *, absolute: bool
) -> tuple[PlacedOutlines, JawMotion]:
    """The fingers in space, the TCP at unit depth, x as the jaws move, z along the fingers; or with ``pose``, the
    rotation (3, 3) and the TCP (3,) at unit depth, as a calibration has them (``absolute``: the motion is over that
    depth already); and the motion over that depth.  Raises
    :class:`Unfit` where the motion leaves their tilt unknown.
    """
    if found.slope_sigma.max() > FLAT_SIGMA_RAD:
        raise Unfit("it leaves the fingers' tilt unknown")
    points = _in_space(fingers, found)
    if pose is not None:
        rotation, tcp = pose
        # Unless the travel tells, the outermost point lies as far out as the TCP.
        reach = max(float((p @ rotation[:, 2]).max()) for p in points)
        depth = 1.0 if absolute else reach / float(rotation[:, 2] @ tcp)
        points = [p / depth for p in points]
        return PlacedOutlines(tuple(points), found.kept, *pose, False, np.zeros(3), by_motion=True), found.over(depth)
    across = found.direction
    ways, spreads = zip(*[along_finger(f, p) for f, p in zip(fingers, points, strict=True)], strict=True)
    along = np.sum(ways, axis=0)
    along = along - across * float(along @ across)
    along /= np.linalg.norm(along)
    rotation = np.column_stack([across, np.cross(along, across), along])
    tips, corners = contact(fingers, across[:2] / float(np.linalg.norm(across[:2])))
    tcp = np.mean([p[tip].mean(axis=0) for p, tip in zip(points, tips, strict=True)], axis=0)
    if not corners:
        # A round tip's innermost part lies behind its end.
        tcp = tcp + along * (max(float((p @ along).max()) for p in points) - float(along @ tcp))
    depth = float(tcp[2])
    points, tcp = [p / depth for p in points], tcp / depth
    sigma = np.array([found.slope_sigma[1], found.slope_sigma[0], 0.0])
    sigma = np.hypot(sigma, 0.5 * float(np.mean(spreads)))
    made = tuple(points), found.kept, rotation, tcp, False, sigma
    found = found.over(depth)
    # How a taper's sides spread about z is no error of their depths: of the tilt the slopes alone.
    tilt_sigma_rad = float(found.slope_sigma.max())
    placed = PlacedOutlines(*made, by_motion=True, tcp_covariance=found.tcp_covariance, tilt_sigma_rad=tilt_sigma_rad)
    return placed, found
