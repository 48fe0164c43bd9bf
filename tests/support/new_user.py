"""What a user of a new gripper has at hand: images of the wrist camera before a calibration plate, of the gripper
standing on it, and of its work; and what is true of them, which only the tests know.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gripmon.model.camera import make_camera
from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.gripper import load_gripper
from gripmon.model.records import Array
from gripmon.model.targets import CircleGrid
from gripmon.simulate import Scenario, Simulator, write_sequence
from gripmon.simulate.scenario import Background, Bump, JawScript, Sensor
from support.plates import Look, pose, render
from support.simulated import BOX_FINGERS, PAPER_LENS, nominal_cam_T_grip

BOARD = CircleGrid(12, 10, 0.008, 0.004)
TARGET = "circles:12x10:0.008:0.004"
OPENING_M = 0.05
VIEWS = 8
STEP_S = 1.5
SHIFT_M = (0.0, 0.9e-3)
FPS = 30.0
SECONDS = 3.0
_BLUR_PX = Sensor().psf_sigma_px
_ROUGH = {
    "left_inner_near": ("L_in_near", None),
    "left_inner_far": ("L_in_far", None),
    "left_outer_near": ("L_out_near", None),
    "left_rise_far": ("L_in_far", "L_in_far_back"),
    "right_inner_near": ("R_in_near", None),
    "right_inner_far": ("R_in_far", None),
    "right_outer_near": ("R_out_near", None),
    "right_rise_far": ("R_in_far", "R_in_far_back"),
}


@dataclass(frozen=True)
class NewUser:
    """Folders ``plate`` (camera), ``standing`` (gripper on the plate) and ``work``: frames, of which
    those after :data:`STEP_S` come from a camera that was knocked; ``cam_T_grip`` (frames, 4, 4) is where it was.
    """

    folder: Path
    cam_T_grip: Array


class _Plate:
    def __init__(self, cam_T_plate: Array) -> None:
        look = Look(supersampling=3, blur_px=_BLUR_PX, noise=0.0)
        self._light = render(PAPER_LENS, cam_T_plate, BOARD, look).astype(np.float32)

    def render(self, cam_T_grip: Array, t_s: float, exposure_s: float) -> np.ndarray:
        return self._light.copy()


def make(folder: Path) -> NewUser:
    """Render everything."""
    make_plates(folder)
    work = _work()
    write_sequence(work, folder / "work")
    return NewUser(folder, np.array([work.truth(k).cam_T_grip for k in range(work.frame_count)]))


def make_plates(folder: Path) -> None:
    """Render the plate, and the gripper standing on it."""
    for name in ("plate", "standing"):
        (folder / name).mkdir(parents=True)
    rng = np.random.default_rng(5)
    for number in range(VIEWS):
        way = 2.0 * np.pi * number / VIEWS
        tilt = 0.5 * np.array([np.cos(way), np.sin(way)])
        middle = np.array([*rng.uniform(-0.008, 0.008, 2), rng.uniform(0.13, 0.17)])
        cam_T_plate = pose(BOARD, middle, tilt, float(rng.uniform(-np.pi, np.pi)))
        cv2.imwrite(str(folder / "plate" / f"{number}.png"), _simulator(_Plate(cam_T_plate), number).render(0))
    for number, turn in enumerate((0.3, 1.4)):
        middle = np.array([*rng.uniform(-0.004, 0.004, 2), 0.0])
        rotation = exp_rotation(np.array([0.0, 0.0, turn]))
        size = np.array([BOARD.columns - 1.0, BOARD.rows - 1.0, 0.0]) * BOARD.spacing_m
        grip_T_plate = make_transform(rotation, middle - rotation @ (0.5 * size))
        simulator = _simulator(_Plate(nominal_cam_T_grip() @ grip_T_plate), 20 + number)
        cv2.imwrite(str(folder / "standing" / f"{number}.png"), simulator.render(0))


def corners_px(rng: np.random.Generator, off_px: float) -> dict[str, Array]:
    """Where somebody puts the corners that ``gripmon calibrate plane --infer`` begins with."""
    gripper = load_gripper(BOX_FINGERS)
    points, cam_T_grip = gripper.points_grip_m(OPENING_M), nominal_cam_T_grip()
    out = {}
    for name, (first, second) in _ROUGH.items():
        place = points[gripper.point_ids.index(first)]
        if second is not None:
            place = place + 0.35 * (points[gripper.point_ids.index(second)] - place)
        uv = make_camera(PAPER_LENS).project((cam_T_grip[:3, :3] @ place + cam_T_grip[:3, 3])[None])[0]
        out[name] = uv + rng.uniform(-off_px, off_px, 2)
    return out


def _simulator(backdrop: _Plate, seed: int) -> Simulator:
    scenario = Scenario(name="plate", jaw=JawScript(knots=((0.0, OPENING_M),)))
    gripper = load_gripper(BOX_FINGERS)
    return Simulator(make_camera(PAPER_LENS), gripper, nominal_cam_T_grip(), scenario, seed, backdrop)


def _work() -> Simulator:
    """The robot wanders over a table; then something hits the camera."""
    scenario = Scenario(
        name="work",
        duration_s=SECONDS,
        fps=FPS,
        jaw=JawScript(knots=((0.0, OPENING_M),)),
        background=Background(kind="blobs"),
        mount=(Bump(tcp_shift_m=SHIFT_M, at_s=STEP_S),),
    )
    gripper = load_gripper(BOX_FINGERS)
    return Simulator(make_camera(PAPER_LENS), gripper, nominal_cam_T_grip(), scenario, 7)
