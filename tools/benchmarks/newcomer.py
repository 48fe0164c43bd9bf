"""A newcomer's own gripper (tapered, with pads): its file from images, taught, and a working day in 180 frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import msgspec
import numpy as np
import yaml

import gripmon
from benchmarks import padded
from benchmarks.integrity_practice import GRASPED_M, PRACTICE
from benchmarks.integrity_runs import Truth
from benchmarks.integrity_scenes import IntegrityScene, make_integrity_scene
from benchmarks.real_images import answered, camera_file
from benchmarks.shapes import Tally, Tracked
from gripmon.calibrate.documents import CalibratedGripper, HandEyeCalibration, HandEyeResiduals
from gripmon.daemon.calibrations import write_document
from gripmon.model.geometry import from_record, perturb, to_record
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array
from gripmon.simulate import Scenario
from gripmon.simulate.scenario import JawScript, Light

FRAMES, STILLS = 180, 15
"""Of the day, and of each opening that the file is made from."""
PLATE = np.array([1e-4] * 3 + [1e-3] * 3)
"""Standard deviations of the reference that a plate gives (m, rad)."""
_SCENE = "pads at work"


def day(seed: int, number: int, folder: Path, frames: int = FRAMES, stills: int = STILLS) -> Tracked:
    """Images, ``gripper from-images``, ``teach``, then the scene with lamp, grasp and a knock of 2 mm; or why there is
    no file.
    """
    (condition,) = (each for each in PRACTICE if each.name == _SCENE)
    scene = make_integrity_scene(condition, seed, number, frames)
    _take_images(scene, seed, stills, folder)
    config = _configuration(folder)
    images = folder / "images"
    for words in (
        (
            "gripper", "from-images", images, "--camera", folder / "camera.yaml", "--reference", folder / "plate.yaml",
            "--out", folder / "gripper.yaml", "--reference-out", folder / "reference.yaml",
        ),
        ("teach", images, "--config", config, "--out", folder / "taught.yaml", "--into-config"),
    ):  # fmt: skip
        answer = answered(*words, without=(folder,))
        if answer.code != 0:
            # Without what was left out image by image.
            why = answer.words[-1].partition("; and left out before")[0] if answer.words else "without a word"
            return Tracked(frames - 1, 0, 0, 0, float("nan"), f"{words[0]}: exit code {answer.code}: {why}")
    return _watched(scene, gripmon.load_config(config, check_source=False))


def _take_images(scene: IntegrityScene, seed: int, stills: int, folder: Path) -> None:
    """Of the gripper at rest at both openings that it works at, each before another background; and what a plate says
    of its place.
    """
    shown, pose = scene.simulator, scene.simulator.nominal_cam_T_grip
    images = folder / "images"
    images.mkdir(parents=True)
    lines = ["file,stamp_ns,jaw_opening_m"]
    for part, opening_m in enumerate((float(shown.frame(0).jaw_opening_m or 0.0), GRASPED_M)):
        still = shown.rig.simulator(_at_rest(shown.scenario, opening_m), seed + part)
        for k in range(stills):
            name = f"{part}_{k:02d}.png"
            cv2.imwrite(str(images / name), still.render(k))
            lines.append(f"{name},{1_000_000_000 * (part * stills + k)},{opening_m:.6f}")
    (images / "timestamps.csv").write_text("\n".join(lines) + "\n")
    (folder / "camera.yaml").write_text(camera_file(msgspec.to_builtins(padded.LENS)))
    off = np.random.default_rng([seed, scene.frames]).normal(0.0, PLATE)
    write_document(_plate(perturb(pose, off)), folder / "plate.yaml")


def _at_rest(scenario: Scenario, opening_m: float) -> Scenario:
    """The scene's gripper, camera and lamp, an image a second, and nothing that happens in it."""
    return msgspec.structs.replace(
        scenario,
        fps=1.0,
        background=msgspec.structs.replace(scenario.background, speed_m_per_s=0.1, motion="wander"),
        fingers=msgspec.structs.replace(scenario.fingers, lamp_changes=()),
        jaw=JawScript(knots=((0.0, opening_m),)),
        mount=(),
        grasped=None,
        light=Light(),
    )


def _plate(cam_T_grip: Array) -> HandEyeCalibration:
    return HandEyeCalibration(
        camera=padded.LENS,
        gripper=CalibratedGripper(name="unknown", sha256="0" * 64),
        cam_T_grip=to_record(cam_T_grip),
        covariance=tuple(np.diag(PLATE**2).ravel().tolist()),
        residuals=HandEyeResiduals(rms_m=0.0, rms_px=0.0, corners=4, images=1),
        provenance=Provenance(gripmon="", time="", command="a plate's standard deviations"),
    )


def _configuration(folder: Path) -> Path:
    values = {
        "robot": "robot",
        "camera_name": "wrist",
        "camera": "camera.yaml",
        "gripper": "gripper.yaml",
        "reference": "reference.yaml",
        "jaw": {"source": "frames"},
        "source": {"kind": "folder", "path": "images"},
        "monitor": {"corners": {"edges": {"response": "srgb"}}},
    }
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


def _watched(scene: IntegrityScene, config: gripmon.Config) -> Tracked:
    """Frame after frame, against where the gripper truly is."""
    monitor, simulator = gripmon.Monitor(config), scene.simulator
    truth = Truth(from_record(config.reference.cam_T_grip), simulator.truth(scene.first).cam_T_grip)
    tally = Tally(config.settings.monitor.policy.alert_limit_m)
    for index in scene.indices:
        record = monitor.process(simulator.frame(index))
        monitor.run_pending()
        tally.add(record, truth.of(record, simulator.truth(index).cam_T_grip))
    return tally.tracked()
