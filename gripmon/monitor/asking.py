"""When to ask what moved: as long as something looks wrong, and at first, for what is normal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from gripmon.judge.causes import CauseJudge
from gripmon.model.records import Array, EdgeEvidence, Explanation, Frame

CALM_FRAMES, LULL_FRAMES = 30, 3
"""Frames in a row in which nothing looks wrong after which the evidence is forgotten, and up to which an explanation
holds.
"""

FEWEST_FRAMES = 5
"""Frames that must look wrong before it is said why: a change of light spoils one or two."""

GATHERED_AT, CONCLUDED_AT, EVERY = (1, 2, 3, 4, 5, 7, 9, 12, 16, 20), (5, 9, 20), 60
"""Of the frames that look wrong, those whose evidence is gathered at first, those after which a conclusion is drawn,
and after how many more each further one: gathering takes as long as measuring, and concluding as many frames' time.
"""


class Inquiry:
    """Asks the judge of causes for the frames that are worth it."""

    def __init__(self, judge: CauseJudge):
        self._judge = judge
        self._asked = 0
        self._calm = CALM_FRAMES
        self._explanation = Explanation()
        self._pending: tuple[bool, Callable[[], EdgeEvidence] | None, Array] | None = None

    def rebase(self, reference_sigma: Array) -> None:
        """There is a new reference, with standard deviations (6,), m and rad."""
        self._judge.rebase(reference_sigma)
        self._pending = None
        self._forget()

    def moved_again(self) -> None:
        """The evidence so far is of another place."""
        self._pending = None
        self._judge.reset()
        self._asked, self._explanation = 0, Explanation()

    def interrupted(self) -> None:
        """No frames came for long: somebody may have exchanged the camera meanwhile, until all has been calm again."""
        self._judge.interrupted()
        self._calm = min(self._calm, LULL_FRAMES + 1)

    def ask(
        self, wrong: bool, frame: Frame, gather: Callable[[Frame], EdgeEvidence], ref_cam_T_grip: Array
    ) -> Explanation:
        """One frame in which something looks ``wrong`` or not; ``gather`` its evidence only if it is needed.

        What the frames before have shown; this one is thought about in :meth:`ponder`, of an image of its own: the
        caller may read the next one into the same memory before that.
        """
        if not wrong:
            self._calm += 1
        evidence = None
        if self._wants_evidence(wrong):
            assert frame.image is not None
            kept = replace(frame, image=frame.image.copy())
            evidence = lambda: gather(kept)  # noqa: E731
        self._pending = (wrong, evidence, ref_cam_T_grip)
        return self.told()

    def _wants_evidence(self, wrong: bool) -> bool:
        """Whether :meth:`ponder` will look at this frame's image."""
        if wrong:
            asked = self._asked + 1
            return asked % EVERY == 0 or asked in GATHERED_AT
        return self._calm >= CALM_FRAMES and self._judge.wants_baseline

    def catch_up(self) -> None:
        """Ponder before the next frame, if nobody has: what fails there costs an explanation, not that frame."""
        try:
            self.ponder()
        except Exception as error:  # noqa: BLE001  said in the explanation
            self._explanation = Explanation(text=f"what moved could not be worked out: {type(error).__name__}: {error}")

    def ponder(self) -> None:
        """Think about the last frame that was asked about; nothing if that has been done."""
        if self._pending is None:
            return
        (wrong, evidence, ref_cam_T_grip), self._pending = self._pending, None
        if wrong:
            self._calm = 0
            self._asked += 1
            if evidence is not None:
                self._judge.add(evidence())
            if self._asked % EVERY == 0 or self._asked in CONCLUDED_AT:
                self._explanation = self._judge.explanation(ref_cam_T_grip)
            return
        if self._calm == CALM_FRAMES:
            self._forget()
        if evidence is not None:
            self._judge.well(evidence())

    def told(self) -> Explanation:
        """What the frames so far have shown; for a frame that says nothing new."""
        return self._explanation if self._asked >= FEWEST_FRAMES and self._calm <= LULL_FRAMES else Explanation()

    def _forget(self) -> None:
        self._judge.reset()
        self._asked, self._calm, self._explanation = 0, CALM_FRAMES, Explanation()
