"""A simulated camera and gripper of which no one has a configuration yet, as ``gripmon teach --page`` meets them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import yaml

from gripmon.cli import main
from gripmon.daemon.config import builtin_config, read_gripper
from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.geometry import to_record
from gripmon.model.gripper import Gripper
from gripmon.model.images import read_image
from gripmon.model.records import Image
from support.simulated import box_model, nominal_cam_T_grip

SCENARIO = {
    "name": "table",
    "duration_s": 0.5,
    "fps": 6.0,
    "background": {"kind": "plain", "contrast": 0.0, "level_dn": 190.0, "boxes": 0, "cables": 0, "motion": "still"},
    "fingers": {"texture": 0.0, "carriers": False},
}


@dataclass(frozen=True)
class Rig:
    """Files in ``folder``: camera.yaml, gripper.yaml and images in sim; ``truth`` of the first image."""

    folder: Path
    camera: Camera
    gripper: Gripper
    truth: dict[str, object]

    @property
    def image_path(self) -> Path:
        return self.folder / "sim" / "000000.png"

    @property
    def image(self) -> Image:
        image, fault = read_image(self.image_path)
        assert image is not None, fault
        return image

    @property
    def corners_px(self) -> dict[str, np.ndarray]:
        """Where the corners really are."""
        listed: list[dict[str, object]] = self.truth["corners"]  # type: ignore[assignment]
        return {str(corner["id"]): np.array(corner["uv_px"]) for corner in listed}

    @property
    def options(self) -> list[str]:
        """What the command needs of a new robot."""
        return ["--camera", str(self.folder / "camera.yaml"), "--gripper", str(self.folder / "gripper.yaml")]

    def rough(self, *names: str, off_px: float = 4.0, seed: int = 1) -> dict[str, list[float]]:
        """Corners as a person puts them, some pixels beside."""
        rng = np.random.default_rng(seed)
        true = self.corners_px
        return {name: (true[name] + rng.normal(0.0, off_px, 2)).round(1).tolist() for name in names or true}


def make_rig(folder: Path) -> Rig:
    """Simulate it, with sharp fingers before an even table."""
    (folder / "gripper.yaml").write_text(yaml.safe_dump(box_model(), sort_keys=False))
    values = yaml.safe_load(builtin_config("demo.yaml").read_text())
    transform = msgspec.to_builtins(to_record(nominal_cam_T_grip()))
    values["reference"]["cam_T_grip"] = {key: list(value) for key, value in transform.items()}
    values["gripper"] = "gripper.yaml"
    (folder / "made_with.yaml").write_text(yaml.safe_dump(values, sort_keys=False))
    (folder / "camera.yaml").write_text(yaml.safe_dump(values["camera"], sort_keys=False))
    (folder / "table.yaml").write_text(yaml.safe_dump(SCENARIO, sort_keys=False))
    made_with = ["--config", str(folder / "made_with.yaml"), "--out", str(folder / "sim"), "--seed", "3"]
    assert main(["simulate", str(folder / "table.yaml"), *made_with]) == 0
    truth = json.loads((folder / "sim" / "truth.jsonl").read_text().splitlines()[0])
    camera = make_camera(msgspec.convert(values["camera"], LensSettings))
    return Rig(folder, camera, read_gripper(folder / "gripper.yaml"), truth)
