"""When to ask what moved: as long as something looks wrong, and at first, for what is normal."""

from __future__ import annotations

from collections.abc import Callable

from gripmon.causes import CauseJudge
from gripmon.records import Array, EdgeEvidence, Explanation

CALM_FRAMES, LULL_FRAMES = 30, 3
"""Frames in a row in which nothing looks wrong after which the evidence is forgotten, and up to which an explanation
holds.
"""

FEWEST_FRAMES = 5
"""Frames that must look wrong before it is said why: a change of light spoils one or two."""

AT_FIRST, EVERY = (1, 2, 3, 5, 8, 12, 20), 16
"""Frames after which the first conclusions are drawn, and after how many more each further one: gathering evidence
takes as long as measuring, and concluding from it longer.
"""


class Inquiry:
    """Asks the judge of causes for the frames that are worth it."""

    def __init__(self, judge: CauseJudge):
        self._judge = judge
        self._asked = 0
        self._calm = CALM_FRAMES
        self._explanation = Explanation()

    def rebase(self, reference_sigma: Array) -> None:
        """There is a new reference, with standard deviations (6,), m and rad."""
        self._judge.rebase(reference_sigma)
        self._forget()

    def interrupted(self) -> None:
        """No frames came for long: somebody may have exchanged the camera meanwhile."""
        self._judge.interrupted()

    def ask(self, wrong: bool, evidence: Callable[[], EdgeEvidence], ref_cam_T_grip: Array) -> Explanation:
        """One frame in which something looks ``wrong`` or not; ``evidence`` is gathered only if it is needed."""
        if wrong:
            self._calm = 0
            self._asked += 1
            concluded = self._asked in AT_FIRST or self._asked % EVERY == 0
            if self._asked <= AT_FIRST[-1] or concluded:
                self._judge.add(evidence())
            if concluded:
                self._explanation = self._judge.explanation(ref_cam_T_grip)
            return self._told()
        self._calm += 1
        if self._calm == CALM_FRAMES:
            self._forget()
        if self._calm >= CALM_FRAMES and self._judge.wants_baseline:
            self._judge.well(evidence())
        return self._told()

    def _told(self) -> Explanation:
        return self._explanation if self._asked >= FEWEST_FRAMES and self._calm <= LULL_FRAMES else Explanation()

    def _forget(self) -> None:
        self._judge.reset()
        self._asked, self._calm, self._explanation = 0, CALM_FRAMES, Explanation()
