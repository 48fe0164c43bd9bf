"""The policy as tables: what is seen -> state, verdict, alerts with their events, and whether to recalibrate."""

from __future__ import annotations

import numpy as np
import pytest
from support.policy_runs import (
    ACQUIRING,
    BENT,
    BEYOND,
    BLACK,
    CLEARED,
    DRIFTING,
    HIDDEN,
    KNOCKED,
    LOST,
    OCCLUDED,
    RAISED,
    RECALIBRATING,
    SETTINGS,
    SUSPECT,
    TRACKING,
    UNKNOWN,
    UPDATED,
    VALID,
    Nothing,
    Run,
    explained,
    seen,
    settled,
    told,
)

from gripmon.judge.policy import Evidence
from gripmon.model.records import AlertEvent, AlertKind, Cause, State, Verdict, Vibration

K = AlertKind
Told = list[tuple[AlertKind, AlertEvent]]
Row = tuple[Evidence | Nothing, State, Verdict, Told, bool]

START: list[Row] = [(seen(), ACQUIRING, SUSPECT, [], False), (seen(), TRACKING, VALID, [], False)]
HUMMING = Vibration(2e-4, 12.0)
WRONG_JAW, REFOCUSED = explained(Cause.JAW_OPENING), explained(Cause.LENS)

TABLES: dict[str, list[Row]] = {
    "a start: the second frame that agrees makes it valid": [*START, (seen(), TRACKING, VALID, [], False)],
    "a start on a camera that was moved before: measured again when it has stood still, whatever the test says": [
        (seen(4.5, jumped=True, present=False), ACQUIRING, SUSPECT, [], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [], True),
        (seen(4.5), RECALIBRATING, VALID, [(K.STEP, RAISED)], True),
    ],
    "a start without an image": [
        *[(BLACK, ACQUIRING, UNKNOWN, [], False)] * 4,
        (BLACK, ACQUIRING, UNKNOWN, [(K.IMAGE, RAISED)], False),
        (BLACK, ACQUIRING, UNKNOWN, [], False),
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.IMAGE, CLEARED)], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a start without a gripper": [
        *[(HIDDEN, ACQUIRING, UNKNOWN, [], False)] * 9,  # one second and no longer
        (HIDDEN, LOST, UNKNOWN, [(K.LOST, RAISED)], False),
        *[(HIDDEN, LOST, UNKNOWN, [], False)] * 10,
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.LOST, CLEARED)], False),
    ],
    "a short occlusion: held, confirmed, cleared": [
        *START,
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
        (HIDDEN, OCCLUDED, SUSPECT, [], False),
        (seen(), OCCLUDED, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.OCCLUDED, CLEARED)], False),
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
    ],
    "a view that comes and goes: told once, cleared once": [
        *START,
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
        *[
            (seen(), OCCLUDED, SUSPECT, [], False),
            (seen(), TRACKING, VALID, [], False),
            (HIDDEN, OCCLUDED, SUSPECT, [], False),
        ] * 5,
        (seen(), OCCLUDED, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.OCCLUDED, CLEARED)], False),
    ],
    "a long occlusion: held, lost (the same alert, worse), found": [
        *START,
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
        *[(HIDDEN, OCCLUDED, SUSPECT, [], False)] * 7,  # one second and no longer
        (HIDDEN, LOST, UNKNOWN, [(K.LOST, UPDATED)], False),
        *[(HIDDEN, LOST, UNKNOWN, [], False)] * 30,
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.LOST, CLEARED)], False),
    ],
    "refused frames: the state stays, the image is reported once, only time makes it lost": [
        *START,
        *[(BLACK, TRACKING, SUSPECT, [], False)] * 4,
        (BLACK, TRACKING, SUSPECT, [(K.IMAGE, RAISED)], False),
        *[(BLACK, TRACKING, SUSPECT, [], False)] * 3,
        (BLACK, LOST, UNKNOWN, [(K.LOST, RAISED)], False),
        (BLACK, LOST, UNKNOWN, [], False),
        (seen(), ACQUIRING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.LOST, CLEARED), (K.IMAGE, CLEARED)], False),
    ],
    "one refused frame: back at once": [
        *START,
        (BLACK, TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a jump within the limit: suspect until confirmed, a drift when the test has found it": [
        *START,
        (seen(1.0, jumped=True, present=False), TRACKING, SUSPECT, [], False),
        (seen(1.0), DRIFTING, VALID, [(K.STEP, RAISED)], False),
        *[(seen(1.0), DRIFTING, VALID, [], False)] * 20,
    ],
    "one wild frame: not a word": [
        *START,
        (seen(1.0, jumped=True, present=False), TRACKING, SUSPECT, [], False),
        (seen(jumped=True), TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "a drift that goes: cleared when it has been gone for long enough, not before": [
        *START,
        (seen(0.3), DRIFTING, VALID, [(K.STEP, RAISED)], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(0.3), DRIFTING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.STEP, CLEARED)], False),
        (seen(0.3), DRIFTING, VALID, [(K.STEP, RAISED)], False),
    ],
    "a jump past the limit: recalibrates when it has stood still for four frames": [
        *START,
        (seen(4.5, jumped=True, present=False), RECALIBRATING, SUSPECT, [], False),
        (seen(4.5), RECALIBRATING, VALID, [(K.STEP, RAISED)], False),
        (seen(4.8), RECALIBRATING, VALID, [], False),  # it still rings
        (seen(4.4), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], False),
        (seen(4.51), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], False),
        (seen(4.5), RECALIBRATING, VALID, [], True),
        (seen(4.5), RECALIBRATING, VALID, [], True),
    ],
    "a turn past the limit without a shift": [
        *START,
        (seen(turn_rad=0.021), RECALIBRATING, VALID, [(K.STEP, RAISED)], False),
        (seen(turn_rad=0.019), DRIFTING, VALID, [], False),
    ],
    "past the limit, then it isn't seen: counted again": [
        *START,
        *[(seen(4.5, present=False), RECALIBRATING, VALID, [], False)] * 3,
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
        (seen(4.5, present=False), OCCLUDED, SUSPECT, [], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [(K.OCCLUDED, CLEARED)], False),
        (seen(4.5, present=False), RECALIBRATING, VALID, [], True),
    ],
    "a finger bent: suspect, told as that and not as a motion, cleared when it is straight": [
        *START,
        (seen(0.3, explanation=BENT), DRIFTING, SUSPECT, [(K.GRIPPER, RAISED)], False),
        *[(seen(0.3, explanation=BENT), DRIFTING, SUSPECT, [], False)] * 20,
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.GRIPPER, CLEARED)], False),
    ],
    "a finger bent so much that it looks past the limit: never calibrated again": [
        *START,
        (seen(4.5, explanation=BENT), DRIFTING, SUSPECT, [(K.GRIPPER, RAISED)], False),
        *[(seen(4.5, explanation=BENT), DRIFTING, SUSPECT, [], False)] * 20,
    ],
    "a motion whose cause turns out to be the finger: both stay told, with the cause": [
        *START,
        (seen(0.3), DRIFTING, VALID, [(K.STEP, RAISED)], False),
        (seen(0.3, explanation=BENT), DRIFTING, SUSPECT, [(K.STEP, UPDATED), (K.GRIPPER, RAISED)], False),
        (seen(0.3, explanation=BENT), DRIFTING, SUSPECT, [], False),
    ],
    "the jaw reported wrong: suspect": [
        *START,
        (seen(4.5, explanation=WRONG_JAW), DRIFTING, SUSPECT, [(K.GRIPPER, RAISED)], False),
    ],
    "the jaw is blamed until the edges are seen well, then the mount: what was wrong is taken back at once": [
        *START,
        (seen(1.0, explanation=WRONG_JAW), DRIFTING, SUSPECT, [(K.GRIPPER, RAISED)], False),
        (seen(1.0, explanation=KNOCKED), DRIFTING, VALID, [(K.STEP, RAISED), (K.GRIPPER, CLEARED)], False),
    ],
    "another focus: suspect": [
        *START,
        (seen(4.5, explanation=REFOCUSED), DRIFTING, SUSPECT, [(K.LENS, RAISED)], False),
    ],
    "the mount moved: valid, for the transform follows it": [
        *START,
        (seen(1.0), DRIFTING, VALID, [(K.STEP, RAISED)], False),
        (seen(1.0, explanation=KNOCKED), DRIFTING, VALID, [(K.STEP, UPDATED)], False),
        (seen(1.0, explanation=KNOCKED), DRIFTING, VALID, [], False),
    ],
    "a gripper that contradicts its model: what that may do to the transform is in its bound, which alone counts": [
        *START,
        (seen(astray=True), TRACKING, VALID, [], False),
        (seen(astray=True, protection=BEYOND), TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "hidden, then where it was: no second frame has to say so": [
        *START,
        (HIDDEN, OCCLUDED, SUSPECT, [(K.OCCLUDED, RAISED)], False),
        (seen(where_it_was=True), TRACKING, VALID, [], False),
    ],
    "a stream at fault: suspect while it is": [
        *START,
        (seen(stream_at_fault=True), TRACKING, SUSPECT, [], False),
        (seen(), TRACKING, VALID, [], False),
    ],
    "vibration: told, the transform stays valid, cleared": [
        *START,
        (seen(vibration=HUMMING), TRACKING, VALID, [(K.VIBRATION, RAISED)], False),
        *[(seen(vibration=HUMMING), TRACKING, VALID, [], False)] * 20,
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [], False),
        (seen(), TRACKING, VALID, [(K.VIBRATION, CLEARED)], False),
    ],
    "a creep from a drift: the kind is told when it is known, not faster than once a second": [
        *START,
        (seen(0.1, kind=K.DRIFT), DRIFTING, VALID, [(K.DRIFT, RAISED)], False),
        *[(seen(0.1, creep_mm_per_min=1.0), DRIFTING, VALID, [], False)] * 7,
        (seen(0.1, creep_mm_per_min=1.0), DRIFTING, VALID, [(K.CREEP, UPDATED)], False),
        *[(seen(0.1, creep_mm_per_min=1.1), DRIFTING, VALID, [], False)] * 20,
    ],
}  # fmt: skip


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_tables(table: list[Row]):
    run = Run()
    for number, (frame, state, verdict, alerts, recalibrate) in enumerate(table):
        judgement = run.feed(frame)
        assert (judgement.state, judgement.verdict, told(judgement.alerts), judgement.recalibrate) == (
            state,
            verdict,
            alerts,
            recalibrate,
        ), f"row {number}"


def test_standing_still_is_within_half_of_what_is_worth_a_warning():
    """Of where the transform came to rest, not of the frame before."""
    run = settled()
    half_mm = 0.5e3 * SETTINGS.warn_m
    for _ in range(3):
        run.feed(seen(1.0))
    for part, still in ((0.9, 4), (-0.9, 5), (1.1, 1), (1.1, 2)):
        run.feed(seen(1.0 + part * half_mm))
        assert run.policy.still_frames == still, part


@pytest.mark.parametrize(
    ("shift_mm", "turn_rad", "moved"),
    [(0.29, 0.0, False), (0.31, 0.0, True), (0.0, 0.0029, False), (0.0, 0.0031, True)],
)
def test_a_camera_that_swings_has_moved_by_more_than_three_standard_deviations(
    shift_mm: float, turn_rad: float, moved: bool
):
    """A swing of 0.1 mm and 1 mrad along one other axis: it is the way's length that counts."""
    evidence = seen(shift_mm, turn_rad=turn_rad)
    swing = np.array([0.0, 1e-8, 0.0, 1e-6, 0.0, 0.0])
    assert evidence.moved and evidence._replace(swing=swing).moved is moved
    assert not seen(9.0, present=False)._replace(swing=swing).moved
