"""Where every simulated image comes from: a rig, of a camera, its gripper and where that is, and what happens to it.

The simulator gives frame i of a scenario with its truth, for any i in any order; also images and truth as files.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera, LensSettings, PaperLens, make_camera
from gripmon.model.geometry import make_transform
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Frame
from gripmon.simulate import disturbance
from gripmon.simulate.bodies import Bodies, FrameTruth, Hidden
from gripmon.simulate.disturbance import SensorModel
from gripmon.simulate.render import Backdrop, Renderer
from gripmon.simulate.scenario import Scenario
from gripmon.simulate.scene import Scene, SceneState

PAPER_LENS = PaperLens(
    width_px=768, height_px=576, fx_px=962.0, fy_px=962.0, cx_px=383.5, cy_px=287.5, kappa_per_px2=1.9e-7
)
"""That of the self-viewing paper, and of what was measured with others."""


def paper_cam_T_grip(tilt_deg: float = 32.0, tcp_m: tuple[float, float, float] = (0.0004, 0.0013, 0.115)) -> Array:
    """Pose (4, 4) of a gripper tilted about the camera's x axis, as in the paper."""
    c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    return make_transform(np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]), np.array(tcp_m))


@dataclass(frozen=True)
class Rig:
    """A wrist camera, its gripper, and ``cam_T_grip`` (4, 4) before any disturbance."""

    camera: Camera
    gripper: Gripper
    cam_T_grip: Array

    @property
    def jaw_opening_m(self) -> float:
        """Nearly fully open, so that the fingers are near the image's borders and leave a plate visible; nominal for
        a gripper without a jaw.
        """
        low, high = self.gripper.jaw_min_m, self.gripper.jaw_max_m
        return low + 5.0 / 6.0 * (high - low) if self.gripper.has_jaw else self.gripper.jaw_nominal_m

    def simulator(self, scenario: Scenario, seed: int = 0, backdrop: Backdrop | None = None) -> Simulator:
        """The frames of a scenario and their truth: see :class:`Simulator`."""
        return Simulator(self, scenario, seed, backdrop)


def paper_rig(gripper: Gripper, cam_T_grip: Array | None = None, lens: LensSettings = PAPER_LENS) -> Rig:
    """A gripper before the paper's camera, at :func:`paper_cam_T_grip` if no pose is given."""
    return Rig(make_camera(lens), gripper, paper_cam_T_grip() if cam_T_grip is None else cam_T_grip)


class Simulator:
    """A wrist camera that sees its own fingertips.

    Frame i is a pure function of rig, scenario, seed and i.  Not thread-safe.  Raises ValueError if the scenario
    doesn't fit the gripper, or the gripper has no closed convex fingers.  ``backdrop`` replaces the scenario's table,
    for example by a calibration plate.
    """

    def __init__(self, rig: Rig, scenario: Scenario, seed: int = 0, backdrop: Backdrop | None = None) -> None:
        self.rig, self.scenario, self.seed, self._backdrop = rig, scenario, seed, backdrop
        self.camera, self.gripper = rig.camera, rig.gripper
        self.nominal_cam_T_grip = np.array(rig.cam_T_grip, dtype=float)
        self._scene = Scene(rig.camera, rig.gripper, self.nominal_cam_T_grip, scenario, seed)
        self.bodies = Bodies(rig.gripper, scenario, self._scene.view_half[1])

    @property
    def frame_count(self) -> int:
        """Frames in ``scenario.duration_s``; later ones can be rendered, too."""
        return max(round(self.scenario.duration_s * self.scenario.fps), 1)

    def time_s(self, index: int) -> float:
        """Middle of a frame's exposure, relative to the first frame's."""
        if index < 0:
            raise IndexError(f"there is no frame {index}; frames count from 0")
        return index / self.scenario.fps

    def truth(self, index: int) -> FrameTruth:
        """Truth of a frame, without rendering it."""
        time_s = self.time_s(index)
        scenario, state = self.scenario, self.state(index)
        cam_T_grip = state.cam_T_grip
        corners_cam = state.points_grip_m[self.gripper.corner_points] @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
        uv = self.camera.project(corners_cam)
        hidden = self.bodies.hidden_corners(state, corners_cam)
        for k in np.flatnonzero(~self._inside(uv)).tolist():
            hidden[k] = Hidden.OUTSIDE
        return FrameTruth(
            index=index,
            time_s=time_s,
            stamp_ns=self._stamp_ns(index),
            cam_T_grip=cam_T_grip,
            reference_cam_T_grip=state.reference_cam_T_grip,
            tcp_shift_m=cam_T_grip[:3, 3] - state.reference_cam_T_grip[:3, 3],
            jaw_opening_m=state.jaw_opening_m,
            jaw_reported_m=self._reported(index, state.jaw_opening_m),
            corner_ids=self.gripper.corner_ids,
            corner_uv_px=uv,
            hidden=tuple(hidden),
            finger_bend=state.bend,
            events=self._scene.events(time_s),
            exposure=disturbance.exposure(scenario.light, time_s),
            defocus_px=disturbance.defocus_sigma_px(scenario.defocus, time_s),
        )

    def state(self, index: int) -> SceneState:
        """Poses of everything in a frame; the shapes are in ``bodies``."""
        return self._scene.at(self.time_s(index))

    def render(self, index: int) -> NDArray[np.uint8]:
        """Image (height, width) of a frame."""
        return self.expose(self.light(index), index)

    def light(self, index: int) -> NDArray[np.float32]:
        """Light on the sensor (height, width) of a frame in DN at exposure 1, before vignetting, exposure and noise."""
        return self.renderer.render(self.time_s(index))

    def expose(self, light: NDArray[np.float32], index: int) -> NDArray[np.uint8]:
        """Image of a frame from the light on the sensor, which is overwritten: from :meth:`light`, or modified."""
        return self._sensor.expose(light, index, self.time_s(index))

    @functools.cached_property
    def renderer(self) -> Renderer:
        """What draws, made for the first image: truth doesn't need it."""
        nominal = self.nominal_cam_T_grip
        return Renderer(self.camera, self.bodies, self._scene, self.scenario, nominal, self.seed, self._backdrop)

    @functools.cached_property
    def _sensor(self) -> SensorModel:
        return SensorModel(self.renderer.rays, self.scenario, self.seed)

    def frame(self, index: int) -> Frame:
        """A frame as a camera would deliver it, with the jaw opening that the robot reports."""
        opening_m = disturbance.jaw_opening_m(self.scenario.jaw, self.gripper.jaw_nominal_m, self.time_s(index))
        return Frame(
            seq=index,
            stamp_ns=self._stamp_ns(index),
            image=self.render(index),
            jaw_opening_m=self._reported(index, opening_m),
            name=self.scenario.name,
        )

    def _stamp_ns(self, index: int) -> int:
        return self.scenario.start_ns + round(index * 1e9 / self.scenario.fps)

    def _reported(self, index: int, opening_m: float) -> float | None:
        """The robot's report: true opening plus offset and noise, limited to the jaw's range as an encoder's is."""
        jaw = self.scenario.jaw
        if not jaw.reported or not self.gripper.has_jaw:
            return None
        noise_m = float(np.random.default_rng([self.seed, 6, index]).normal(0.0, jaw.reported_noise_m))
        reported_m = opening_m + jaw.reported_offset_m + noise_m
        return min(max(reported_m, self.gripper.jaw_min_m), self.gripper.jaw_max_m)

    def _inside(self, uv_px: Array) -> NDArray[np.bool_]:
        with np.errstate(invalid="ignore"):
            low = (uv_px >= -0.5).all(axis=1)
            return low & (uv_px[:, 0] < self.camera.width_px - 0.5) & (uv_px[:, 1] < self.camera.height_px - 0.5)


PNG_COMPRESSION = 1  # noise doesn't compress; time matters more


def write_sequence(simulator: Simulator, out_dir: Path, progress: Callable[[int, int], None] | None = None) -> int:
    """Write all frames of a scenario into a folder (created if missing); returns their number.

    ``timestamps.csv`` has the columns ``file,stamp_ns,jaw_opening_m`` (the robot's report; empty if there is none),
    ``truth.jsonl`` one line per frame.  ``progress(done, total)`` is called after each frame.  Raises OSError if a file
    can't be written, FileExistsError if the folder already holds a sequence.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    total = simulator.frame_count
    digits = max(len(str(total - 1)), 6)
    # Mode "x": never mix an older sequence with this one.
    stamps_path, truth_path = out_dir / "timestamps.csv", out_dir / "truth.jsonl"
    with stamps_path.open("x", encoding="utf-8") as stamps, truth_path.open("xb") as truths:
        stamps.write("file,stamp_ns,jaw_opening_m\n")
        for index in range(total):
            file = f"{index:0{digits}d}.png"
            image, truth = simulator.render(index), simulator.truth(index)
            if not cv2.imwrite(str(out_dir / file), image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]):
                raise OSError(f"can't write {out_dir / file}")
            opening = "" if truth.jaw_reported_m is None else repr(truth.jaw_reported_m)
            stamps.write(f"{file},{truth.stamp_ns},{opening}\n")
            truths.write(truth.to_json(file) + b"\n")
            if progress is not None:
                progress(index + 1, total)
    return total
