"""Grippers with bevelled edges, seen by a model without them, and what teaching makes of their images."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from gripmon.model.camera import make_camera
from gripmon.model.geometry import to_record
from gripmon.model.records import Image, ReferenceRecord
from gripmon.monitor import MonitorSettings
from gripmon.simulate import Scenario, paper_rig
from gripmon.simulate.scenario import Background, JawScript
from gripmon.teach.measure import Taught, teach
from gripmon.teach.views import TeachingImage
from gripmon.teach.visibility import Rig
from gripmon.track.edges import FingertipMeter, Measurement, MeasurementSettings, TaughtEdges
from support.meters import JAW_SIGMA_M, NARROW, USUAL_SHARE, box_gripper, difference
from support.simulated import PAPER_LENS, bevelled, nominal_cam_T_grip, plain_scenario

CAMERA = make_camera(PAPER_LENS)
RIG = Rig(CAMERA, box_gripper(), MonitorSettings(jaw_sigma_m=JAW_SIGMA_M))
OPENING_M = 0.034
TABLE_DN = 180.0


def table(level_dn: float) -> Background:
    return Background(kind="plain", contrast=0.0, level_dn=level_dn, boxes=0, cables=0, motion="still")


def scene(level_dn: float = TABLE_DN, opening_m: float = OPENING_M) -> Scenario:
    """Even fingers before an even table."""
    return plain_scenario(background=table(level_dn), jaw=JawScript(knots=((0.0, opening_m),)))


@lru_cache(maxsize=64)
def _image(width_m: float, scenario: Scenario, pose_bytes: bytes) -> Image:
    pose = np.frombuffer(pose_bytes).reshape(4, 4)
    image = paper_rig(bevelled(width_m), pose).simulator(scenario, 1).render(0)
    image.flags.writeable = False
    return image


def image_of(width_m: float, scenario: Scenario | None = None, cam_T_grip: np.ndarray | None = None) -> Image:
    """A picture of fingers with bevels of that width."""
    pose = nominal_cam_T_grip() if cam_T_grip is None else cam_T_grip
    return _image(width_m, scenario or scene(), np.ascontiguousarray(pose).tobytes())


def reference(
    cam_T_grip: np.ndarray | None = None, position_sigma_m: float = 2e-4, rotation_sigma_rad: float = 2e-3
) -> ReferenceRecord:
    pose = nominal_cam_T_grip() if cam_T_grip is None else cam_T_grip
    variances = [position_sigma_m**2] * 3 + [rotation_sigma_rad**2] * 3
    covariance = tuple(np.diag(variances).ravel().tolist())
    return ReferenceRecord("taught-at", 0, 0, "test", to_record(pose), covariance)


def taught_from(*images: Image, using: ReferenceRecord | None = None, opening_m: float = OPENING_M) -> Taught:
    """The sharp model taught."""
    frames = [TeachingImage(image, opening_m, f"{n}.png") for n, image in enumerate(images)]
    return teach(RIG, using or reference(), frames)


def arrays(taught: Taught, cam_T_grip: np.ndarray | None = None) -> TaughtEdges:
    pose = nominal_cam_T_grip() if cam_T_grip is None else cam_T_grip
    return TaughtEdges.of(taught.edges, box_gripper(), pose, OPENING_M, None, taught.reference_offset)


def measured(
    image: Image, taught: TaughtEdges | None, cam_T_grip: np.ndarray, opening_m: float = OPENING_M
) -> Measurement:
    """The sharp model, with what was taught or without, on an image."""
    using = FingertipMeter(CAMERA, box_gripper(), MeasurementSettings(), JAW_SIGMA_M, taught)
    return using.measure(image, cam_T_grip, opening_m, USUAL_SHARE, NARROW)


def error(found: Measurement, cam_T_grip: np.ndarray) -> np.ndarray:
    """(6,) from the truth to what was found."""
    return difference(cam_T_grip, found.cam_T_grip)
