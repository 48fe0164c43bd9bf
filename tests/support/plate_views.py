"""A gripper on a plate without images: points by the method's own formulas, written down a second time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.plane import Coincidence, FingerCorners, KnownCorners, calibrate_plane
from gripmon.calibrate.sighting import Sighting
from gripmon.model.camera import PaperLens

LENS = PaperLens(width_px=768, height_px=576, fx_px=962.0, fy_px=962.0, cx_px=383.5, cy_px=287.5, kappa_per_px2=1.9e-7)
NAMES = ("left_inner_near", "left_inner_far", "right_inner_near", "right_inner_far", "left_outer", "right_outer")
CORNERS_M = np.array(
    [
        [-0.017, -0.008, 0.0],
        [-0.017, 0.008, 0.0],
        [0.017, -0.008, 0.0],
        [0.017, 0.008, 0.0],
        [-0.026, -0.008, 0.0],
        [0.026, -0.008, 0.0],
    ]
)
SPACING_M = 0.008
EXACT = GivenCamera(LENS)


def seen_by(points_cam_m: np.ndarray, lens: PaperLens = LENS) -> np.ndarray:
    """Pixels (n, 2), equations (3) and (4): the ideal radius is rho (1 + kappa rho²) of the distorted one, a cubic."""
    ideal = points_cam_m[:, :2] / points_cam_m[:, 2:] * np.array([lens.fx_px, lens.fx_px])
    out = np.empty_like(ideal)
    for k, (x, y) in enumerate(ideal):
        r = np.hypot(x, y)
        roots = np.roots([lens.kappa_per_px2, 0.0, 1.0, -r])
        rho = min(root.real for root in roots if abs(root.imag) < 1e-9 and root.real >= 0.0)
        share = rho / r if r > 0.0 else 1.0
        out[k] = lens.cx_px + share * x, lens.cy_px + share * y * lens.fy_px / lens.fx_px
    return out


def moved(a_T_b: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    return points_m @ a_T_b[:3, :3].T + a_T_b[:3, 3]


def transform(rotation_vector: np.ndarray | list[float], translation_m: np.ndarray | list[float]) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(rotation_vector).as_matrix(), translation_m
    return out


@dataclass(frozen=True)
class Trial:
    """A set-up and what is measured in it.  ``noise_px`` of points and ``corner_px`` of corners; ``print_m`` error of
    the plate's points; ``tilt_rad`` (about the gripper's x, y) and ``gap_m`` of the gripper off the plate.
    """

    cam_T_grip: np.ndarray
    sighting: Sighting
    corners: FingerCorners


def trial(
    rng: np.random.Generator,
    *,
    noise_px: float = 0.0,
    corner_px: float = 0.0,
    print_m: float = 0.0,
    tilt_rad: tuple[float, float] = (0.0, 0.0),
    gap_m: float = 0.0,
    contact_m: float = 0.0,
    corners_m: np.ndarray = CORNERS_M,
    cam_T_grip: np.ndarray | None = None,
    print_errors_m: np.ndarray | None = None,
    lens: PaperLens = LENS,
    outliers: int = 0,
    name: str = "view.png",
) -> Trial:
    if cam_T_grip is None:
        wobble = rng.normal(0.0, 0.02, 3)
        cam_T_grip = transform([np.radians(32.0), 0.0, 0.0], [0.0, 0.004, 0.115]) @ transform(wobble, [0.0, 0.0, 0.0])
    grip_T_standing = transform([*tilt_rad, 0.0], [0.0, 0.0, 0.0]) @ transform([0.0] * 3, [0.0, 0.0, -gap_m])
    standing_T_plate = transform([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)], [*rng.uniform(-0.01, 0.01, 2), contact_m])
    cam_T_plate = cam_T_grip @ np.linalg.inv(grip_T_standing) @ standing_T_plate
    r, c = np.mgrid[:8, :8]
    plate_m = np.stack([SPACING_M * (c.ravel() - 3.5), SPACING_M * (r.ravel() - 3.5), np.zeros(64)], axis=1)
    printed_m = plate_m.copy()
    printed_m[:, :2] += rng.normal(0.0, print_m, (64, 2)) if print_errors_m is None else print_errors_m
    uv_px = seen_by(moved(cam_T_plate, printed_m), lens)
    inside = np.all((uv_px > 0.0) & (uv_px < [lens.width_px - 1, lens.height_px - 1]), axis=1)
    uv_px = uv_px[inside] + rng.normal(0.0, noise_px, (int(inside.sum()), 2))
    for k in rng.choice(len(uv_px), outliers, replace=False):
        uv_px[k] += rng.uniform(5.0, 30.0, 2)
    sigma_px = max(noise_px, 0.01)
    covariance = np.tile(np.eye(2) * sigma_px**2, (len(uv_px), 1, 1))
    size = (lens.width_px, lens.height_px)
    sighting = Sighting(uv_px, plate_m[inside], covariance, size, 0.0, name)
    corner_uv = seen_by(moved(cam_T_grip, corners_m), lens) + rng.normal(0.0, corner_px, (len(corners_m), 2))
    each = np.tile(np.eye(2) * max(corner_px, 0.01) ** 2, (len(corners_m), 1, 1))
    return Trial(cam_T_grip, sighting, FingerCorners.independent(NAMES[: len(corners_m)], corner_uv, each))


def solved(
    made: Trial, known_m: np.ndarray | None = CORNERS_M, contact_m: float = 0.0, camera: GivenCamera = EXACT
) -> Coincidence:
    known = None if known_m is None else KnownCorners(known_m, contact_m)
    return calibrate_plane(camera, made.sighting, made.corners, known)
