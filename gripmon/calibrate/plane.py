"""``cam_T_grip`` from images of the gripper standing on a calibration plate, with the effect of every error on it.

The method's equations are in :mod:`gripmon.calibrate.plane_equations`; this module handles one image with its
covariance.  Errors are propagated through the whole solution by central differences, one independent error at a time:
of the plate's pose, of the corners, and of the camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc

from gripmon.calibrate.bundle import Bundle, GivenCamera, independent_errors
from gripmon.calibrate.lens_models import lens_vector
from gripmon.calibrate.plane_equations import FEWEST_CORNERS, INFERRED_FROM, FreePose, GripperOnPlate, off_plate, stand
from gripmon.calibrate.plate_pose import plate_pose
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.geometry import perturb, perturbation_between
from gripmon.model.records import Array

DOUBTED = 1e-3
"""Probability below which residuals, or the plane's coincidence, count as contradicting their uncertainty."""
RECTANGLE_PROBABILITY, RECTANGLE_MISFIT = 1e-6, 0.005
"""An inferred gripper's corners are not a rectangle if they are less probable than the first and deviate by more than
the second, a fraction of their reach: fingers may be misaligned by less.
"""
LARGEST_RMS_SHARE = 0.005
"""Root mean square residual of the plate's points, over the image's width, above which they count as unexplained."""
_STEP = 0.05
"""Step of the central differences, in standard deviations."""


@dataclass(frozen=True, slots=True)
class FingerCorners:
    """Measured corners of the gripper in one image: ``names`` (c), ``uv_px`` (c, 2), and ``covariance_px`` (2c, 2c) of
    u and v of the first, then of the next: errors of corners at both ends of an edge are correlated.  ``free``: the
    pose of the whole gripper from all its edges, if it is known that well.
    """

    names: tuple[str, ...]
    uv_px: Array
    covariance_px: Array
    free: FreePose | None = None

    @classmethod
    def independent(cls, names: Sequence[str], uv_px: Array, covariance_px: Array) -> FingerCorners:
        """From independent covariances (c, 2, 2)."""
        return cls(tuple(names), uv_px, block_diag(*covariance_px) if len(covariance_px) else np.zeros((0, 0)))

    @property
    def each_px2(self) -> Array:
        """(c, 2, 2), the covariance of each corner by itself."""
        count = len(self.names)
        blocks = self.covariance_px.reshape(count, 2, count, 2)
        return np.ascontiguousarray(np.einsum("ipiq->ipq", blocks))


@dataclass(frozen=True, slots=True)
class KnownCorners:
    """The gripper's own coordinates (c, 3) of the corners at the images' jaw opening, and the z of its contact plane (0
    if the TCP lies between the fingertips).
    """

    corners_m: Array
    contact_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Coincidence:
    """The result of one image on the plate.

    ``cam_T_grip`` (4, 4); ``corners_m`` (c, 3) the gripper's corners, given or inferred.  ``own``, ``printed`` and
    ``common`` (6 + s, k) are the effects of k independent errors, per standard deviation, on the TCP's position and the
    rotation (camera axes) and on the s inferred lengths: ``own`` of this image alone; ``printed`` of the plate's print,
    which affects every image in a different way; ``common`` of the camera, the same errors in all images.
    ``covariance`` (6, 6) follows from these.

    ``residuals_m`` (c, 2) on the plate, gripper axes, ``residuals_px`` (c, 2) measured less predicted; ``p_value``: the
    probability of residuals as large by chance, 1 if there is nothing left to test (two known corners leave one
    equation, four inferred ones three).  Below :data:`DOUBTED` the corners' part of the errors is ``enlarged`` by the
    ratio of the residuals to their expected size.

    ``tilt_rad`` (2,) about the gripper's x and y and ``gap_m`` (positive: above the plate): how far the gripper, its
    pose found without the plate, leaves the plate, with ``apart_covariance`` (3, 3) and ``apart_p``.  They come from
    all its edges (``corners.free``), otherwise from the corners; None with fewer than four known ones.  ``plate_xy_m``
    (c, 2): the corners in the plate's frame.
    """

    sighting: Sighting
    corners: FingerCorners
    cam_T_grip: Array
    corners_m: Array
    own: Array
    printed: Array
    common: Array
    residuals_m: Array
    residuals_px: Array
    p_value: float
    enlarged: float
    tilt_rad: Array | None
    gap_m: float | None
    apart_covariance: Array | None
    apart_p: float | None
    cam_T_plate: Array
    plate: Bundle
    plate_xy_m: Array

    @property
    def apart_sigma(self) -> Array | None:
        """(3,) standard deviations of tilt and gap."""
        return None if self.apart_covariance is None else np.sqrt(self.apart_covariance.diagonal())

    @property
    def covariance(self) -> Array:
        """(6, 6) of the error: position of the TCP, then rotation, camera axes."""
        slopes = np.concatenate([self.own[:6], self.printed[:6], self.common[:6]], axis=1)
        return slopes @ slopes.T


def calibrate_plane(
    camera: GivenCamera, sighting: Sighting, corners: FingerCorners, known: KnownCorners | None
) -> Coincidence:
    """``cam_T_grip`` from one image of the plate with the gripper on it.

    Without ``known`` corners the gripper is inferred: the first four of ``corners`` must then be the innermost ones, in
    the order (first finger, y < 0), (first, y > 0), (second, y < 0), (second, y > 0), the second finger on the side of
    +x, and all corners are contact points.  Raises :class:`CalibrationError`.
    """
    _check_count(corners, known)
    cam_T_plate, plate_covariance, bundle = _plate(camera.lens, sighting)
    made = make_camera(camera.lens)
    given = _Given(made, cam_T_plate, corners.uv_px)
    solve = _solver(made, corners, known)
    found = solve(given)
    # Residuals beyond their covariances are attributed to the print, which the same plate brings into every image.
    print_share = 1.0 - 1.0 / max(bundle.scale, 1.0) ** 2

    def other_plate(change: Array) -> _Given:
        return replace(given, cam_T_plate=perturb(cam_T_plate, change))

    def other_corners(change: Array) -> _Given:
        return replace(given, uv_px=given.uv_px + change.reshape(-1, 2))

    def other_camera(change: Array) -> _Given:
        # The plate's pose follows the camera: with another camera the same image shows the plate elsewhere.
        lens = camera.model.settings(lens_vector(camera.lens) + camera.free @ change)
        seen_by = camera.model.camera(lens_vector(lens))
        return replace(given, camera=seen_by, cam_T_plate=plate_pose(lens, sighting)[0])

    own = _ends(other_plate, (1.0 - print_share) * plate_covariance) + _ends(other_corners, corners.covariance_px)
    printed = _ends(other_plate, print_share * plate_covariance) if print_share > 0.0 else []
    common = _ends(other_camera, camera.covariance) if camera.covariance is not None and camera.parameters else []
    slopes = [_slope(solve(up), solve(down)) for up, down in (*own, *printed, *common)]
    motion, left, apart = (np.stack(columns, axis=1) for columns in zip(*slopes, strict=True))
    size, freedom = _size(found.residuals_m.ravel(), left @ left.T)
    p_value = float(chdtrc(freedom, size)) if freedom else 1.0
    if known is None and p_value < RECTANGLE_PROBABILITY and _misfit(found) > RECTANGLE_MISFIT:
        raise CalibrationError(_no_rectangle(corners.names, found.residuals_m, p_value))
    enlarged = float(np.sqrt(size / freedom)) if p_value < DOUBTED else 1.0
    motion[:, len(own) - 2 * len(corners.names) : len(own)] *= enlarged
    if known is not None and corners.free is not None:
        apart = np.concatenate([apart, corners.free.own_slopes(cam_T_plate, known.contact_m)], axis=1)
    apart_covariance = apart @ apart.T
    points = found.corners_m @ found.cam_T_grip[:3, :3].T + found.cam_T_grip[:3, 3]
    known_apart = found.apart is not None
    return Coincidence(
        sighting=sighting,
        corners=corners,
        cam_T_grip=found.cam_T_grip,
        corners_m=found.corners_m,
        own=motion[:, : len(own)],
        printed=motion[:, len(own) : len(own) + len(printed)],
        common=motion[:, len(own) + len(printed) :],
        residuals_m=found.residuals_m,
        residuals_px=corners.uv_px - made.project(points),
        p_value=p_value,
        enlarged=enlarged,
        tilt_rad=found.apart[:2] if found.apart is not None else None,
        gap_m=float(found.apart[2]) if found.apart is not None else None,
        apart_covariance=apart_covariance if known_apart else None,
        apart_p=chance(found.apart, apart_covariance) if found.apart is not None else None,
        cam_T_plate=cam_T_plate,
        plate=bundle,
        plate_xy_m=((points - cam_T_plate[:3, 3]) @ cam_T_plate[:3, :3])[:, :2],
    )


def _plate(lens: LensSettings, sighting: Sighting) -> tuple[Array, Array, Bundle]:
    """``cam_T_plate``, its covariance (6, 6) and the fit that it comes from.  Raises :class:`CalibrationError`."""
    cam_T_plate, covariance, bundle = plate_pose(lens, sighting)
    if bundle.rms_px > LARGEST_RMS_SHARE * lens.width_px:
        raise CalibrationError(
            f"the plate doesn't fit the camera: residuals of {bundle.rms_px:.3g} px; the camera that took the image, "
            "and the target as it is"
        )
    if sighting.disc_radius_m == 0.0 and bundle.scale < 1.0:
        # Errors shared by a board's corners affect the pose, not its residuals: small residuals must not reduce the
        # covariance below that of the corners' own uncertainties.
        covariance = covariance / bundle.scale**2
    return cam_T_plate, covariance, bundle


def _solver(made: Camera, corners: FingerCorners, known: KnownCorners | None) -> Callable[[_Given], GripperOnPlate]:
    """A function from a solution's inputs to the gripper's pose on the plate; ``made`` is the camera as calibrated."""
    each_px2, free = corners.each_px2, corners.free if known is not None else None
    known_m, contact_m = (None, 0.0) if known is None else (known.corners_m, known.contact_m)

    def solve(given: _Given) -> GripperOnPlate:
        found = stand(given.camera, given.cam_T_plate, given.uv_px, each_px2, known_m, contact_m)
        if free is None:
            return found
        through = free.cam_T_grip if given.camera is made else free.through(given.camera)
        return replace(found, apart=off_plate(through, given.cam_T_plate, contact_m))

    return solve


def _misfit(found: GripperOnPlate) -> float:
    """Misfit of the innermost corners, over their reach."""
    left, reach = found.residuals_m[:INFERRED_FROM], found.corners_m[:INFERRED_FROM, :2]
    return float(np.linalg.norm(left) / np.linalg.norm(reach))


def _no_rectangle(names: Sequence[str], residuals_m: Array, p_value: float) -> str:
    sizes_m = np.linalg.norm(residuals_m, axis=1)
    return (
        f"the innermost corners don't form a rectangle on the plate (probability {p_value:.1g}; "
        f"{names[int(sizes_m.argmax())]} is {1e3 * float(sizes_m.max()):.3f} mm off): both "
        "fingertips flat on the plate, rough corners nearer to the real ones where a line of the plate runs beside a "
        "finger, the target as it was described"
    )


def lengths_of(corners_m: Array) -> Array:
    """Parameters of an inferred gripper (s,): the rectangle's sides, then x and y of each further corner (m)."""
    return np.concatenate([2.0 * corners_m[3, :2], corners_m[INFERRED_FROM:, :2].ravel()])


def corners_of(lengths: Array) -> Array:
    """The inverse of :func:`lengths_of`: corners (c, 3), m."""
    x, y = 0.5 * lengths[:2]
    xy = np.concatenate([[[-x, -y], [-x, y], [x, -y], [x, y]], lengths[2:].reshape(-1, 2)])
    return np.concatenate([xy, np.zeros((len(xy), 1))], axis=1)


def chance(values: Array, covariance: Array) -> float:
    """Probability of values as large, given their (possibly singular) covariance; 1 if nothing is free."""
    size, freedom = _size(values, covariance)
    return float(chdtrc(freedom, size)) if freedom else 1.0


def _size(values: Array, covariance: Array) -> tuple[float, int]:
    """Normalised square, and the number of degrees of freedom."""
    variances, axes = np.linalg.eigh(covariance)
    free = variances > 1e-6 * max(float(variances.max()), 1e-300)
    return float((np.square(axes.T[free] @ values) / variances[free]).sum()), int(free.sum())


def _check_count(corners: FingerCorners, known: KnownCorners | None) -> None:
    count = len(corners.names)
    if known is None and count < INFERRED_FROM:
        raise CalibrationError(f"{count} corner(s) of a gripper that isn't known; the {INFERRED_FROM} innermost ones")
    if count < FEWEST_CORNERS:
        named = f" ({corners.names[0]})" if count else ""
        raise CalibrationError(f"{count} corner{named} of the gripper; at least {FEWEST_CORNERS}, which lie apart")


@dataclass(frozen=True, slots=True)
class _Given:
    """The inputs of a solution."""

    camera: Camera
    cam_T_plate: Array
    uv_px: Array


def _ends(changed: Callable[[Array], _Given], covariance: Array) -> list[tuple[_Given, _Given]]:
    """The inputs of a solution at both ends of a central difference, for each of a covariance's independent errors."""
    return [(changed(_STEP * root), changed(-_STEP * root)) for root in independent_errors(covariance)]


def _slope(up: GripperOnPlate, down: GripperOnPlate) -> tuple[Array, Array, Array]:
    """Derivatives by one independent error, per standard deviation: of pose and inferred lengths (6 + s,), of the
    residuals (2c,), of tilt and gap (3,).
    """
    per = 1.0 / (2.0 * _STEP)
    motion = perturbation_between(down.cam_T_grip, up.cam_T_grip)
    if up.corners_m is not down.corners_m:
        motion = np.concatenate([motion, lengths_of(up.corners_m) - lengths_of(down.corners_m)])
    apart = np.zeros(3) if up.apart is None or down.apart is None else up.apart - down.apart
    return motion * per, (up.residuals_m - down.residuals_m).ravel() * per, apart * per
