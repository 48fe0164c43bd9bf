"""When to ask what moved: as long as something looks wrong, and at first, for what is normal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from gripmon.judge.causes import CauseJudge
from gripmon.judge.stream import CALM_FRAMES
from gripmon.model.errors import in_short
from gripmon.model.records import Array, Cause, EdgeEvidence, Explanation, Frame
from gripmon.monitor.backlog import RESULT_AFTER_S, Backlog

LULL_FRAMES = 3
"""Frames in a row in which nothing looks wrong up to which an explanation holds."""

GATHERED_AT, CONCLUDED_AT, EVERY = (1, 2, 3, 4, 5, 7, 9, 12, 16, 20), (5, 9, 20), 60
"""Of the frames that look wrong, those whose evidence is gathered at first, those after which a conclusion is drawn,
and after how many more each further one: gathering takes as long as measuring, and concluding as many frames' time.
"""

FEWEST_FRAMES = CONCLUDED_AT[0]
"""Frames that must look wrong before it is said why: a change of light spoils one or two."""

CONFIRMED_AFTER_S = 1.0
"""From a further conclusion's frame to the one that it counts in, where a cause is known, so that it isn't urgent; and
where frames come one right after the other, as in a replay, a second of them takes longer than the 20 to 40 ms of this.
"""


class _Finding(NamedTuple):
    """What a task has led to: in the ``episode`` that it belongs to, an explanation or none; and whether the judge
    still learns from frames in which all is well.
    """

    episode: int
    explanation: Explanation | None
    wants_baseline: bool


class CauseAnalysis:
    """Asks the judge of causes about the frames that are worth it.  The judge works in the backlog alone."""

    def __init__(self, judge: CauseJudge):
        self._judge = judge
        self._backlog: Backlog[_Finding] = Backlog()
        self._episode = 0  # since the evidence was forgotten last
        self._asked, self._calm = 0, CALM_FRAMES
        self._explanation = Explanation()
        self._wants_baseline = judge.wants_baseline

    def run_pending(self) -> None:
        """Work through what is waiting; in any thread."""
        self._backlog.run()

    @property
    def pending(self) -> bool:
        """Whether there is something to do for :meth:`run_pending`."""
        return self._backlog.undone

    def rebase(self, reference_sigma: Array) -> None:
        """There is a new reference, with standard deviations (6,), m and rad."""
        self._forget(lambda judge: judge.rebase(reference_sigma))

    def moved_again(self) -> None:
        """The evidence so far is of another place."""
        calm = self._calm
        self._forget()
        self._calm = calm

    def knocked(self) -> None:
        """The camera is elsewhere from the next frame on: what is normal isn't learnt of two places."""
        if self._wants_baseline:
            self._do(CauseJudge.knocked)

    def interrupted(self) -> None:
        """No frames came for long: someone may have exchanged the camera meanwhile, until all has been calm again."""
        self._do(lambda judge: judge.interrupted())
        self._calm = min(self._calm, LULL_FRAMES + 1)

    def ask(
        self,
        wrong: bool,
        usual: bool,
        frame: Frame,
        gather: Callable[[Frame], EdgeEvidence],
        ref_cam_T_grip: Array,
        now_s: float,
    ) -> Explanation:
        """What the frames before have shown; and one more in which something looks ``wrong``, or which may show what is
        ``usual``, or neither, that of ``now_s``, up to which :meth:`catch_up` has taken over what was due.

        ``gather`` its evidence only if it is needed, from an image of its own: the caller may read the next one into
        the same memory.
        """
        if not wrong:
            self._calm += 1
        known = self.known
        confirms = False
        if wrong:
            self._calm = 0
            self._asked += 1
            confirms = self._asked % EVERY == 0
            gathers, concludes = (confirms or self._asked in at for at in (GATHERED_AT, CONCLUDED_AT))
        else:
            if self._calm == CALM_FRAMES:
                self._forget()
            gathers, concludes = usual and self._calm >= CALM_FRAMES and self._wants_baseline, False
        if not gathers:
            return known
        assert frame.image is not None
        kept = replace(frame, image=frame.image.copy())

        def work(judge: CauseJudge) -> Explanation | None:
            (judge.add if wrong else judge.well)(gather(kept))
            return judge.explanation(ref_cam_T_grip) if concludes else None

        urgent = not confirms or self._explanation.probable.cause is Cause.UNKNOWN
        self._do(work, now_s, RESULT_AFTER_S if urgent else CONFIRMED_AFTER_S)
        return known

    @property
    def known(self) -> Explanation:
        """What the frames so far have shown; for a frame that says nothing new."""
        return self._explanation if self._asked >= FEWEST_FRAMES and self._calm <= LULL_FRAMES else Explanation()

    def catch_up(self, now_s: float) -> None:
        """Take over what is due.  What has failed costs an explanation, not a frame."""
        for found in self._backlog.results(now_s):
            if isinstance(found, Exception):
                self._explanation = Explanation(text=f"cause analysis failed: {in_short(found)}")
                continue
            self._wants_baseline = found.wants_baseline
            if found.explanation is not None and found.episode == self._episode:
                self._explanation = found.explanation

    def _forget(self, work: Callable[[CauseJudge], None] = CauseJudge.reset) -> None:
        self._episode += 1
        self._asked, self._calm, self._explanation = 0, CALM_FRAMES, Explanation()
        self._do(work)

    def _do(self, work: Callable[[CauseJudge], Explanation | None], *when_s: float) -> None:
        judge, episode = self._judge, self._episode

        def task() -> _Finding:
            return _Finding(episode, work(judge), judge.wants_baseline)

        self._backlog.add(task, *when_s)
