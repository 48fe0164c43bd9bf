"""Grippers from CAD, tracked in pictures of the meshes that they were made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.meshes import MeshCamera, curved_fingers, finger_mesh, rounded_fingers, wandering, write_meshes
from support.meters import difference
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.watched import pose_of, reference_of

from gripmon.model.camera import make_camera
from gripmon.model.records import Frame, Origin, Verdict
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.teach.cad import gripper_from_cad

FRAMES = 45


def sharp_boxes() -> list[trimesh.Trimesh]:
    profile = np.array([[0.008, -0.04], [0.008, 0.0], [-0.008, 0.0], [-0.008, -0.04]])
    return [finger_mesh(profile, x) for x in ((-0.027, -0.017), (0.017, 0.027))]


SHAPES = {
    "box": (sharp_boxes, (15e-6, 60e-6)),
    "2 mm": (lambda: rounded_fingers(0.002), (45e-6, 120e-6)),
    "4 mm": (lambda: rounded_fingers(0.004), (45e-6, 120e-6)),
    "8 mm": (lambda: rounded_fingers(0.008), (45e-6, 120e-6)),
    "curved": (curved_fingers, (15e-6, 60e-6)),
}
"""Meshes by name, and what 95 % of the frames' errors keep across and along the optical axis, m."""


@pytest.mark.parametrize("shape", SHAPES)
def test_what_was_made_from_a_mesh_tracks_it(shape: str, tmp_path: Path):
    """The camera wanders by 0.2 mm and 1 mrad, the jaws by 1 mm, and each frame has another background."""
    meshes, (across_m, along_m) = SHAPES[shape][0](), SHAPES[shape][1]
    camera, pose = make_camera(PAPER_LENS), nominal_cam_T_grip()
    view = {"camera": camera, "cam_T_grip": pose, "length_m": 0.035}
    paths = write_meshes(meshes, tmp_path)
    gripper = gripper_from_cad(paths, unit="mm", jaw_range_m=(0.0, 0.06), **view).gripper
    monitor = Monitor(camera, gripper, MonitorSettings(), reference_of(pose))
    pictures = MeshCamera(camera, meshes)
    errors, misleading = [], 0
    for k in range(FRAMES):
        truth = wandering(pose, k / FRAMES, 2e-4, 1e-3)
        opened_m = 0.001 * np.sin(2.0 * np.pi * k / FRAMES)
        image = pictures.picture(truth, [np.array([side * opened_m / 2.0, 0.0, 0.0]) for side in (-1.0, 1.0)])
        stamp_ns, opening_m = int(k / 30 * 1e9), gripper.jaw_nominal_m + opened_m
        record = monitor.process(Frame(seq=k, stamp_ns=stamp_ns, image=image, jaw_opening_m=opening_m))
        if record.cam_T_grip is not None and record.source is not Origin.HELD:
            errors.append(difference(pose_of(record.cam_T_grip), truth))
            if record.verdict is Verdict.VALID:
                misleading += bool(np.linalg.norm(errors[-1][:3]) > 1e-3)
    assert len(errors) >= 0.98 * FRAMES and misleading == 0
    off = np.abs(np.array(errors))
    assert np.quantile(np.linalg.norm(off[:, :2], axis=1), 0.95) < across_m
    assert np.quantile(off[:, 2], 0.95) < along_m
