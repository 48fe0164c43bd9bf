"""Images of a gripper on a calibration plate: its faces drawn ray by ray, nothing of the measurement is in here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Image
from gripmon.model.targets import Charuco, Chequerboard, CircleGrid, Target
from support.kept import kept
from support.plates import Look, render
from support.simulated import PAPER_LENS, nominal_cam_T_grip, sharp_gripper

CHEQUERBOARD = Chequerboard(14, 12, 0.006)
CHARUCO = Charuco(14, 12, 0.006, 0.0044, "DICT_4X4_250")
DISCS = CircleGrid(12, 10, 0.008, 0.004)
OPENING_M = 0.034
LOOK = Look(supersampling=4)
FACE_GREYS = (60.0, 110.0, 90.0, 75.0, 100.0, 120.0)


@dataclass(frozen=True)
class Faces:
    """Draws the gripper's visible faces as the camera at ``cam_T_grip`` sees them."""

    gripper: Gripper
    cam_T_grip: np.ndarray
    jaw_opening_m: float

    def __call__(self, xy: np.ndarray, grey: np.ndarray) -> np.ndarray:
        points = self.gripper.points_grip_m(self.jaw_opening_m) @ self.cam_T_grip[:3, :3].T + self.cam_T_grip[:3, 3]
        out, at = grey.copy(), np.flatnonzero(_about(xy, points[:, :2] / points[:, 2:]))
        rays = xy[at]
        for number, face in enumerate(self.gripper.faces):
            corners = points[face.points]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            if normal @ corners[0] >= 0.0:
                continue  # it looks away
            # In front of the camera's plane a ray meets a convex face if it is on the same side of all its edges.
            inside = np.ones(len(rays), dtype=bool)
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                across = np.cross(a, b)
                inside &= rays @ across[:2] + across[2] < 0.0
            out[at[inside]] = FACE_GREYS[number % len(FACE_GREYS)] + (15.0 if number >= 6 else 0.0)
        return out


def _about(xy: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Which rays lie in the rectangle about these points, all in front of the camera."""
    (left, top), (right, bottom) = points.min(axis=0), points.max(axis=0)
    x, y = xy[:, 0], xy[:, 1]
    return (x >= left) & (x <= right) & (y >= top) & (y <= bottom)


@kept
def standing(
    target: Target,
    *,
    turn_rad: float = 0.3,
    shift_m: tuple[float, float] = (0.0, 0.0),
    lens: LensSettings = PAPER_LENS,
    look: Look = LOOK,
    grip_T_standing: np.ndarray | None = None,
    seed: int = 0,
) -> Image:
    """The gripper stands on the plate, turned and shifted; ``grip_T_standing`` is by what it doesn't."""
    cam_T_grip = nominal_cam_T_grip()
    middle = {"circles": lambda t: (t.columns - 1, t.rows - 1, t.spacing_m)}.get(
        target.__struct_config__.tag, lambda t: (t.columns - 1, t.rows - 1, t.square_m)
    )(target)
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    standing_T_plate = np.eye(4)
    standing_T_plate[:2, :2] = [[c, -s], [s, c]]
    centre = 0.5 * middle[2] * np.array(middle[:2]) + (middle[2] if isinstance(target, Charuco) else 0.0) * 0.5
    standing_T_plate[:2, 3] = np.array(shift_m) - standing_T_plate[:2, :2] @ centre
    lifted = np.eye(4) if grip_T_standing is None else grip_T_standing
    faces = Faces(sharp_gripper(), cam_T_grip, OPENING_M)
    return render(lens, cam_T_grip @ lifted @ standing_T_plate, target, look, solid=faces, seed=seed)


def true_corners(cam_T_grip: np.ndarray, lens: LensSettings = PAPER_LENS) -> dict[str, np.ndarray]:
    """Pixels of all corners by name."""
    gripper = sharp_gripper()
    points = gripper.points_grip_m(OPENING_M)[gripper.corner_points]
    uv = make_camera(lens).project(points @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
    return dict(zip(gripper.corner_ids, uv, strict=True))


_OUTLINE = {"inner_near": "in_near", "inner_far": "in_far", "outer_near": "out_near"}


def outline_pixels(cam_T_grip: np.ndarray, lens: LensSettings = PAPER_LENS) -> dict[str, np.ndarray]:
    """Pixels of the two fingertips' outlines in view, by the names for a gripper that isn't known; the true corners'
    names are those of :func:`true_name`.
    """
    gripper, camera = sharp_gripper(), make_camera(lens)
    points_m = gripper.points_grip_m(OPENING_M)
    out = {}
    for finger in ("left", "right"):
        true = true_corners(cam_T_grip, lens)
        out |= {f"{finger}_{name}": true[true_name(f"{finger}_{name}")] for name in _OUTLINE}
        for name, foot in (("rise_far", "in_far"), ("rise_near", "out_near")):
            point = points_m[gripper.point_ids.index(f"{finger[0].upper()}_{foot}")] - [0.0, 0.0, 0.025]
            out[f"{finger}_{name}"] = camera.project((cam_T_grip[:3, :3] @ point + cam_T_grip[:3, 3])[None])[0]
    return out


def true_name(name: str) -> str:
    """``left_inner_near`` is the gripper file's ``L_in_near``."""
    finger, _, corner = name.partition("_")
    return f"{finger[0].upper()}_{_OUTLINE[corner]}"


def rough(points: dict[str, np.ndarray], seed: int, off_px: float = 5.0) -> dict[str, tuple[float, float]]:
    """Someone's guess: up to so many pixels off in u and v."""
    rng = np.random.default_rng(seed)
    return {
        name: (float(u), float(v))
        for name, (u, v) in ((n, p + rng.uniform(-off_px, off_px, 2)) for n, p in points.items())
    }
