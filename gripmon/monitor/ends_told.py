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
several fingers in view.  These tables: 1,518 right fits and 524 that had slid, on scenes of ``tools/bench integrity``.
"""
LONE_RIGHT, LONE_WRONG = np.array([0.049, 0.121, 0.830]), np.array([0.687, 0.139, 0.174])
"""The same of the only finger in view."""
BOTH_RIGHT = np.array([[106.0, 37.5, 54.5], [37.5, 120.0, 194.0], [54.5, 194.0, 473.0]]) / 1271.0
BOTH_WRONG = np.array([[290.0, 15.5, 3.0], [15.5, 17.0, 11.5], [3.0, 11.5, 13.0]]) / 380.0
"""Of both of two fingers."""
HEARD_S = 1.3
"""Time constant with which an answer is forgotten: one in 20 is news at 15 frames/s."""
FORGOTTEN = 0.05
"""Weight of all answers at a place, in the last one's, under which it is forgotten: then a new one is news by 95 %."""
OPENING_M = 1e-3
"""Change of the opening from which ends are asked anew: other things are beside them."""


def off_by_px(look: Measurement, cam_T_grip: Array) -> float:
    """How far the edges are from where a look searched them, px, at another place: of the edge that moves most."""
    there = look.prediction
    return there.moved_px(perturbation_between(there.cam_T_grip, cam_T_grip))


@dataclass
class _Heard:
    """Answers to one question, each by how long ago it was."""

    weight: dict[tuple[int, ...], float] = field(default_factory=dict)

    @property
    def all(self) -> float:
        return sum(self.weight.values())

    def fade(self, kept: float) -> None:
        self.weight = {answer: kept * weight for answer, weight in self.weight.items()}

    def of(self, answer: tuple[int, ...]) -> tuple[float, float]:
        """How probable it is that it is one of those before again, and the share of these that are the same."""
        return self.all / (self.all + 1.0), self.weight.get(answer, 0.0) / max(self.all, 1e-300)

    def hear(self, answer: tuple[int, ...]) -> None:
        self.weight[answer] = self.weight.get(answer, 0.0) + 1.0


@dataclass
class _Place:
    """Where ends were asked, at which opening, and what was heard there of each finger, and of all together."""

    cam_T_grip: Array
    opening_m: float
    of: list[_Heard]
    together: _Heard = field(default_factory=_Heard)


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
            for heard in (*place.of, place.together):
                heard.fade(kept)
        self._places = [p for p in self._places if any(heard.all > FORGOTTEN for heard in p.of)]
        shape = (2, len(looks), self._fingers)
        (right, wrong), (memory, repeats) = np.zeros(shape), np.ones(shape)
        together, (memory_together, repeats_together) = np.full((len(looks), 2), np.nan), np.zeros((2, len(looks)))
        heard_now: list[tuple[_Heard, tuple[int, ...]]] = []
        for k, (seen, look) in enumerate(zip(ends, looks, strict=True)):
            answer, place = np.where(seen.might > 0, np.minimum(seen.seen, 2), -1), self._place(look)
            asked = np.flatnonzero(answer >= 0)
            tables = (LONE_RIGHT, LONE_WRONG) if len(asked) == 1 else (RIGHT, WRONG)
            for f in asked.tolist():
                right[k, f], wrong[k, f] = (math.log(of[answer[f]]) for of in tables)
                memory[k, f], repeats[k, f] = place.of[f].of((int(answer[f]),))
                heard_now.append((place.of[f], (int(answer[f]),)))
            if len(asked) == len(answer) == 2:
                together[k] = np.log([of[answer[0], answer[1]] for of in (BOTH_RIGHT, BOTH_WRONG)])
                memory_together[k], repeats_together[k] = place.together.of(tuple(answer.tolist()))
                heard_now.append((place.together, tuple(answer.tolist())))
        for heard, of_it in heard_now:
            heard.hear(of_it)
        return Told(right, wrong, memory, repeats, together, memory_together, repeats_together, rows, at, fit)

    def _place(self, look: Measurement) -> _Place:
        """The nearest that is near enough, of those at this opening."""
        there = look.prediction
        off_px = [
            off_by_px(look, p.cam_T_grip) if abs(there.jaw_opening_m - p.opening_m) < OPENING_M else math.inf
            for p in self._places
        ]
        if off_px and min(off_px) < LOOKED_PX:
            return self._places[int(np.argmin(off_px))]
        self._places.append(_Place(there.cam_T_grip, there.jaw_opening_m, [_Heard() for _ in range(self._fingers)]))
        return self._places[-1]
