"""What every benchmark draws alike for its scenes: lenses, places at which the gripper is in view, looks, references;
and the words in which conditions are written down.

Each benchmark names its own ranges.  The order of the draws is part of a scene: seeds name the same scenes for good.
A condition's changes are sections of the scenario by name, each a value or a draw, a function of the draft.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import msgspec
import numpy as np

from gripmon.model.camera import BrownConradyLens, Camera, FisheyeLens, LensSettings
from gripmon.model.geometry import make_transform, perturb, to_record
from gripmon.model.records import Array, ReferenceRecord
from gripmon.simulate import PAPER_LENS
from gripmon.simulate.scenario import Background, FingerLook, Sensor

Rng = np.random.Generator

REFERENCE_SIGMA = np.array([1e-4] * 3 + [1e-3] * 3)
"""By how much a scene's reference is wrong, per axis, m and rad; the monitor knows this."""
BORDER_PX = 14.0
"""Least distance of what has to be seen from the image's border."""
_TRIES = 10_000


@cache
def lenses() -> dict[str, LensSettings]:
    """One of each model."""
    return {
        "paper": PAPER_LENS,
        "wide": BrownConradyLens(
            width_px=640, height_px=480, fx_px=655.0, fy_px=653.0, cx_px=322.0, cy_px=236.0,
            coefficients=(-0.31, 0.11, 0.0012, -0.0008),
        ),
        "fisheye": FisheyeLens(
            width_px=1280, height_px=720, fx_px=790.0, fy_px=790.0, cx_px=641.0, cy_px=357.0,
            coefficients=(0.03, -0.02, 0.004, 0.0),
        ),
    }  # fmt: skip


@dataclass(frozen=True)
class Draft:
    """What is drawn for a scene before its condition: the generator, length, opening and the look of things."""

    rng: Rng
    frames: int
    opening_m: float
    background: Background
    fingers: FingerLook
    sensor: Sensor

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def sign(self) -> float:
        return float(self.rng.choice((-1.0, 1.0)))

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def one_of(self, *values: Any) -> Any:
        return values[int(self.rng.integers(len(values)))]


Changes = dict[str, Any]
"""Sections of a scenario by name; draws among them."""
Draw = Callable[[Any], Any]
"""Of a draft."""


def drawn(draft: Draft, value: Any) -> Any:
    """A value, what a draw gives, or these in dictionaries and tuples, in their order."""
    if isinstance(value, dict):
        return {name: drawn(draft, inner) for name, inner in value.items()}
    if isinstance(value, tuple):
        return tuple(drawn(draft, inner) for inner in value)
    return value(draft) if callable(value) else value


def uniform(low: float, high: float) -> Draw:
    return lambda draft: draft.uniform(low, high)


def whole(low: int, end: int) -> Draw:
    return lambda draft: int(draft.rng.integers(low, end))


def one_of(*values: Any) -> Draw:
    return lambda draft: draft.one_of(*values)


def make(kind: Any, **fields: Any) -> Draw:
    """A new section, or a part of one."""
    return lambda draft: kind(**drawn(draft, fields))


def change(section: str, **fields: Any) -> Draw:
    """The draft's section with other values."""
    return lambda draft: with_(getattr(draft, section), **drawn(draft, fields))


def with_(settings: Any, **changes: Any) -> Any:
    return msgspec.structs.replace(settings, **changes)


class Place(NamedTuple):
    """Where the gripper is: rotation (3, 3) and translation (3,) of ``cam_T_grip``, the jaw's opening, and points
    (n, 3) of the gripper frame that have to be in the image.
    """

    cam_R_grip: Array
    tcp_m: Array
    opening_m: float
    seen_m: Array


def in_view(
    rng: Rng, camera: Camera, draw: Callable[[Rng], Place], border_px: float = BORDER_PX
) -> tuple[Array, float]:
    """``cam_T_grip`` (4, 4) and opening (m) of the first drawn place at which all is in the image that has to be."""
    limit_px = np.array([camera.width_px, camera.height_px]) - 1.0 - border_px
    for _ in range(_TRIES):
        place = draw(rng)
        uv = camera.project(place.seen_m @ place.cam_R_grip.T + place.tcp_m)
        if (uv > border_px).all() and (uv < limit_px).all():
            return make_transform(place.cam_R_grip, place.tcp_m), place.opening_m
    raise ValueError(f"of {_TRIES} places none has the whole gripper in the image")


def finger_look(
    rng: Rng, level_dn: tuple[float, float] = (70.0, 150.0), texture: tuple[float, float] = (0.05, 0.2)
) -> FingerLook:
    """Metal under a lamp from any side."""
    return FingerLook(
        level_dn=float(rng.uniform(*level_dn)),
        ambient=float(rng.uniform(0.25, 0.5)),
        lamp_cam=(float(rng.uniform(-0.6, 0.6)), float(rng.uniform(-0.8, 0.2)), -0.75),
        texture=float(rng.uniform(*texture)),
    )


def sensor(rng: Rng) -> Sensor:
    """Of a lens that is more or less sharp."""
    return Sensor(psf_sigma_px=float(rng.uniform(0.5, 0.8)))


def reference(rng: Rng, cam_T_grip: Array) -> Array:
    """A calibration (4, 4) that is off by :data:`REFERENCE_SIGMA`."""
    return perturb(cam_T_grip, rng.normal(0.0, REFERENCE_SIGMA))


def reference_record(cam_T_grip: Array, covariance: Array | None = None, revision: int = 1) -> ReferenceRecord:
    """What a monitor starts from: a calibration, and its covariance (6, 6); that of :func:`reference` for None."""
    own = np.diag(REFERENCE_SIGMA**2) if covariance is None else covariance
    return ReferenceRecord("start", revision, 0, "configuration", to_record(cam_T_grip), tuple(own.ravel().tolist()))
