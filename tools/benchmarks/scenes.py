"""Scenes of ``tools/bench accuracy``: a condition's scenario with a drawn gripper, pose, opening, light and background.

Every scene is a pure function of the condition, the seed and the scene's number.
"""

from __future__ import annotations

import sys
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks import drawn
from benchmarks.conditions import Condition, SceneDraft, scenario
from benchmarks.drawn import Place, finger_look, in_view, sensor
from benchmarks.fingers import bevelled, gripper_models, gripper_of, without_finger
from benchmarks.tags import FingerTags
from gripmon.model.camera import Camera, make_camera
from gripmon.model.geometry import exp_rotation, perturb, to_record
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Frame, ReferenceRecord
from gripmon.monitor import MonitorSettings
from gripmon.simulate import PAPER_LENS, FrameTruth, Hidden, Rig, Scenario, Simulator
from gripmon.simulate.scenario import Background, FingerLook, JawScript, Sensor
from gripmon.teach import visibility
from gripmon.teach.measure import teach
from gripmon.teach.views import TeachingImage, TeachingRefused
from gripmon.track.edges import TaughtEdges

MOVED_M, MOVED_RAD = 3e-4, 3e-3
"""By how much the camera has moved since teaching, each axis."""
TEACHING_IMAGES = 4
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
        return own.rig.simulator(fast, own.seed)


def make_scene(condition: Condition, seed: int, number: int, frames: int) -> Scene:
    """Scene ``number`` of a condition."""
    rng = np.random.default_rng([seed, zlib.crc32(condition.name.encode()), number])
    camera = make_camera(PAPER_LENS)
    models = gripper_models()
    model = models[number % len(models)]
    if condition.bevel_m is not None:
        model = bevelled(model, float(rng.uniform(*condition.bevel_m)))
    gripper = gripper_of(model)
    cam_T_grip, opening_m = _placed(rng, camera, gripper)
    look = ordinary_look(rng)
    draft = SceneDraft(rng, frames, opening_m, *look, (gripper.jaw_min_m, gripper.jaw_max_m))
    shown = gripper
    if condition.missing_finger:
        shown = gripper_of(without_finger(model, str(rng.choice(gripper.finger_ids))))
    simulator = Rig(camera, shown, cam_T_grip).simulator(scenario(condition, draft), int(rng.integers(2**31)))
    start, taught = drawn.reference(rng, simulator.truth(0).cam_T_grip), None
    if condition.taught:
        # What is taught holds at the reference by definition, so that is exact, and the camera has moved since.
        start = perturb(cam_T_grip, rng.normal(0.0, [MOVED_M] * 3 + [MOVED_RAD] * 3))
        taught = _taught(Rig(camera, gripper, start), simulator.scenario, rng)
    return Scene(
        camera=camera,
        gripper=gripper,
        start_cam_T_grip=start,
        start_covariance=np.diag(drawn.REFERENCE_SIGMA**2),
        jaw_sigma_m=condition.jaw_sigma_m,
        taught=taught,
        fps=simulator.scenario.fps,
        simulator=simulator,
        judged_s=condition.judged_s,
        frames=frames,
    )


def _taught(rig: Rig, scenario: Scenario, rng: np.random.Generator) -> TaughtEdges | None:
    """What ``gripmon teach`` learns from images at the rig's pose, before other backgrounds and with other openings;
    None if it refuses them.
    """
    nominal_m = scenario.jaw.knots[0][1]
    openings_m = [float(nominal_m + rng.uniform(-2e-3, 2e-3)) for _ in range(TEACHING_IMAGES)]
    images = []
    for opening_m in openings_m:
        still = msgspec.structs.replace(scenario, jaw=JawScript(knots=((0.0, opening_m),)))
        image = rig.simulator(still, int(rng.integers(2**31))).render(0)
        images.append(TeachingImage(image, opening_m, f"{opening_m:.4f}"))
    flat = tuple(np.diag(drawn.REFERENCE_SIGMA**2).ravel().tolist())
    reference = ReferenceRecord("taught", 0, 0, "configuration", to_record(rig.cam_T_grip), flat)
    known = visibility.Rig(rig.camera, rig.gripper, MonitorSettings(jaw_sigma_m=0.0))
    try:
        learnt = teach(known, reference, images)
    except TeachingRefused as refused:
        print(f"accuracy: not taught: {refused}", file=sys.stderr)
        return None
    middle_m = float(np.mean(openings_m))
    return TaughtEdges.of(learnt.edges, rig.gripper, rig.cam_T_grip, middle_m, None, learnt.reference_offset)


def _placed(rng: np.random.Generator, camera: Camera, gripper: Gripper) -> tuple[Array, float]:
    """A pose about the paper's and an opening at which all of the fingertips are in the image, also 10 mm wider."""

    def draw(rng: np.random.Generator) -> Place:
        turn = exp_rotation(np.deg2rad([rng.uniform(27.0, 37.0), rng.uniform(-4.0, 4.0), rng.uniform(-4.0, 4.0)]))
        tcp_m = np.array([rng.uniform(-3e-3, 3e-3), rng.uniform(-3e-3, 4e-3), rng.uniform(0.108, 0.128)])
        opening_m = gripper.jaw_nominal_m + float(rng.uniform(-8e-3, 6e-3))
        widest_m = min(opening_m + 0.01, gripper.jaw_max_m)
        return Place(turn, tcp_m, opening_m, gripper.points_grip_m(widest_m)[gripper.corner_points])

    return in_view(rng, camera, draw)


def ordinary_look(rng: np.random.Generator) -> tuple[Background, FingerLook, Sensor]:
    """An ordinary scene's background, fingers and sensor."""
    background = Background(
        kind=_KINDS[rng.integers(len(_KINDS))],  # type: ignore[arg-type]
        level_dn=float(rng.uniform(60.0, 180.0)),
        distance_m=float(rng.uniform(0.08, 0.25)),
        speed_m_per_s=float(rng.uniform(0.04, 0.1)),
    )
    return background, finger_look(rng), sensor(rng)
