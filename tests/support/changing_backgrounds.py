"""Images of a gripper before changing backgrounds, and its true outline: half of the simulator's own coverage."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import make_camera
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.model.records import Array
from gripmon.simulate import Scenario, Simulator, paper_rig
from gripmon.simulate.scenario import Background, FingerLook, JawScript, Light, Sensor
from gripmon.teach.from_images import gripper_from_images
from gripmon.teach.straight_pieces import Chain
from support.kept import kept
from support.simulated import BOX_FINGERS, PAPER_LENS

CAMERA = make_camera(PAPER_LENS)

made_of = partial(gripper_from_images, response="linear")
"""Linear, as simulated images are: a quarter of the time goes to finding that out, which the first results of two test
files and those of commands are asked for, and ``tests/test_response.py``.
"""


def moving_robot(
    seed: int,
    kind: str = "blobs",
    *,
    gripper: Gripper | None = None,
    cam_T_grip: Array | None = None,
    opening_m: float | None = None,
    fingers: FingerLook | None = None,
    sensor: Sensor | None = None,
    light: Light | None = None,
    motion: str = "wander",
) -> Simulator:
    """A frame a second while the robot moves by some 10 cm."""
    scenario = Scenario(
        name="moving",
        fps=1.0,
        duration_s=30.0,
        background=Background(kind=kind, speed_m_per_s=0.1, motion=motion),  # type: ignore[arg-type]
        fingers=fingers or FingerLook(),
        sensor=sensor or Sensor(),
        light=light or Light(),
        jaw=JawScript(knots=() if opening_m is None else ((0.0, opening_m),)),
    )
    return paper_rig(gripper or read_gripper(BOX_FINGERS), cam_T_grip).simulator(scenario, seed)


def images_of(simulator: Simulator, count: int = 30) -> list[NDArray[np.uint8]]:
    nominal_T = simulator.nominal_cam_T_grip
    return _rendered(simulator.gripper.model, nominal_T, simulator.scenario, simulator.seed, count)


@kept
def _rendered(
    model: GripperModel, nominal_cam_T_grip: Array, scenario: Scenario, seed: int, count: int
) -> list[NDArray[np.uint8]]:
    simulator = paper_rig(Gripper(model), nominal_cam_T_grip).simulator(scenario, seed)
    return [simulator.render(k) for k in range(count)]


def coverage(simulator: Simulator) -> NDArray[np.float32]:
    """Part of each pixel that the gripper hides, as blurred as the lens makes it."""
    passes = np.ones((simulator.camera.height_px, simulator.camera.width_px), np.float32)
    for layer in simulator.renderer._body_layers(simulator._scene.at(0.0)):
        passes[layer.window] *= layer.passes
    return 1.0 - passes


def beside_truth_px(chains: list[Chain], covered: NDArray[np.float32]) -> Array:
    """How far the outline lies beside the true silhouette, at a point each pixel of all pieces of 8 px and more."""
    out = []
    for chain in chains:
        for a, b in chain.pieces:
            ends = CAMERA.undistort(chain.uv_px[[a, b]])
            length = float(np.linalg.norm(chain.uv_px[b] - chain.uv_px[a]))
            if length < 8.0:
                continue
            share = np.linspace(2.0, length - 2.0, max(int(length) - 3, 4))[:, None] / length
            out.append(crossing_px(CAMERA.distort(ends[0] + share * (ends[1] - ends[0])), covered))
    return np.concatenate(out)


def crossing_px(uv_px: Array, covered: NDArray[np.float32]) -> Array:
    """How far from each point (n, 2) of a line the true silhouette crosses the line's normal; 6 where it doesn't."""
    s = np.arange(-6.0, 6.01, 0.1)
    way = np.gradient(uv_px, axis=0)
    way /= np.linalg.norm(way, axis=1)[:, None]
    normal = np.column_stack([-way[:, 1], way[:, 0]])
    maps = [(uv_px[:, k, None] + normal[:, k, None] * s).astype(np.float32) for k in (0, 1)]
    out = []
    for row in cv2.remap(covered, maps[0], maps[1], cv2.INTER_CUBIC) - 0.5:
        at = np.flatnonzero(np.sign(row[:-1]) != np.sign(row[1:]))
        crossing = s[at] + 0.1 * row[at] / (row[at] - row[at + 1])
        out.append(float(np.abs(crossing).min()) if len(at) else 6.0)
    return np.array(out)
