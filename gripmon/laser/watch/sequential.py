"""Has anything moved?  Shiryaev and Roberts's procedure over beliefs, with a stated rate of false alarms.

With every pulse a new alternative begins: "something moved just now", for each thing that may have and for small and
large motions.  Each belief says beforehand where the next spot will be, and how surely; the product of how much better
an alternative's saying was than the reigning belief's is its likelihood ratio.  Under the reigning belief the sum R of
the ratios less the number of pulses is a martingale, so that R exceeds K once in K pulses at most, on average, whatever
alternatives there are and however few of them are kept (Pollak, Ann. Statist. 13, 1985).  What is common to pulses (the
calibration's errors, an arm's at one pose) is an unknown of every belief, and no evidence.

A spot may be wrong: a reflection, or speckle beside it.  Half of the wrong ones lie anywhere in the image, the others
near the right one as readily as far off: uniformly in the logarithm of the distance.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from gripmon.laser.watch.beliefs import MOVED, Bank, Beliefs, Pulse, as_calibrated
from gripmon.laser.watch.motions import BACK, newborn
from gripmon.laser.watch.world import Calibrated
from gripmon.model.records import Array

LEAST_PULSES = 3
"""That speak for a motion before it is said: two wrong spots may look like one."""
BACK_AGAIN = 100.0
"""Odds from which what had moved is where it was."""
_KEPT = 32
_REMEMBERED = 64
"""Pulses for which it is remembered what was believed before them."""
_REIGNING = 12
_HOPELESS = math.log(1e-6)
"""Weight below which an alternative is dropped: those that begin now overtake it."""
_NEGLIGIBLE = math.log(1e-5)
"""Of the best belief's weight: those below are dropped."""


@dataclass(frozen=True, slots=True)
class Finding:
    """``odds``: R over the limit that it must reach for an alarm; ``alarm``: it has, just now; ``back``: everything is
    where it was again, just now.  ``candidate`` that the best belief takes for the spot, ``believed`` whether it does.
    """

    odds: float
    alarm: bool
    back: bool
    candidate: int
    believed: bool


class MotionTest:
    """``reigning``: the beliefs that hold, logarithms of their weights add up to one; one of them until something
    moves.
    """

    def __init__(self, calibrated: Calibrated, false_alarms_per_1000: float, wrong_spots: float):
        self._calibrated, self._share = calibrated, wrong_spots
        self._limit = 1000.0 / false_alarms_per_1000
        self._bank = Bank(calibrated)
        self._kinds, self._scales, self._shares, self._assumed = newborn()
        self._diagonal_px = math.hypot(calibrated.camera.width_px, calibrated.camera.height_px)
        self.reset()

    def reset(self) -> None:
        """Everything is as calibrated."""
        self.reigning = as_calibrated(self._calibrated)
        self._others = self.reigning.picked(np.array([], dtype=np.intp))
        self._pulses = 0
        self._history: deque[Beliefs] = deque(maxlen=_REMEMBERED)
        self._before = self.reigning
        self.moved = False

    @property
    def best(self) -> int:
        """Index of the most probable reigning belief."""
        return int(self.reigning.weight.argmax())

    def at_new_place(self, place: int, covariance_px: Array) -> None:
        """Pulses come from another pose, in a place's stead."""
        for beliefs in (self.reigning, self._others, self._before, *self._history):
            beliefs.at_new_place(place, covariance_px)

    def add(self, pulse: Pulse) -> Finding:
        """One pulse with a candidate at least."""
        wrong = self._wrong(pulse)
        others = self._others.joined(self._begun())
        if not self.moved:
            self._history.append(self.reigning.picked(np.array([self.best])))
        self._pulses += 1
        told, candidates, believed = self._bank.weigh(self.reigning, pulse, wrong, self._share)
        weight = self.reigning.weight + told
        all_told = float(np.logaddexp.reduce(weight))
        self.reigning.weight = weight - all_told
        best = self.best
        others.weight = others.weight + self._bank.weigh(others, pulse, wrong, self._share)[0] - all_told
        self._others = _kept(others, _KEPT, _HOPELESS)
        self._prune()
        odds, back_odds = self._odds()
        changes = odds >= 1.0 or back_odds >= 1.0
        candidate, is_believed = int(candidates[best]), bool(believed[best])
        if changes:
            self._others, self.reigning = self._crowned(back=back_odds > odds)
            if not self.moved:
                self._remember(int(self.reigning.born[self.best]))
            self.moved = back_odds <= odds
            candidate, is_believed = self._chosen(pulse)
        return Finding(max(odds, 0.0), changes and self.moved, changes and not self.moved, candidate, is_believed)

    def _wrong(self, pulse: Pulse) -> Array:
        """(k,) density of wrong spots, around where the best belief has the right one; 1/px²."""
        best = self.reigning.picked(np.array([self.best]))
        uv_px, rows = self._bank.foreseen(best, pulse)
        camera = self._calibrated.camera
        anywhere = 1.0 / (camera.width_px * camera.height_px)
        if not np.isfinite(uv_px).all():
            return np.full(len(pulse.uv_px), anywhere)
        own = rows[0] @ best.covariance[0] @ rows[0].T
        near = math.sqrt(0.5 * float(np.trace(own)) + self._calibrated.sigma_px**2)
        near = min(3.0 * near, 0.1 * self._diagonal_px)
        distance = np.maximum(np.linalg.norm(pulse.uv_px - uv_px[0], axis=1), near)
        around = 1.0 / (2.0 * np.pi * distance**2 * (0.5 + math.log(self._diagonal_px / near)))
        out: Array = 0.5 * (anywhere + around)
        return out

    def _begun(self) -> Beliefs:
        """Something has moved just now, against the best reigning belief; or it is back, if it had moved."""
        count = len(self._kinds)
        out = self.reigning.picked(np.full(count, self.best))
        out.covariance[:, MOVED, MOVED] += self._assumed
        out.weight[:] = self._shares
        out.kind[:], out.scale[:], out.prior[:] = self._kinds, self._scales, self._assumed
        out.pulses[:] = 0
        out.born[:] = self._pulses
        out.motions += 1
        if not self.moved:
            return out
        back = self._before.picked(np.zeros(1, dtype=np.intp))
        back.kind[:], back.weight[:], back.pulses[:], back.born[:] = BACK, 0.0, 0, self._pulses
        return out.joined(back)

    def _remember(self, born: int) -> None:
        """What was believed before the motion, which what came after it had no part in yet."""
        ago = min(self._pulses - born, len(self._history))
        self._before = self._history[-ago]
        self._history.clear()

    def _prune(self) -> None:
        """What has become negligible among those that reign."""
        keep = self.reigning.weight > self.reigning.weight.max() + _NEGLIGIBLE
        if not keep.all():
            self.reigning = self.reigning.picked(keep)

    def _odds(self) -> tuple[float, float]:
        """Of a motion, and of everything being back, over what each must reach."""
        others = self._others
        enough = others.pulses >= LEAST_PULSES
        back = others.kind == BACK
        sums = [float(np.exp(np.minimum(others.weight[enough & which], 700.0)).sum()) for which in (~back, back)]
        return sums[0] / self._limit, sums[1] / BACK_AGAIN

    def _crowned(self, *, back: bool) -> tuple[Beliefs, Beliefs]:
        """No others, and those that reign from now on."""
        others = self._others
        right = (others.pulses >= LEAST_PULSES) & ((others.kind == BACK) == back)
        chosen = _kept(others.picked(right), 1 if back else _REIGNING)
        chosen.weight = chosen.weight - np.logaddexp.reduce(chosen.weight)
        if back:
            chosen.kind[:] = -1
        return others.picked(np.array([], dtype=np.intp)), chosen

    def _chosen(self, pulse: Pulse) -> tuple[int, bool]:
        """Candidate that the best belief takes, having learnt from it."""
        best = self.reigning.picked(np.array([self.best]))
        _, candidates, believed = self._bank.weigh(best, pulse, self._wrong(pulse), self._share)
        return int(candidates[0]), bool(believed[0])


def _kept(beliefs: Beliefs, most: int, least: float = -math.inf) -> Beliefs:
    """The weightiest, of those above a weight."""
    heavy = np.argsort(-beliefs.weight, kind="stable")[:most]
    return beliefs.picked(np.sort(heavy[beliefs.weight[heavy] > least]))
