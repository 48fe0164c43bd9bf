"""A project's folder: camera, gripper, hand/eye calibration, taught edges and configuration by their usual names."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

Part = Literal["camera", "gripper", "reference", "taught", "config"]

FILES: dict[Part, str] = {
    "camera": "camera.yaml", "gripper": "gripper.yaml", "reference": "hand_eye.yaml", "taught": "taught.yaml",
    "config": "config.yaml",
}  # fmt: skip
"""As ``gripmon setup`` and ``gripmon teach`` write them."""


def file_of(path: Path, part: Part) -> Path:
    """The file that an option means: of a project's folder, the one with its usual name."""
    return path / FILES[part] if path.is_dir() else path


def files_of(**given: Path | None) -> dict[str, Path | None]:
    """The same of several options by the part that each names; None stays."""
    return {part: None if path is None else file_of(path, part) for part, path in given.items()}  # type: ignore[arg-type]
