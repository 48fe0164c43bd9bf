"""Scenes of ``tools/bench accuracy``: a condition's scenario with a drawn gripper, pose, opening, light and background.

Every scene is a pure function of the condition, the seed and the scene's number.
"""

from __future__ import annotations

import sys
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import msgspec
import numpy as np
import yaml
from numpy.typing import NDArray

from benchmarks.conditions import Condition, Draw, scenario
from benchmarks.machine import ROOT
from benchmarks.tags import FingerTags
from gripmon.model.camera import Camera, PaperLens, make_camera
from gripmon.model.geometry import exp_rotation, make_transform, perturb, to_record
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.model.records import Array, Frame, ReferenceRecord
from gripmon.monitor import MonitorSettings
from gripmon.simulate import FrameTruth, Hidden, Scenario, Simulator
from gripmon.simulate.scenario import Background, FingerLook, JawScript, Sensor
from gripmon.teach.measure import teach
from gripmon.teach.views import TeachingImage, TeachingRefused
from gripmon.teach.visibility import Rig
from gripmon.track.edges import TaughtEdges

CAMERA = PaperLens(
    width_px=768, height_px=576, fx_px=962.0, fy_px=962.0, cx_px=383.5, cy_px=287.5, kappa_per_px2=1.9e-7
)
"""That of the self-viewing paper, and of what was measured with others."""

START_SIGMA_M, START_SIGMA_RAD = 1e-4, 1e-3
"""By how much a scene's reference is wrong, per axis; the monitor knows this."""
MOVED_M, MOVED_RAD = 3e-4, 3e-3
"""By how much the camera has moved since teaching, each axis."""
TEACHING_IMAGES = 4
_BORDER_PX = 14.0
_MOVES_M = 1e-5
"""Tags that move further than this within the exposure are printed smeared."""
_KINDS = ("blobs", "speckle", "stripes", "printed")


@dataclass(frozen=True)
class Shot:
    """A frame with its truth; ``judged``: its error counts."""

    frame: Frame
    cam_T_grip: Array
    jaw_opening_m: float
    judged: bool


@dataclass(frozen=True)
class Sequence(ABC):
    """What a monitor and its peers look at: frames with truth, and what they may know before the first.

    ``jaw_sigma_m``: the monitor's setting for the reported opening, None for the default; ``taught``
    what it was taught about the gripper's edges.
    """

    camera: Camera
    gripper: Gripper
    start_cam_T_grip: Array
    start_covariance: Array
    jaw_sigma_m: float | None
    taught: TaughtEdges | None
    fps: float

    @abstractmethod
    def shots(self) -> Iterator[Shot]:
        """All frames in order."""

    @abstractmethod
    def tagged(self, index: int, shot: Shot) -> NDArray[np.uint8]:
        """The image of a frame as it would be with a tag on each finger."""


@dataclass(frozen=True)
class Scene(Sequence):
    """One run of a condition."""

    simulator: Simulator
    judged_s: float
    frames: int

    def shots(self) -> Iterator[Shot]:
        """All frames; the first, in which the monitor acquires, is not judged."""
        for index in range(self.frames):
            truth = self.simulator.truth(index)
            judged = index > 0 and truth.time_s >= self.judged_s
            yield Shot(self.simulator.frame(index), truth.cam_T_grip, truth.jaw_opening_m, judged)

    def tagged(self, index: int, shot: Shot) -> NDArray[np.uint8]:
        """Printed into the light on the sensor, so that they are as smeared, blurred and noisy as the rest.  Tags on
        fingers of which something covers a corner are left out.
        """
        simulator, truth = self.simulator, self.simulator.truth(index)
        covered = {name[0] for name, why in zip(truth.corner_ids, truth.hidden, strict=True) if why is Hidden.COVER}
        numbers = [number for number, side in enumerate("LR") if side not in covered]
        light, psf_px = simulator.light(index), simulator.scenario.sensor.psf_sigma_px
        total = np.zeros_like(light)
        for moment, share in self._moments(truth):
            pose, jaw_m = moment.cam_T_grip, moment.jaw_opening_m
            total += np.float32(share) * self._tags.paint(light, self.camera, pose, jaw_m, psf_px, numbers)
        return simulator.expose(total, index)

    def _moments(self, truth: FrameTruth) -> list[tuple[FrameTruth, float]]:
        """Moments of the exposure and their shares: the middles of its thirds; one if nothing moves meanwhile."""
        third_ms = 1e3 / 3.0 * self.simulator.scenario.sensor.exposure_time_s
        around = [self._by_ms.truth(max(round(1e3 * truth.time_s + k * third_ms), 0)) for k in (-1, 0, 1)]
        ways_m = [np.abs(m.cam_T_grip[:3, 3] - truth.cam_T_grip[:3, 3]).max() for m in around]
        ways_m += [abs(m.jaw_opening_m - truth.jaw_opening_m) for m in around]
        return [(truth, 1.0)] if max(ways_m) < _MOVES_M else [(moment, 1.0 / 3.0) for moment in around]

    @cached_property
    def _tags(self) -> FingerTags:
        return FingerTags(self.simulator.gripper)

    @cached_property
    def _by_ms(self) -> Simulator:
        """The same scene with a frame each millisecond; only its truth is asked for."""
        own = self.simulator
        fast = msgspec.structs.replace(own.scenario, fps=1e3)
        return Simulator(own.camera, own.gripper, own.nominal_cam_T_grip, fast, own.seed)


def make_scene(condition: Condition, seed: int, number: int, frames: int) -> Scene:
    """Scene ``number`` of a condition."""
    rng = np.random.default_rng([seed, zlib.crc32(condition.name.encode()), number])
    camera = make_camera(CAMERA)
    models = gripper_models()
    model = models[number % len(models)]
    if condition.bevel_m is not None:
        model = bevelled(model, float(rng.uniform(*condition.bevel_m)))
    gripper = Gripper(msgspec.convert(model, GripperModel))
    cam_T_grip, opening_m = _placed(rng, camera, gripper)
    look = _look(rng)
    draw = Draw(rng, frames, opening_m, (gripper.jaw_min_m, gripper.jaw_max_m), *look)
    shown = gripper
    if condition.missing_finger:
        shown = Gripper(msgspec.convert(without_finger(model, str(rng.choice(gripper.finger_ids))), GripperModel))
    simulator = Simulator(camera, shown, cam_T_grip, scenario(condition, draw), seed=int(rng.integers(2**31)))
    sigma = np.array([START_SIGMA_M] * 3 + [START_SIGMA_RAD] * 3)
    start, taught = perturb(simulator.truth(0).cam_T_grip, rng.normal(0.0, sigma)), None
    if condition.taught:
        # What is taught holds at the reference by definition, so that is exact, and the camera has moved since.
        start = perturb(cam_T_grip, rng.normal(0.0, [MOVED_M] * 3 + [MOVED_RAD] * 3))
        taught = _taught(camera, gripper, start, np.diag(sigma**2), simulator.scenario, rng)
    return Scene(
        camera=camera,
        gripper=gripper,
        start_cam_T_grip=start,
        start_covariance=np.diag(sigma**2),
        jaw_sigma_m=condition.jaw_sigma_m,
        taught=taught,
        fps=simulator.scenario.fps,
        simulator=simulator,
        judged_s=condition.judged_s,
        frames=frames,
    )


def _taught(
    camera: Camera,
    gripper: Gripper,
    cam_T_grip: Array,
    covariance: Array,
    scenario: Scenario,
    rng: np.random.Generator,
) -> TaughtEdges | None:
    """What ``gripmon teach`` learns from images at a pose, before other backgrounds and with other openings; None if it
    refuses them.
    """
    nominal_m = scenario.jaw.knots[0][1]
    openings_m = [float(nominal_m + rng.uniform(-2e-3, 2e-3)) for _ in range(TEACHING_IMAGES)]
    images = []
    for opening_m in openings_m:
        still = msgspec.structs.replace(scenario, jaw=JawScript(knots=((0.0, opening_m),)))
        image = Simulator(camera, gripper, cam_T_grip, still, int(rng.integers(2**31))).render(0)
        images.append(TeachingImage(image, opening_m, f"{opening_m:.4f}"))
    flat = tuple(covariance.ravel().tolist())
    reference = ReferenceRecord("taught", 0, 0, "configuration", to_record(cam_T_grip), flat)
    try:
        learnt = teach(Rig(camera, gripper, MonitorSettings(jaw_sigma_m=0.0)), reference, images)
    except TeachingRefused as refused:
        print(f"accuracy: not taught: {refused}", file=sys.stderr)
        return None
    return TaughtEdges.of(learnt.edges, gripper, cam_T_grip, float(np.mean(openings_m)), None, learnt.reference_offset)


def _placed(rng: np.random.Generator, camera: Camera, gripper: Gripper) -> tuple[Array, float]:
    """A pose about the paper's and an opening at which all of the fingertips are in the image, also 10 mm wider."""
    for _ in range(1000):
        turn = exp_rotation(np.deg2rad([rng.uniform(27.0, 37.0), rng.uniform(-4.0, 4.0), rng.uniform(-4.0, 4.0)]))
        tcp_m = np.array([rng.uniform(-3e-3, 3e-3), rng.uniform(-3e-3, 4e-3), rng.uniform(0.108, 0.128)])
        cam_T_grip = make_transform(turn, tcp_m)
        opening_m = gripper.jaw_nominal_m + float(rng.uniform(-8e-3, 6e-3))
        widest_m = min(opening_m + 0.01, gripper.jaw_max_m)
        corners = gripper.points_grip_m(widest_m)[gripper.corner_points]
        uv = camera.project(corners @ turn.T + tcp_m)
        limit = np.array([camera.width_px, camera.height_px]) - 1.0 - _BORDER_PX
        if (uv > _BORDER_PX).all() and (uv < limit).all():
            return cam_T_grip, opening_m
    raise ValueError(f"gripper {gripper.name} does not fit into the image")


def _look(rng: np.random.Generator) -> tuple[Background, FingerLook, Sensor]:
    """An ordinary scene's background, fingers and sensor."""
    background = Background(
        kind=_KINDS[rng.integers(len(_KINDS))],  # type: ignore[arg-type]
        level_dn=float(rng.uniform(60.0, 180.0)),
        distance_m=float(rng.uniform(0.08, 0.25)),
        speed_m_per_s=float(rng.uniform(0.04, 0.1)),
    )
    fingers = FingerLook(
        level_dn=float(rng.uniform(70.0, 150.0)),
        ambient=float(rng.uniform(0.25, 0.5)),
        lamp_cam=(float(rng.uniform(-0.6, 0.6)), float(rng.uniform(-0.8, 0.2)), -0.75),
        texture=float(rng.uniform(0.05, 0.2)),
    )
    return background, fingers, Sensor(psf_sigma_px=float(rng.uniform(0.5, 0.8)))


@cache
def gripper_models() -> tuple[dict[str, Any], ...]:
    """Models of the grippers that scenes take in turn."""
    folder = ROOT / "configs" / "grippers"
    box, arc = (
        yaml.safe_load((folder / f"{name}.yaml").read_text(encoding="utf-8"))
        for name in ("two_box_fingers", "adaptive_arc_fingers")
    )
    return box, tapered_gripper(box), arc


def tapered_gripper(box: dict[str, Any]) -> dict[str, Any]:
    """Fingers of 7 x 11 mm at the tip and 12 x 18 mm at the root, 34 mm long, sharp; names as in the box fingers."""
    nominal_m = 0.026
    points = {}
    for name, point in box["points"].items():
        back = name.endswith("_back")
        side = -1.0 if point["finger"] == "left" else 1.0
        x = side * (0.5 * nominal_m + (0.0 if "_in_" in name else 0.012 if back else 0.007))
        y = (-1.0 if "_near" in name else 1.0) * (0.009 if back else 0.0055)
        points[name] = {**point, "xyz_m": [x, y, -0.034 if back else 0.0]}
    edges = {name: {key: end for key, end in edge.items() if key != "bevel_m"} for name, edge in box["edges"].items()}
    jaw = {"nominal_m": nominal_m, "min_m": 0.0, "max_m": 0.05}
    return {**box, "name": "tapered_fingers", "jaw": jaw, "points": points, "edges": edges}


def bevelled(model: dict[str, Any], width_m: float) -> dict[str, Any]:
    """The model with a bevel on every edge."""
    edges = {name: {**edge, "bevel_m": width_m} for name, edge in model["edges"].items()}
    return {**model, "edges": edges}


def without_finger(model: dict[str, Any], finger: str) -> dict[str, Any]:
    """The model without one of its fingers."""
    points = {name: point for name, point in model["points"].items() if point["finger"] != finger}
    return {
        **model,
        "fingers": {name: motion for name, motion in model["fingers"].items() if name != finger},
        "points": points,
        "edges": {name: edge for name, edge in model["edges"].items() if edge["from"] in points},
        "faces": [face for face in model["faces"] if face["finger"] != finger],
    }
