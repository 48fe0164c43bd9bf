"""Inputs for the off-line calibrations, of one camera and one gripper: images of a plate, of the gripper standing on
it, of a board from many poses of the robot, and spots of a laser pointer for a second camera.

Each folder holds ``truth.json`` beside its images.  ``truth`` is what the images were made from; no measurement of
gripmon's own is used here.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from gripmon.model.camera import BrownConradyLens, Camera, make_camera
from gripmon.model.geometry import exp_rotation, invert, make_transform, perturb, quaternion_xyzw
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.model.targets import Charuco, CircleGrid, Target, name_of
from gripmon.simulate.coverage import RayGrid
from gripmon.simulate.disturbance import SensorModel
from gripmon.simulate.laser import cluttered, paper_cell, pixels_of, poses_on_plane, spot_image
from gripmon.simulate.plates import Plate, PlateBackdrop, facing
from gripmon.simulate.scenario import JawScript, Scenario, Sensor
from gripmon.simulate.sequence import PNG_COMPRESSION, Rig

PLATE = CircleGrid(12, 10, 0.008, 0.004)
"""Mostly light, so that dark fingers stand out in front of it."""
BOARD = Charuco(8, 6, 0.015, 0.011, "DICT_4X4_250")
SECOND_PLATE = CircleGrid(12, 10, 0.03, 0.015)
SECOND_LENS = BrownConradyLens(
    width_px=640, height_px=480, fx_px=543.0, fy_px=543.0, cx_px=321.0, cy_px=238.5,
    coefficients=(-0.11, 0.04, 0.0004, -0.0003),
)  # fmt: skip
"""The second camera, fixed beside the robot."""
ROUGH_OFF_PX = 4.0
"""Largest error of a person's rough corners, in u and v."""
_STANDING = 3
_FREE_VIEWS, _FINGER_VIEWS = 6, 6
_ROBOT_POSES = 12
_ORIENTATIONS, _FRESH_ORIENTATIONS = 5, 2
_BORDER_PX = 15.0
"""Minimum distance of spots from the image's border: three times their radius."""
_ARM_SIGMAS = np.array([5e-5] * 3 + [1e-4] * 3)
"""Standard deviations of the robot's reported poses, each axis (m, rad): a good arm's repeatability."""
_CAMERA_MOTION = np.array([2e-3, -1e-3, 1e-3, 0.002, 0.004, -0.003])
"""Motion of the second camera before the fresh spots (m, rad)."""

Progress = Callable[[], None]


def image_count(kind: str) -> int:
    """Number of images of a kind of :data:`KINDS`."""
    return _WRITERS[kind][1]


def write_calibration_images(
    kind: str, rig: Rig, out_dir: Path, seed: int = 0, progress: Progress = lambda: None
) -> None:
    """Write a kind of :data:`KINDS` into an existing folder.  ``progress`` is called after each image.  OSError if a
    file can't be written, ValueError for an unsuitable gripper: no closed convex fingers, or jaws without tips.
    """
    write, _ = _WRITERS[kind]
    write(_Folder(out_dir, progress), rig, seed)


class _Folder:
    def __init__(self, path: Path, progress: Progress) -> None:
        self.path, self._progress = path, progress

    def image(self, name: str, image: Image) -> None:
        path = self.path / name
        path.parent.mkdir(exist_ok=True)
        if not cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]):
            raise OSError(f"can't write {path}")
        self._progress()

    def truth(self, name: str = "truth.json", **values: Any) -> None:
        text = json.dumps(values, indent=1, default=_plain)
        (self.path / name).write_text(text + "\n", encoding="utf-8")

    def table(self, name: str, rows: Sequence[dict[str, Any]]) -> None:
        with (self.path / name).open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else msgspec.to_builtins(value)


def _plate(folder: _Folder, rig: Rig, seed: int) -> None:
    """First without the gripper, with the plate near and filling the image to its corners; then behind the fingers."""
    rng = np.random.default_rng([seed, 11])
    near_m = float(rig.cam_T_grip[2, 3])
    views = []
    for number in range(_FREE_VIEWS + _FINGER_VIEWS):
        free = number < _FREE_VIEWS
        count = _FREE_VIEWS if free else _FINGER_VIEWS
        cam_T_plate = _tilted(rig.camera, PLATE, (1.0, 1.25) if free else (1.35, 1.6), near_m, number / count, rng)
        plate = Plate(PLATE, cam_T_plate)
        image = _without_gripper(rig.camera, plate, seed, number) if free else _with_gripper(rig, plate, seed, number)
        name = f"{number:02d}.png"
        folder.image(name, image)
        views.append({"file": name, "fingers": not free, "cam_T_plate": cam_T_plate})
    folder.truth(camera=rig.camera.settings, target=name_of(PLATE), images=views)


def _tilted(
    camera: Camera, target: Target, depths: tuple[float, float], unit_m: float, share: float, rng: np.random.Generator
) -> Array:
    """A plate tilted by 0.5 rad towards one of the directions all round, its centre beside the image's."""
    way = 2.0 * math.pi * share
    depth = float(rng.uniform(*depths)) * unit_m
    half = 0.5 * depth * np.array([camera.width_px / camera.fx_px, camera.height_px / camera.fy_px])
    middle = 0.25 * half * [math.cos(way + 2.0), math.sin(way + 2.0)] + rng.uniform(-0.1, 0.1, 2) * half
    tilt = 0.5 * np.array([math.cos(way), math.sin(way)])
    return facing(target, [*middle, depth], tilt.tolist(), float(rng.uniform(-math.pi, math.pi)))


def _standing(folder: _Folder, rig: Rig, seed: int) -> None:
    rng = np.random.default_rng([seed, 12])
    corners, rough = rough_corners(rig.camera, rig.gripper, rig.cam_T_grip, rig.jaw_opening_m, rng, ROUGH_OFF_PX)
    size = np.array([PLATE.columns - 1.0, PLATE.rows - 1.0, 0.0]) * PLATE.spacing_m
    tip = np.array([0.0, 0.0, float(rig.gripper.points_grip_m(rig.jaw_opening_m)[:, 2].max())])
    views = []
    for number in range(_STANDING):
        rotation = exp_rotation(np.array([0.0, 0.0, 0.3 + 2.0 * math.pi * number / _STANDING + rng.uniform(-0.2, 0.2)]))
        middle = tip + np.array([*rng.uniform(-0.004, 0.004, 2), 0.0])
        grip_T_plate = make_transform(rotation, middle - rotation @ (0.5 * size))
        plate = Plate(PLATE, rig.cam_T_grip @ grip_T_plate)
        folder.image(f"{number}.png", _with_gripper(rig, plate, seed, 20 + number))
        views.append({"file": f"{number}.png", "grip_T_plate": grip_T_plate})
    folder.truth(
        camera=rig.camera.settings, target=name_of(PLATE), cam_T_grip=rig.cam_T_grip,
        jaw_opening_m=rig.jaw_opening_m, corners=corners, images=views,
    )  # fmt: skip
    lines = [f"  {name}: [{u:.1f}, {v:.1f}]" for name, (u, v) in rough.items()]
    head = (
        "# Simulated: where a person would have put the corners of the fingertips, up to "
        f"{ROUGH_OFF_PX:g} px off (u right, v down, px).\n# Of your own gripper: gripmon teach --page 0.png\n"
    )
    (folder.path / "rough.yaml").write_text(head + "\n".join(["corners:", *lines]) + "\n", encoding="utf-8")


def _robot_world(folder: _Folder, rig: Rig, seed: int) -> None:
    """A fixed board on the table, seen by the wrist camera from all sides, with the flange's pose from the robot."""
    rng = np.random.default_rng([seed, 13])
    ee_T_grip = make_transform(exp_rotation(np.array([0.0, 0.0, 0.6])), np.array([0.004, -0.002, 0.165]))
    ee_T_cam = ee_T_grip @ invert(rig.cam_T_grip)
    base_T_board = make_transform(exp_rotation(np.array([math.pi, 0.0, 0.0])), np.array([0.42, 0.11, 0.018]))
    rows, views = [], []
    for number in range(_ROBOT_POSES):
        depths = (1.8, 2.3)
        cam_T_board = _tilted(rig.camera, BOARD, depths, float(rig.cam_T_grip[2, 3]), number / _ROBOT_POSES, rng)
        name = f"{number:02d}.png"
        folder.image(name, _with_gripper(rig, Plate(BOARD, cam_T_board), seed, 40 + number))
        base_T_ee = base_T_board @ invert(cam_T_board) @ invert(ee_T_cam)
        rows.append({"image": name, **_pose(perturb(base_T_ee, rng.normal(0.0, _ARM_SIGMAS)))})
        views.append({"file": name, "cam_T_target": cam_T_board})
    folder.table("views.csv", rows)
    folder.truth(
        camera=rig.camera.settings, target=name_of(BOARD), cam_T_grip=rig.cam_T_grip, ee_T_grip=ee_T_grip,
        cam_T_ee=invert(ee_T_cam), base_T_target=base_T_board, images=views,
    )  # fmt: skip


def _spots(folder: _Folder, rig: Rig, seed: int) -> None:
    """A second camera beside the robot: its plate, images of spots, and spots after it was knocked."""
    rng = np.random.default_rng([seed, 14])
    camera = make_camera(SECOND_LENS)
    views = []
    for number in range(_FREE_VIEWS + _FINGER_VIEWS):
        share = number / _FREE_VIEWS % 1.0
        cam_T_plate = _tilted(camera, SECOND_PLATE, (0.4, 0.55), 1.0, share, rng)
        folder.image(
            f"plate/{number:02d}.png", _without_gripper(camera, Plate(SECOND_PLATE, cam_T_plate), seed, number)
        )
        views.append({"file": f"plate/{number:02d}.png", "cam_T_plate": cam_T_plate})
    cell = paper_cell(rng)
    size = camera.width_px, camera.height_px
    table = cluttered(rng, size)
    folder.image("off.png", spot_image(None, rng, size_px=size, ambient=table))
    base_T_ee, _ = poses_on_plane(cell, camera, rng, orientations=_ORIENTATIONS, border_px=_BORDER_PX)
    rows = []
    for number, (pose, uv) in enumerate(zip(base_T_ee, pixels_of(cell, camera, base_T_ee), strict=True)):
        name = f"{number:02d}.png"
        folder.image(name, spot_image(uv, rng, size_px=size, ambient=table, speckle=0.15))
        rows.append({"image": name, "laser_off": "off.png", **_pose(pose)})
    folder.table("spots.csv", rows)
    knocked = cell.seen_by(perturb(cell.cam_T_base, _CAMERA_MOTION))
    fresh, _ = poses_on_plane(knocked, camera, rng, orientations=_FRESH_ORIENTATIONS, border_px=_BORDER_PX)
    seen = pixels_of(knocked, camera, fresh) + rng.normal(0.0, 0.1, (len(fresh), 2))
    folder.table(
        "fresh.csv", [{"u_px": u, "v_px": v, **_pose(pose)} for (u, v), pose in zip(seen.tolist(), fresh, strict=True)]
    )
    folder.truth(
        camera=SECOND_LENS, target=name_of(SECOND_PLATE), base_T_cam=invert(cell.cam_T_base),
        plane={"normal_cam": cell.normal_cam, "distance_m": cell.distance_m},
        laser={"point_ee_m": cell.point_ee_m, "direction_ee": cell.direction_ee},
        fresh_base_T_cam=invert(knocked.cam_T_base), plate=views,
    )  # fmt: skip


_WRITERS: dict[str, tuple[Callable[[_Folder, Rig, int], None], int]] = {
    "plate": (_plate, _FREE_VIEWS + _FINGER_VIEWS),
    "standing": (_standing, _STANDING),
    "robot_world": (_robot_world, _ROBOT_POSES),
    "spots": (_spots, _FREE_VIEWS + _FINGER_VIEWS + 1 + 10 * _ORIENTATIONS),
}
"""What writes a kind, and how many images it writes."""
KINDS = tuple(_WRITERS)


def _pose(base_T_ee: Array) -> dict[str, float]:
    names = ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")
    values = [*base_T_ee[:3, 3].tolist(), *quaternion_xyzw(base_T_ee[:3, :3])]
    return dict(zip(names, values, strict=True))


def _with_gripper(rig: Rig, plate: Plate, seed: int, number: int) -> Image:
    knots = ((0.0, rig.jaw_opening_m),) if rig.gripper.has_jaw else ()
    scenario = Scenario(name="plate", jaw=JawScript(knots=knots))
    backdrop = PlateBackdrop(plate, rig.camera.settings, scenario.sensor.psf_sigma_px)
    own = seed * 100 + number  # independent noise for each image
    return rig.simulator(scenario, own, backdrop).render(0)


def _without_gripper(camera: Camera, plate: Plate, seed: int, number: int) -> Image:
    sensor = SensorModel(RayGrid(camera), Scenario(name="plate"), seed * 100 + number)
    return sensor.expose(plate.light(camera.settings, Sensor().psf_sigma_px), 0, 0.0)


_CONTACT_M = 2e-4
"""Distance from the foremost point within which a point touches the plate."""
_RISE = 0.35
"""Fraction of the rising edge's length: some way up, where the edge is still visible."""


def rough_corners(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float, rng: np.random.Generator, off_px: float
) -> tuple[dict[str, Array], dict[str, Array]]:
    """True pixels (2,) and rough ones, up to ``off_px`` off in u and v, by the names for a gripper without a file:
    ``left_inner_near`` and so on, with the left finger on the left of the image and the near side at the top.
    ValueError unless two fingertips with three or more corners each stand on one plane.
    """
    points = gripper.points_grip_m(jaw_opening_m)
    uv = camera.project(points @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
    touching = points[:, 2] > points[:, 2].max() - _CONTACT_M
    tips = [np.flatnonzero(touching & (gripper.point_finger == k)) for k in range(len(gripper.finger_ids))]
    if len(tips) != 2 or min(map(len, tips)) < 3:
        raise ValueError("gripper: standing on a plate takes two fingertips with three corners or more in one plane")
    out = {}
    for side, tip in zip(("left", "right"), sorted(tips, key=lambda t: float(uv[t, 0].mean())), strict=True):
        near, far = sorted(tip[np.argsort(np.abs(points[tip, 0]))[:2]], key=lambda k: float(uv[k, 1]))
        outer = min(set(tip.tolist()) - {near, far}, key=lambda k: float(np.abs(points[k, 1] - points[near, 1])))
        out[f"{side}_inner_near"], out[f"{side}_inner_far"] = uv[near], uv[far]
        out[f"{side}_outer_near"] = uv[outer]
        foot, top = points[far], points[_above(gripper, far, touching)]
        rise = (cam_T_grip[:3, :3] @ (foot + _RISE * (top - foot)) + cam_T_grip[:3, 3])[None]
        out[f"{side}_rise_far"] = camera.project(rise)[0]
    return out, {name: at + rng.uniform(-off_px, off_px, 2) for name, at in out.items()}


def _above(gripper: Gripper, foot: int, touching: Array) -> int:
    """The other end of the edge that rises from a corner."""
    for a, b in gripper.edge_points.tolist():
        if foot in (a, b) and not touching[b if a == foot else a]:
            return int(b if a == foot else a)
    raise ValueError(f"gripper: no edge rises from {gripper.point_ids[foot]}")
