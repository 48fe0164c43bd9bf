"""``gripmon teach --page`` without a gripper file: rough corners for ``gripmon calibrate plane --infer``."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.teach.page import RoughDesk

ROUGH = "rough.yaml"
_NEED_A_GRIPPER = ("config", "gripper", "reference", "live", "robot", "camera_name", "jaw_opening", "jaw_source")


def is_meant(arguments: argparse.Namespace) -> bool:
    """Whether a page is asked for and nothing that goes with a gripper."""
    return bool(arguments.page) and all(getattr(arguments, name) is None for name in _NEED_A_GRIPPER)


def rough_desk(arguments: argparse.Namespace) -> RoughDesk:
    """The image, checked; a fault ends the command with exit code 2."""
    from gripmon.cli.teach_inputs import read_lens
    from gripmon.io.sources.folder import read_image
    from gripmon.teach.page import Picture, RoughDesk

    if len(arguments.images) > 1:
        raise common.CommandFailedError(
            f"teach: {len(arguments.images)} images, and no gripper; one image, to put rough corners in, or --gripper "
            "FILE",
            common.EXIT_USAGE,
        )
    path = Path(arguments.images[0])
    if path.is_dir():
        raise common.CommandFailedError(f"{path}: is a folder; an image file", common.EXIT_USAGE)
    image, fault = read_image(path)
    if image is None:
        raise common.CommandFailedError(f"{path}: {fault}; an image file", common.EXIT_USAGE)
    target = None
    if arguments.camera is not None:
        target = _target_of(Path(arguments.camera))
        lens, _ = read_lens(Path(arguments.camera))
        height, width = image.shape[:2]
        if (width, height) != (lens.width_px, lens.height_px):
            raise common.CommandFailedError(
                f"{path}: {width} x {height} px; the camera's {lens.width_px} x {lens.height_px} px, as it was "
                "calibrated",
                common.EXIT_USAGE,
            )
    folder = Path(arguments.out) if arguments.out else Path()
    common.make_directory(folder)
    follows = ["gripmon", "calibrate", "plane", str(path), "--camera", arguments.camera or "camera.yaml"]
    follows += [
        "--target",
        "TARGET" if target is None else arguments.camera,
        "--infer",
        "--corners",
        str(folder / ROUGH),
    ]
    follows += ["--gripper-out", str(folder / "gripper.yaml"), "--out", str(folder / "hand_eye.yaml")]
    plate = (
        "TARGET is the plate, such as circles:12x10:0.008:0.004"
        if target is None
        else f"the plate is taken to be the camera's target, {target}; of another one --target says what it is"
    )
    note = f"{plate}; with jaws that move also --jaw-range MIN:MAX (m)"
    return RoughDesk(Picture(path.name, image, None, str(path)), folder / ROUGH, shlex.join(follows), note)


def _target_of(path: Path) -> str | None:
    """What a camera's file says it was calibrated with."""
    from gripmon.daemon.config import ConfigError
    from gripmon.daemon.config.yaml_file import read_yaml

    try:
        text = read_yaml(path).get("target")
    except ConfigError:
        return None  # reading the camera says what is wrong
    return text if isinstance(text, str) else None
