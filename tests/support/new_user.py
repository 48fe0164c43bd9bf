"""What a user of a new gripper has at hand: images of the wrist camera before a calibration plate, of the gripper
standing on it, and of its work, as ``gripmon simulate`` makes them; and what is true of them, which only tests read.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gripmon.cli import main
from gripmon.model.records import Array
from support.kept import copied

TARGET = "circles:12x10:0.008:0.004"
OPENING_M = 0.05
STEP = 45
"""The first frame of ``work`` after the knock."""
FPS = 30.0


@dataclass(frozen=True)
class NewUser:
    """Folders ``plate`` (camera), ``standing`` (gripper on the plate) and ``work``: frames, of which those from
    :data:`STEP` on come from a camera that was knocked; ``cam_T_grip`` (frames, 4, 4) is where it was.  ``corners_px``
    are the true corners in ``standing`` and ``work``.
    """

    folder: Path
    cam_T_grip: Array
    corners_px: dict[str, Array]

    def rough_px(self, rng: np.random.Generator, off_px: float) -> dict[str, Array]:
        """Where someone puts the corners."""
        return {name: at + rng.uniform(-off_px, off_px, 2) for name, at in self.corners_px.items()}


def simulate(folder: Path, kind: str) -> None:
    """``folder/kind`` as ``gripmon simulate`` makes it."""
    copied(_simulated, folder / kind, kind)


def _simulated(folder: Path, kind: str) -> None:
    assert main(["simulate", kind, "--out", str(folder)]) == 0


def make(folder: Path) -> NewUser:
    """Render everything."""
    for kind in ("plate", "standing", "work"):
        simulate(folder, kind)
    standing = json.loads((folder / "standing" / "truth.json").read_text())
    work = [json.loads(line) for line in (folder / "work" / "truth.jsonl").read_text().splitlines()]
    assert standing["jaw_opening_m"] == OPENING_M == work[0]["jaw_opening_m"]
    corners = {name: np.array(at) for name, at in standing["corners"].items()}
    return NewUser(folder, np.array([frame["cam_T_grip"] for frame in work]), corners)
