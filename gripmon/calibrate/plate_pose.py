"""Where a plate is: its pose from one image by a camera that is known."""

from __future__ import annotations

import cv2
import numpy as np

from gripmon.calibrate.bundle import Bundle, BundleProblem, GivenCamera, independent_errors
from gripmon.calibrate.lens_models import LensModel, lens_vector, model_of
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.model.camera import LensSettings
from gripmon.model.records import Array


def plate_pose(camera: LensSettings, sighting: Sighting) -> tuple[Array, Array, Bundle]:
    """``cam_T_plate`` (4, 4) with the covariance (6, 6) of its error (position then rotation, camera axes) for an exact
    camera, and the fit that it comes from.  Raises :class:`CalibrationError`.
    """
    if len(sighting) < 4:
        raise CalibrationError(f"{len(sighting)} points of the plate; at least 4")
    lens_model, parameters = LensModel(model_of(camera), camera.width_px, camera.height_px), lens_vector(camera)
    problem = BundleProblem(lens_model, [sighting], np.zeros((len(parameters), 0)))
    found: list[Bundle] = []
    failure: CalibrationError | None = None
    # From afar a plane has two poses that look nearly the same; each is a local minimum.
    for start in _plate_pose_starts(lens_model, parameters, sighting):
        try:
            found.append(problem.solve(parameters, [start]))
        except CalibrationError as error:
            failure = failure or error
    if not found:
        raise failure or CalibrationError("the plate's pose can't be found")
    bundle = min(found, key=_typical_px)
    return bundle.cam_T_plate[0], bundle.covariance, bundle


def plate_pose_start(lens_model: LensModel, parameters: Array, sighting: Sighting) -> Array:
    """``cam_T_plate`` (4, 4) in closed form, from ideal coordinates (Collins and Bartoli, "Infinitesimal plane-based
    pose estimation", 2014).  :class:`CalibrationError` if the lens doesn't map the points or they are collinear.
    """
    return _plate_pose_starts(lens_model, parameters, sighting)[0]


def _plate_pose_starts(lens_model: LensModel, parameters: Array, sighting: Sighting) -> list[Array]:
    """Both poses (4, 4), the better one first."""
    xy = lens_model.camera(parameters).undistort(sighting.uv_px)
    good = np.isfinite(xy).all(axis=1)
    if good.sum() < 4:
        raise CalibrationError("the start is outside of what the lens model maps")
    # The solver expects centred points.
    middle = sighting.plate_m[good].mean(axis=0)
    points = (sighting.plate_m[good] - middle) * [1.0, 1.0, 0.0]  # also of a target that isn't quite flat
    spread = np.linalg.svd(points[:, :2], compute_uv=False)
    if spread[1] < 1e-3 * spread[0]:
        raise CalibrationError("all points of the plate lie on a line; points that span an area")
    found, turns, shifts, _ = cv2.solvePnPGeneric(
        points, np.ascontiguousarray(xy[good]), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    if not found:
        raise CalibrationError("the plate's pose can't be found")
    out: list[Array] = []
    for turn, shift in zip(turns, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(turn)[0]
        pose[:3, 3] = shift.ravel() - pose[:3, :3] @ middle
        if np.isfinite(pose).all() and ((points @ pose[2, :3] + shift.ravel()[2]) > 0.0).all():
            out.append(pose)
    if not out:
        raise CalibrationError("the plate's pose can't be found")
    return out


def _typical_px(bundle: Bundle) -> float:
    """Median residual of all points: a wrong pose has no outliers, because all points are equally far off."""
    sizes = np.linalg.norm(np.concatenate(bundle.residuals_px), axis=1)
    return float(np.median(np.where(np.isfinite(sizes), sizes, np.inf)))


def pose_slopes(camera: GivenCamera, sighting: Sighting, cam_T_plate: Array) -> Array:
    """(6, p): effect of each of the camera's independent errors, per standard deviation, on the plate's pose from the
    image (position then rotation, camera axes), to first order; p = 0 for an exact camera.
    """
    if camera.covariance is None or not camera.parameters:
        return np.zeros((6, 0))
    problem = BundleProblem(camera.model, [sighting], camera.free)
    normal = problem.normal_matrix(lens_vector(camera.lens), cam_T_plate)
    p = len(camera.parameters)
    out: Array = -np.linalg.solve(normal[p:, p:], normal[p:, :p]) @ independent_errors(camera.covariance).T
    return out
