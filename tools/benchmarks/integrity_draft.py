"""What a condition of ``tools/bench integrity`` is, and what is drawn for a scene before it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import msgspec
import numpy as np

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Cause
from gripmon.simulate.scenario import Background, FingerLook, JawScript, Sensor

Changes = dict[str, Any]


@dataclass(frozen=True)
class Draft:
    """What is drawn before the condition.

    ``start_s`` and ``end_s``: between them things happen; before and after, the gripper is free.
    """

    rng: np.random.Generator
    frames: int
    fps: float
    start_s: float
    end_s: float
    gripper: Gripper
    cam_T_grip: Array
    opening_m: float
    background: Background
    fingers: FingerLook
    sensor: Sensor
    jaw: JawScript

    def at_s(self, share: float) -> float:
        """A time between start and end."""
        return self.start_s + share * (self.end_s - self.start_s)

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def sign(self) -> float:
        return float(self.rng.choice((-1.0, 1.0)))

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def one_of(self, *values: Any) -> Any:
        return values[int(self.rng.integers(len(values)))]

    def between_frames_s(self, share: float) -> float:
        """Near a share of the time, between two frames: a jump there is in no frame's exposure."""
        return (round(self.at_s(share) * self.fps) + 0.5) / self.fps

    @property
    def tip_low_m(self) -> Array:
        """Smallest x, y, z (3,) of all tips' corners at the drawn opening: y is the side towards the camera."""
        return np.asarray(self._tips_m.min(axis=0))

    @property
    def tip_high_m(self) -> Array:
        """Largest x, y, z (3,) of all tips' corners at the drawn opening."""
        return np.asarray(self._tips_m.max(axis=0))

    @property
    def thick_m(self) -> float:
        """Extent of the tips along y."""
        return float(self.tip_high_m[1] - self.tip_low_m[1])

    @property
    def _tips_m(self) -> Array:
        return self.gripper.points_grip_m(self.opening_m)[self.gripper.corner_points]


class Fingers(Enum):
    """Which grippers: the usual ones; two fingers with rounded tips; one finger of the usual that stands still; the
    usual, of which the image's border leaves 25 px; tapered fingers with pads before a colour camera.
    """

    USUAL = ""
    ROUND_TIPS = "round tips"
    ONE = "one finger"
    SHORT = "25 px"
    PADDED = "pads"


@dataclass(frozen=True)
class Condition:
    """A kind of scene.

    ``enough``: the gripper shows enough wherever its outline is seen, so that ``valid`` may be asked for; ``wrong``:
    what is wrong, so that an alert which names it is true; ``inside``: a scene may begin in the midst of it;
    ``truth``: what the true gripper is instead of the one that the monitor knows; ``fingers``: of which grippers.
    """

    name: str
    what: str
    changes: Callable[[Draft], Changes]
    enough: bool = True
    wrong: tuple[Cause, ...] = ()
    inside: bool = True
    truth: Callable[[np.random.Generator, dict[str, Any]], dict[str, Any]] | None = None
    fingers: Fingers = Fingers.USUAL


def with_(settings: Any, **changes: Any) -> Any:
    return msgspec.structs.replace(settings, **changes)


def both(*parts: Callable[[Draft], Changes]) -> Callable[[Draft], Changes]:
    """Several changes together; a later one wins where they meet."""

    def changes(draft: Draft) -> Changes:
        out: Changes = {}
        for part in parts:
            out |= part(draft)
        return out

    return changes
