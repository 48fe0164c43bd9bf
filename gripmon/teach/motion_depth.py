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
from gripmon.teach.image_motion import FingerMoved, JawMotion, Unfit, along_finger, contact
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
        elif pose is None:
            placed = _across_travel(placed, found.direction)
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


def _across_travel(placed: PlacedOutlines, direction: Array) -> PlacedOutlines:
    """With x as the jaws move, square to the fingers: which of the tips' vertices face each other tells less."""
    along = placed.rotation[:, 2]
    across = direction - along * float(along @ direction)
    across *= np.sign(float(across @ placed.rotation[:, 0])) / np.linalg.norm(across)
    return replace(placed, rotation=np.column_stack([across, np.cross(along, across), along]))


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
    points = [np.column_stack([f.xy, np.ones(len(f.xy))]) / q[:, None] for f, q in zip(fingers, found.q, strict=True)]
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
