"""What the fingers' ends tell the belief of a frame, at each place where it was searched.

How probable an answer is comes from tables; how much of it is news from what was answered there before: the answers of
one scene are more alike than those of all, so that the second to flicker tells no more than the first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gripmon.belief.doubts import Told
from gripmon.belief.ends import LOOKED_PX
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Array
from gripmon.track.edges import FingerEndsSeen, Measurement

RIGHT, WRONG = np.array([0.155, 0.276, 0.569]), np.array([0.812, 0.117, 0.071])
"""How probable 0, 1 or 2 indications of a finger's end are where it is one and where it is something else, of one of
several fingers in view.  These tables: 1,518 right fits and 524 that had slid (``tools/bench belief --witnesses``).
"""
LONE_RIGHT, LONE_WRONG = np.array([0.049, 0.121, 0.830]), np.array([0.687, 0.139, 0.174])
"""The same of the only finger in view."""
BOTH_RIGHT = np.array([[106.0, 37.5, 54.5], [37.5, 120.0, 194.0], [54.5, 194.0, 473.0]]) / 1271.0
BOTH_WRONG = np.array([[290.0, 15.5, 3.0], [15.5, 17.0, 11.5], [3.0, 11.5, 13.0]]) / 380.0
"""Of both of two fingers."""
HEARD_S = 1.3
"""Time constant with which an answer is forgotten: one in 20 is news at 15 frames/s."""
FORGOTTEN = 0.05
"""Weight of all answers at a place, in the last one's, under which it is forgotten."""


@dataclass
class _Place:
    """Where ends were asked, and the answers there, each by how long ago it was: of each finger and of all together."""

    cam_T_grip: Array
    of: list[dict[int, float]]
    together: dict[tuple[int, ...], float] = field(default_factory=dict)

    def fade(self, kept: float) -> None:
        """All of them, to so much of their weight."""
        self.of = [{answer: kept * weight for answer, weight in counts.items()} for counts in self.of]
        self.together = {answer: kept * weight for answer, weight in self.together.items()}

    def hear(self, answer: tuple[int, ...]) -> None:
        """One more."""
        self.together[answer] = self.together.get(answer, 0.0) + 1.0
        for counts, a in zip(self.of, answer, strict=True):
            counts[a] = counts.get(a, 0.0) + 1.0

    @property
    def heard(self) -> float:
        return sum(self.together.values())


class EndsTold:
    """The witnesses of one gripper's f fingers."""

    def __init__(self, fingers: int) -> None:
        self._fingers = fingers
        self._places: list[_Place] = []
        self._last_s: float | None = None

    def told(
        self, ends: Sequence[FingerEndsSeen], looks: Sequence[Measurement], rows: Array, at: Array, fit: int,
        now_s: float,
    ) -> Told:  # fmt: skip
        """``ends`` of the k ``looks`` at a frame, which were ``at`` (k, 23); ``rows`` (e, 23) and ``fit`` as in
        :class:`~gripmon.belief.doubts.Told`.  Of fingers whose ends are out of view, nothing.
        """
        kept = 1.0 if self._last_s is None else math.exp(-(now_s - self._last_s) / HEARD_S)
        self._last_s = now_s
        for place in self._places:
            place.fade(kept)
        self._places = [place for place in self._places if place.heard > FORGOTTEN]
        right, wrong, repeats = np.zeros((3, len(looks), self._fingers))
        together, (memory, repeats_together) = np.full((len(looks), 2), np.nan), np.zeros((2, len(looks)))
        for k, (seen, look) in enumerate(zip(ends, looks, strict=True)):
            answer = np.where(seen.might > 0, np.minimum(seen.seen, 2), -1)
            asked = np.flatnonzero(answer >= 0)
            tables = (LONE_RIGHT, LONE_WRONG) if len(asked) == 1 else (RIGHT, WRONG)
            right[k], wrong[k] = (np.where(answer >= 0, np.log(of[answer]), 0.0) for of in tables)
            if len(asked) == len(answer) == 2:
                together[k] = np.log([of[answer[0], answer[1]] for of in (BOTH_RIGHT, BOTH_WRONG)])
            place, given = self._place(look), tuple(answer.tolist())
            heard = place.heard
            memory[k] = heard / (heard + 1.0)
            if heard > 0.0:
                repeats[k] = [counts.get(a, 0.0) / heard for counts, a in zip(place.of, given, strict=True)]
                repeats_together[k] = place.together.get(given, 0.0) / heard
            place.hear(given)
        return Told(right, wrong, memory, repeats, together, repeats_together, rows, at, fit)

    def _place(self, look: Measurement) -> _Place:
        cam_T_grip = look.prediction.cam_T_grip
        for place in self._places:
            if look.prediction.moved_px(perturbation_between(cam_T_grip, place.cam_T_grip)) < LOOKED_PX:
                return place
        self._places.append(_Place(cam_T_grip, [{} for _ in range(self._fingers)]))
        return self._places[-1]
