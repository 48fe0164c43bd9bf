"""Golden images: small simulated pictures under ``golden/``, each with its whole truth as text beside it.

``python -m support.golden_images`` in tests/ writes them again: only after a change that is meant to change pictures,
with a look at what changed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import yaml

from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings, PaperLens
from gripmon.model.gripper import Gripper
from gripmon.model.records import Image
from gripmon.simulate import Scenario, Simulator, paper_rig
from gripmon.simulate.scenario import Background, Cover, Defocus, FingerLook, JawScript, Light, Sensor
from support.grippers import gripper_from_dict
from support.meters import moved
from support.simulated import BOX_FINGERS, nominal_cam_T_grip

FOLDER = Path(__file__).resolve().parents[1] / "golden"
SIZE = {"width_px": 320, "height_px": 240}
PAPER = PaperLens(**SIZE, fx_px=401.0, fy_px=401.0, cx_px=159.5, cy_px=119.5, kappa_per_px2=1.1e-6)
BROWN = BrownConradyLens(
    **SIZE, fx_px=380.0, fy_px=378.0, cx_px=158.2, cy_px=121.0, coefficients=(-0.25, 0.08, 0.001, -0.001)
)
FISHEYE = FisheyeLens(**SIZE, fx_px=330.0, fy_px=330.0, cx_px=160.0, cy_px=120.0, coefficients=(0.02, -0.01, 0.0, 0.0))
QUIET = Background(kind="plain", contrast=0.0, level_dn=170.0, boxes=0, cables=0)


def _scenario(name: str, background: Background, **settings: Any) -> Scenario:
    return Scenario(name=name, fps=10.0, background=background, **settings)


SCENES: dict[str, tuple[str, LensSettings, Scenario, float]] = {
    "plain": ("box", PAPER, _scenario("plain", QUIET, fingers=FingerLook(texture=0.05)), 32.0),
    "clutter": ("arc", BROWN, _scenario("clutter", Background(kind="printed")), 30.0),
    "fisheye_open_jaw": (
        "box", FISHEYE, _scenario("fisheye", Background(kind="blobs"), jaw=JawScript(knots=((0.0, 0.042),))), 36.0,
    ),
    "hand": (
        "box", PAPER,
        _scenario("hand", QUIET, covers=(Cover(start_s=0.0, end_s=10.0, move_s=1.5, side="right"),)), 32.0,
    ),
    "blur_and_jpeg": (
        "box", PAPER,
        _scenario(
            "blur", Background(kind="stripes"), defocus=(Defocus(sigma_px=0.8),), light=Light(exposure=0.7),
            sensor=Sensor(jpeg_quality=85),
        ), 32.0,
    ),
}  # fmt: skip
"""Gripper, lens, scenario, tilt of the camera against the gripper (degrees)."""

FRAME = 5
START = np.array([4e-4, -3e-4, 6e-4, 4e-3, -3e-3, 5e-3])
"""By how much the pose that a measurement starts from is wrong (m, rad)."""


def grippers() -> dict[str, dict[str, Any]]:
    """Gripper files as they are now, without bevels."""
    models: dict[str, dict[str, Any]] = {}
    for name, path in (("box", BOX_FINGERS), ("arc", BOX_FINGERS.parent / "adaptive_arc_fingers.yaml")):
        models[name] = yaml.safe_load(path.read_text(encoding="utf-8"))
        for edge in models[name]["edges"].values():
            edge.pop("bevel_m", None)
    return models


def simulator(truth: dict[str, Any], gripper: Gripper) -> Simulator:
    """The simulator of a golden image, from its text alone."""
    lens: LensSettings = msgspec.convert(truth["camera"], LensSettings)  # type: ignore[arg-type]
    scenario = msgspec.convert(truth["scenario"], Scenario)
    return paper_rig(gripper, np.array(truth["nominal_cam_T_grip"]), lens=lens).simulator(scenario, truth["seed"])


def load(name: str) -> tuple[Image, dict[str, Any], Gripper]:
    """A golden image, its truth, its gripper."""
    image = cv2.imread(str(FOLDER / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    truth: dict[str, Any] = yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
    model = yaml.safe_load((FOLDER / f"gripper_{truth['gripper']}.yaml").read_text(encoding="utf-8"))
    return np.asarray(image), truth, gripper_from_dict(model)


def write() -> None:
    """All images, texts and grippers; limits stay as they are where a text exists."""
    FOLDER.mkdir(exist_ok=True)
    models = grippers()
    for name, model in models.items():
        (FOLDER / f"gripper_{name}.yaml").write_text(yaml.safe_dump(model, sort_keys=False, width=120))
    for number, (name, (gripper, lens, scenario, tilt_deg)) in enumerate(SCENES.items()):
        text = FOLDER / f"{name}.yaml"
        before = yaml.safe_load(text.read_text()) if text.exists() else {}
        truth: dict[str, Any] = {
            "gripper": gripper,
            "camera": msgspec.to_builtins(lens),
            "seed": 40 + number,
            "frame": FRAME,
            "nominal_cam_T_grip": nominal_cam_T_grip(tilt_deg).tolist(),
            "scenario": msgspec.to_builtins(scenario),
        }
        made = simulator(truth, gripper_from_dict(models[gripper]))
        cv2.imwrite(str(FOLDER / f"{name}.png"), made.render(FRAME), [cv2.IMWRITE_PNG_COMPRESSION, 9])
        known = made.truth(FRAME)
        truth |= {
            "cam_T_grip": known.cam_T_grip.tolist(),
            "start_cam_T_grip": moved(known.cam_T_grip, START).tolist(),
            "jaw_opening_m": known.jaw_opening_m,
            "corners_uv_px": {
                i: np.round(uv, 4).tolist() for i, uv in zip(known.corner_ids, known.corner_uv_px, strict=True)
            },
            "hidden_corners": [i for i, seen in zip(known.corner_ids, known.visible, strict=True) if not seen],
            "limits": before.get("limits", {"tcp_um": [20.0, 20.0, 80.0], "corner_px": 0.3, "corners_at_least": 4}),
        }
        text.write_text(yaml.safe_dump(truth, sort_keys=False, width=120, default_flow_style=None))


if __name__ == "__main__":
    write()
