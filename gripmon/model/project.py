"""A project's folder: camera, gripper, hand/eye calibration, taught edges and configuration by their usual names.

Commands resolve it as they read their options, so that what is called, and what a file's provenance says, is a file.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

Part = Literal["camera", "gripper", "reference", "taught", "config"]

FILES: dict[Part, str] = {
    "camera": "camera.yaml", "gripper": "gripper.yaml", "reference": "hand_eye.yaml", "taught": "taught.yaml",
    "config": "config.yaml",
}  # fmt: skip
"""As ``gripmon setup`` and ``gripmon teach`` write them."""


def file_of(path: str | Path, part: Part) -> Path:
    """The file that is meant: of a project's folder, the one with its usual name."""
    path = Path(path)
    # Of what can't be looked at the reader says why, which Path.is_dir would raise.
    return path / FILES[part] if os.path.isdir(path) else path  # noqa: PTH112
