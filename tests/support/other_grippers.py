"""Images of grippers that no plate gives: with rounded tips before changing backgrounds, and of meshes; at work the
camera is knocked in the middle.  As a user has them, in folders; and what is true of them, which only tests read.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon.io.sources.files import TIMESTAMPS_NAME
from gripmon.model.geometry import to_record
from gripmon.model.records import Array
from gripmon.simulate import Scenario, paper_rig
from gripmon.simulate.scenario import Background, Creep
from support.changing_backgrounds import CAMERA, images_of, moving_robot
from support.simulated import nominal_cam_T_grip

FRAMES, FPS, STEP = 60, 15.0, 30
"""At work: the knock comes with frame :data:`STEP`."""
KNOCK_M = np.array([0.0002, 0.0009, 0.0])


def write_images(folder: Path, images: Sequence[NDArray[np.uint8]]) -> None:
    """With the time of each."""
    folder.mkdir()
    rows = ["file,stamp_ns"]
    for k, image in enumerate(images):
        assert cv2.imwrite(str(folder / f"{k:03d}.png"), image)
        rows.append(f"{k:03d}.png,{round(1e9 * k / FPS)}")
    (folder / TIMESTAMPS_NAME).write_text("\n".join(rows) + "\n")


def rounded_tips(folder: Path) -> Array:
    """``free``: thirty images, each before another background, for a gripper from images; ``work``.  Fingers of 12 mm,
    rounded by 4 mm.  True ``cam_T_grip`` (frames, 4, 4) at work.
    """
    from benchmarks.rounded import rounded_solids

    solids = rounded_solids(0.012, 0.004)
    write_images(folder / "free", images_of(moving_robot(311, gripper=solids)))
    knock = Creep(start_s=STEP / FPS, time_s=0.01, tcp_shift_m=(float(KNOCK_M[0]), float(KNOCK_M[1])))
    scenario = Scenario(
        name="work", duration_s=FRAMES / FPS, fps=FPS, mount=(knock,), background=Background(kind="printed")
    )
    simulator = paper_rig(solids).simulator(scenario, 77)
    write_images(folder / "work", images_of(simulator, FRAMES))
    return np.array([simulator.truth(k).cam_T_grip for k in range(FRAMES)])


def curved_meshes(folder: Path) -> Array:
    """Fingers that curve, as sharp as their CAD: :func:`_at_work`."""
    from benchmarks.meshes import curved_fingers

    return _at_work(folder, curved_fingers(), curved_fingers())


def _at_work(folder: Path, drawn: Sequence[Any], real: Sequence[Any]) -> Array:
    """``finger0.stl`` and ``finger1.stl``, mm; ``robot.yaml``, the robot's hand/eye calibration; ``work``, in which the
    camera trembles by 0.05 mm.  True ``cam_T_grip`` (frames, 4, 4) at work.
    """
    from benchmarks.meshes import MeshCamera, wandering, write_meshes

    nominal = nominal_cam_T_grip()
    write_meshes(drawn, folder)
    flange_T_cam = np.eye(4)
    flange_T_cam[:3, :3] = Rotation.from_euler("xz", [-32.0, 4.0], degrees=True).as_matrix()
    flange_T_cam[:3, 3] = [0.01, 0.08, 0.02]
    known = {"flange_T_cam": flange_T_cam, "flange_T_tcp": flange_T_cam @ nominal}
    values = {name: to_record(pose) for name, pose in known.items()}
    written = {
        name: {"translation_m": list(pose.translation_m), "rotation_xyzw": list(pose.rotation_xyzw)}
        for name, pose in values.items()
    }
    exact = {"position_sigma_m": 5e-5, "rotation_sigma_rad": 2e-4}
    (folder / "robot.yaml").write_text(yaml.safe_dump({**written, **exact}))
    truth = []
    for k in range(FRAMES):
        pose = wandering(nominal, k / FRAMES, 5e-5, 2e-4)
        pose[:3, 3] += KNOCK_M * (k >= STEP)
        truth.append(pose)
    camera = MeshCamera(CAMERA, real)
    write_images(folder / "work", [camera.picture(pose) for pose in truth])
    return np.array(truth)
