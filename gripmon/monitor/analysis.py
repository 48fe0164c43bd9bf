"""A frame's evidence about the calibration: whether the gripper has moved against the reference, whether anything looks
wrong, and the probable cause.

Causes are analysed as long as something looks wrong, and at first to learn what is normal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gripmon.judge.causes import CauseJudge, Watches
from gripmon.judge.drift import Baseline, MotionWatch
from gripmon.judge.policy import Evidence
from gripmon.judge.repeats import RepeatWatch
from gripmon.judge.stream import CALM_FRAMES, StreamFault, StreamWatch
from gripmon.model.camera import Camera
from gripmon.model.errors import in_short
from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Array, Beside, Cause, Drift, EdgeEvidence, Explanation, Frame, ReferenceRecord
from gripmon.monitor.answers import gripper_astray
from gripmon.monitor.backlog import MOST_WAITING, RESULT_AFTER_S, Backlog
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.standing import Standing
from gripmon.monitor.tracker import Tracker
from gripmon.track.edges import Effort, Measurement, agreeing_fingers, edge_residuals_px

LULL_FRAMES = 3
"""Successive frames without anything wrong after which an explanation no longer holds."""

GATHERED_AT, CONCLUDED_AT, CONCLUDED_EVERY = (1, 2, 3, 4, 5, 7, 9, 12, 16, 20), (5, 9, 20), 60
"""Of the frames that look wrong, counted from 1: those whose evidence is gathered, those after which a conclusion is
drawn, and the period of later ones for both.  Gathering takes as long as measuring, a conclusion as several frames.
"""

DOUBTED_FRAMES = 5
"""Successive frames in which the gripper contradicts its model, from which on the drift test uses them nevertheless."""

CONFIRMED_AFTER_S = 1.0
"""From the frame of a periodic conclusion to the one in which it counts, if a cause is known already.  Even in a fast
replay a second of frames takes longer than the 20 to 40 ms of the analysis.
"""


class _Finding(NamedTuple):
    """Result of a task: an explanation or none, for the ``episode`` it belongs to; and whether the judge still learns
    from frames without anything wrong.
    """

    episode: int
    explanation: Explanation | None
    wants_baseline: bool


class CauseAnalysis:
    """Chooses the frames for the cause analysis.  The judge is used only in the backlog."""

    def __init__(self, judge: CauseJudge):
        self._judge = judge
        self._backlog: Backlog[_Finding] = Backlog()
        self._episode = 0  # since the evidence was forgotten last
        self._asked, self._calm = 0, CALM_FRAMES
        self._explanation = Explanation()
        self._wants_baseline = judge.wants_baseline
        self.live = False
        """No frame waits for a result: it counts once it is there."""
        self.analysed = 0
        """Results that count from the newest frame on."""
        self._waits = True

    def run_pending(self) -> None:
        """Run the waiting tasks; in any thread."""
        self._backlog.run()

    @property
    def pending(self) -> bool:
        """Whether there is something to do for :meth:`run_pending`."""
        return self._backlog.undone

    def rebase(self, reference_sigma: Array) -> None:
        """There is a new reference, with standard deviations (6,), m and rad."""
        self._forget(lambda judge: judge.rebase(reference_sigma))

    def moved_again(self) -> None:
        """Forget the evidence so far: it is from another pose."""
        calm = self._calm
        self._forget()
        self._calm = calm

    def knocked(self) -> None:
        """The camera's pose differs from the next frame on: what is normal isn't learnt from two poses."""
        if self._wants_baseline:
            self._do(CauseJudge.knocked)

    def interrupted(self) -> None:
        """After a long gap in the stream the camera may have been exchanged, until all has been calm again."""
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
        """Add the frame of ``now_s``, in which something looks ``wrong``, or which may show what is ``usual``, or
        neither; return the explanation from earlier frames.  :meth:`catch_up` comes before.

        ``gather`` is called only if the frame's evidence is needed, with a copy of the image: the caller may read the
        next one into the same memory.
        """
        if not wrong:
            self._calm += 1
        known = self.known
        confirms = False
        if wrong:
            self._calm = 0
            self._asked += 1
            confirms = self._asked % CONCLUDED_EVERY == 0
            gathers, concludes = (confirms or self._asked in at for at in (GATHERED_AT, CONCLUDED_AT))
        else:
            if self._calm == CALM_FRAMES:
                self._forget()
            room = self._waits or len(self._backlog) < MOST_WAITING // 4
            gathers, concludes = usual and self._calm >= CALM_FRAMES and self._wants_baseline and room, False
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
        """The explanation from the frames so far; none before the first conclusion is due, since a change of light
        spoils one or two frames.
        """
        return self._explanation if self._asked >= CONCLUDED_AT[0] and self._calm <= LULL_FRAMES else Explanation()

    def catch_up(self, now_s: float, then: int | None = None) -> None:
        """Use the results that are due, or so many as ``then``.  A failed task costs an explanation, not a frame."""
        backlog = self._backlog
        if then is None:
            results = list(backlog.results(now_s, waits=not self.live))
        else:  # a replay of other images may have begun more of them
            results = [backlog.next() for _ in range(max(min(then, len(backlog)), len(backlog) - MOST_WAITING))]
        self.analysed, self._waits = len(results), then is None and not self.live
        for found in results:
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


class FrameAnalysis:
    """Gathers, frame by frame, the evidence for the decision."""

    def __init__(
        self,
        camera: Camera,
        gripper: Gripper,
        settings: MonitorSettings,
        tracker: Tracker,
        configured: ReferenceRecord,
        error: Array | None,
    ):
        """``configured``: the reference of the configuration; ``error`` (6,): its error, if known."""
        self._gripper, self._tracker, self._valid_by = gripper, tracker, settings.policy.valid_by
        self._reach_px = settings.corners.sampling.reach_px
        self.stream = StreamWatch(settings.stream)
        self._repeats = RepeatWatch(settings.stream, len(gripper.edge_ids))
        self.watch = MotionWatch(settings.drift)
        jaw = settings.jaw_sigma_m, settings.jaw_offset_sigma_m
        self.causes = CauseAnalysis(CauseJudge(camera, gripper, settings.causes, np.zeros(6), *jaw))
        self.of_configured = Baseline(_sigma(configured), settings.policy.settle_frames, error)
        """The configured reference's error at the start."""
        self._watches = Watches(len(gripper.finger_ids))
        self._astray = 0

    def rebase(self, reference: ReferenceRecord, configured: bool) -> None:
        """Measure drift from ``reference``, which is the ``configured`` one or a newer one."""
        self._ref_cam_T_grip = from_record(reference.cam_T_grip)
        if configured:
            self.baseline, covariance = self.of_configured, np.zeros((6, 6))
        else:
            self.baseline = Baseline(np.zeros(6), 0, error=np.zeros(6))
            covariance = np.reshape(reference.covariance, (6, 6))
        self._baseline_weighed = False
        self.watch.reset(covariance)
        self.causes.rebase(_sigma(reference))
        if reference.restores is None:
            # How edges look from where the camera is now; an undo doesn't move it.
            self._watches = Watches(len(self._gripper.finger_ids))

    def begin_frame(self, frame: Frame, now_s: float, then: Beside | None = None) -> tuple[StreamFault, ...]:
        """Return the stream's faults; pass its rate to the drift test, and use the cause analyses that are due, or that
        counted from the frame on of which this is a replay, ``then``.
        """
        self.causes.catch_up(now_s, None if then is None else then.analysed)
        faults = self.stream.add(frame)
        if (repeated := self._repeats.taken()) is not None:
            faults = (*faults, repeated)  # known from the frame before: it takes a measurement
        for fault in faults:
            if fault.kind == "gap":
                self.causes.interrupted()
        frames_per_s = self.stream.frames_per_s
        if frames_per_s is not None:
            self.watch.set_frames_per_s(frames_per_s)
        return faults

    def checked(self, frame: Frame, standing: Standing, now_s: float) -> Standing:
        """The same, not believed where it rests on pixels of an earlier frame."""
        assert frame.image is not None
        if self.stream.repeats or not self._repeats.add(frame.image, standing.measurement, self.stream.coded, now_s):
            return standing
        return standing._replace(believed=False, old=True)

    def evidence(
        self,
        frame: Frame,
        standing: Standing,
        drift: Drift,
        before_T: Array,
        swing: Array,
        doubtful: bool,
        now_s: float,
    ) -> Evidence:
        """A measured frame's evidence for and against the reference.

        ``before_T`` (4, 4): where the gripper was expected; ``swing`` (6,): variance of the mount's vibration;
        ``doubtful``: the stream has a fault.
        """
        measurement, cam_T_grip, covariance = standing.measurement, standing.cam_T_grip, standing.covariance
        # Motion that the search lines can follow from frame to frame is not a jump.
        looked_far = measurement.effort is not Effort.NARROW
        jumped = looked_far and measurement.moved_px(before_T) > self._reach_px
        shift = perturbation_between(self._ref_cam_T_grip, cam_T_grip)
        shares = agreeing_fingers(measurement, self._gripper)
        astray = gripper_astray(measurement, shares)
        self._astray = self._astray + 1 if astray else 0
        if standing.knocked:
            self.baseline.knocked()
        # A few doubtful frames say nothing; many are a lasting change.
        if 0 < self._astray < DOUBTED_FRAMES or not standing.believed:
            motion = self.watch.skip()
        else:
            motion = self.watch.add(self._since_start(shift, covariance), covariance, now_s)
        if motion.stepped:
            self.causes.moved_again()
        reported_m = frame.jaw_opening_m if self._gripper.has_jaw else None
        residual_px = edge_residuals_px(measurement, self._gripper)
        odd = self._watches.add(measurement.blur_px, shares, residual_px, reported_m, measurement.jaw_opening_m)
        if standing.knocked:
            self.causes.knocked()
        wrong = astray or motion.present or motion.suspicious or odd
        error = self.baseline.error
        return Evidence(
            shift,
            np.sqrt(covariance.diagonal()),
            drift.translation_m,
            drift.rotation_rad,
            motion,
            jumped,
            self.explain(frame, measurement, wrong, standing.believed, now_s),
            astray,
            doubtful,
            standing.bounds.by(self._valid_by),
            standing.where_it_was,
            swing,
            standing.believed,
            since_first=error is not None and bool(error.any()),
            unproven=standing.unproven,
            cut_off=2 * int(measurement.cut_off.sum()) > len(measurement.cut_off),
            old=standing.old,
        )

    def _since_start(self, shift: Array, covariance: Array) -> Array | None:
        """The shift (6,) less the reference's error; None while that isn't known yet."""
        since_start = self.baseline.subtract(shift)
        if since_start is not None and not self._baseline_weighed:
            self._baseline_weighed = True
            if self.baseline.error is not None and self.baseline.error.any():
                # It was measured in front of one background: it is as uncertain as one such frame.
                self.watch.set_reference_covariance(covariance)
        return since_start

    def explain(self, frame: Frame, measurement: Measurement, wrong: bool, usual: bool, now_s: float) -> Explanation:
        """Add this frame and return the explanation so far: see :meth:`CauseAnalysis.ask`."""
        if self.stream.repeats:
            return self.causes.known  # the image is an old one, the robot's reports are not
        tracker, here = self._tracker, self._ref_cam_T_grip

        def gather(kept: Frame) -> EdgeEvidence:
            return tracker.evidence(kept, measurement, here)

        return self.causes.ask(wrong, usual, frame, gather, here, now_s)


def _sigma(reference: ReferenceRecord) -> Array:
    """(6,) standard deviations of a reference, m and rad."""
    return np.asarray(np.sqrt(np.reshape(reference.covariance, (6, 6)).diagonal()))
