"""Sequences of an independent renderer beside the checkout (``../shared/data/rendered*``), as the benchmarks take them.

A row is named by folder and sequence.  Each runs twice: as a robot would report its jaws (rounded; the monitor's
default sigma), and with the true opening.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.conditions import CLEAN, HARD, Limit
from benchmarks.drawn import REFERENCE_SIGMA
from benchmarks.machine import ROOT
from benchmarks.scenes import Sequence, Shot
from benchmarks.tags import FingerTags, with_tags
from gripmon.model.camera import PaperLens, make_camera
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.model.records import Frame

FOLDER = ROOT.parent / "shared" / "data" / "rendered"
_PREFIX, _TRUE_JAW = "rendered ", ", true jaw"
_NAMES = ("clean", "static_background", "grasp_occlusion", "jaw_cycle", "bump_y", "series2")
LIMITS: dict[str, Limit] = {"clean": CLEAN}
_JUDGED_FROM = {"bump_y": 50}
"""Frames from which errors count: the fifth after the jump."""


def row_names() -> list[str]:
    """Two rows a sequence, whether it is there or not."""
    return [_PREFIX + name + jaw for jaw in ("", _TRUE_JAW) for name in _NAMES]


def all_row_names() -> list[str]:
    """Two rows for each sequence that is there, in all folders beside each other."""
    found = sorted(FOLDER.parent.glob(f"{FOLDER.name}*/*/truth.json"))
    return [f"{path.parts[-3]} {path.parts[-2]}{jaw}" for jaw in ("", _TRUE_JAW) for path in found]


@dataclass(frozen=True)
class Rendered(Sequence):
    """A rendered sequence, or one of the unrelated frames of ``clean``."""

    folder: Path
    frames: tuple[dict[str, Any], ...]
    repeat: int
    judged_from: int

    def shots(self) -> Iterator[Shot]:
        period_ns = round(1e9 / self.fps)
        index = 0
        for frame in self.frames:
            image = cv2.imread(str(self.folder / frame["file"]), cv2.IMREAD_GRAYSCALE)
            if image is None:
                raise FileNotFoundError(self.folder / frame["file"])
            for _ in range(self.repeat):
                jaw_m = frame["jaw_reported"] if self.jaw_sigma_m is None else frame["jaw"]
                shown = Frame(index, index * period_ns, np.asarray(image, np.uint8), float(jaw_m), frame["file"])
                judged = index >= self.judged_from
                yield Shot(shown, np.array(frame["camera_T_gripper"]), float(frame["jaw"]), judged)
                index += 1

    def tagged(self, index: int, shot: Shot) -> NDArray[np.uint8]:
        """Printed into the finished image: what may be in front of the fingers doesn't hide them."""
        noise_dn = float(self.frames[index // self.repeat]["conditions"]["noise"])
        rng, image = np.random.default_rng([index]), np.asarray(shot.frame.image, np.uint8)
        return with_tags(image, self.camera, shot.cam_T_grip, shot.jaw_opening_m, rng, self._tags, noise_dn)

    @cached_property
    def _tags(self) -> FingerTags:
        return FingerTags(self.gripper)


def sequences(row: str) -> list[Rendered]:
    """What belongs to a row; empty where the data is missing.

    The frames of ``clean`` are unrelated: each starts from its truth and is shown twice, since the first frame of all
    is never valid.
    """
    true_jaw = row.endswith(_TRUE_JAW)
    family, _, name = row.removesuffix(_TRUE_JAW).partition(" ")
    folder = (FOLDER if family == _PREFIX.strip() else FOLDER.with_name(family)) / name
    if not folder.is_dir():
        return []
    camera, gripper, truth = (json.loads((folder / f"{n}.json").read_text()) for n in ("camera", "gripper", "truth"))
    lens = PaperLens(
        width_px=camera["width"],
        height_px=camera["height"],
        fx_px=float(camera["fx"]),
        fy_px=float(camera["fy"]),
        cx_px=float(camera["cx"]),
        cy_px=float(camera["cy"]),
        kappa_per_px2=float(camera["k"]),
    )
    model = Gripper(msgspec.convert(_converter().gripper_model(gripper), GripperModel))

    def part(frames: list[dict[str, Any]], start: Any, repeat: int, judged_from: int) -> Rendered:
        return Rendered(
            make_camera(lens),
            model,
            np.array(start),
            np.diag(REFERENCE_SIGMA**2),
            0.0 if true_jaw else None,
            None,
            float(truth["fps"]),
            folder,
            tuple(frames),
            repeat,
            judged_from,
        )

    if name == "clean":
        return [part([frame], frame["camera_T_gripper"], 2, 1) for frame in truth["frames"]]
    return [part(truth["frames"], truth["start_camera_T_gripper"], 1, _JUDGED_FROM.get(name, 1))]


def limit_um(row: str) -> Limit:
    return LIMITS.get(row.removeprefix(_PREFIX).removesuffix(_TRUE_JAW), HARD)


@cache
def _converter() -> Any:
    """``tools/rendered_config``, which has no suffix."""
    loader = SourceFileLoader("rendered_config", str(ROOT / "tools" / "rendered_config"))
    spec = spec_from_loader(loader.name, loader)
    assert spec is not None
    module = module_from_spec(spec)
    loader.exec_module(module)
    return module
