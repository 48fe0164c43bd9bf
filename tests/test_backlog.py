"""Work beside the frames: its results count from a moment of the frames' clock on, whoever has done it."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from support.meters import box_gripper
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.watched import FPS, frames_of, new_monitor, rendered, replaced

from gripmon.model.camera import make_camera
from gripmon.model.records import Beside, Cause, CauseWeight, Explanation, Frame, Origin, to_json
from gripmon.monitor import Tracker
from gripmon.monitor.analysis import CONCLUDED_AT, CONCLUDED_EVERY, CONFIRMED_AFTER_S, CauseAnalysis
from gripmon.monitor.backlog import RESULT_AFTER_S, Backlog
from gripmon.monitor.settings import MonitorSettings
from gripmon.simulate import Scenario
from gripmon.simulate.scenario import JawScript
from gripmon.track.edges import FingertipMeter
from gripmon.track.edges.search import search_poses


def test_results_come_in_order_when_they_are_due_and_not_before():
    backlog: Backlog[str] = Backlog()
    done = []
    for name, now_s in (("first", 1.0), ("second", 1.05)):
        backlog.add(lambda name=name: done.append(name) or name, now_s)
    assert list(backlog.results(1.0 + 0.99 * RESULT_AFTER_S)) == [] and done == []
    assert list(backlog.results(1.0 + RESULT_AFTER_S)) == ["first"] and done == ["first"]
    backlog.run()
    assert done == ["first", "second"] and len(backlog) == 1, "done, and not yet due"
    assert list(backlog.results(2.0)) == ["second"] and done == ["first", "second"], "nothing is done twice"


def test_what_is_not_urgent_holds_up_nothing_that_is():
    backlog: Backlog[str] = Backlog()
    backlog.add(lambda: "confirmed", 1.0, 1.0)
    assert list(backlog.results(1.9)) == []
    backlog.add(lambda: "without a time")
    assert list(backlog.results(1.9)) == [], "in order"
    backlog.add(lambda: "urgent", 1.5)
    assert list(backlog.results(1.5 + RESULT_AFTER_S)) == ["confirmed", "without a time", "urgent"]


def test_who_needs_a_result_waits_for_the_thread_that_makes_it():
    backlog: Backlog[str] = Backlog()
    began, may_end = threading.Event(), threading.Event()

    def slow() -> str:
        began.set()
        assert may_end.wait(10.0)
        return threading.current_thread().name

    backlog.add(slow, 0.0)
    worker = threading.Thread(target=backlog.run, name="worker")
    worker.start()
    assert began.wait(10.0)
    threading.Timer(0.05, may_end.set).start()
    assert list(backlog.results(1.0)) == ["worker"]
    worker.join()


def test_who_waits_for_a_result_does_not_do_what_comes_after_it():
    """The frame that needs the first result has waited for the thread that makes it; the second is not due yet."""
    backlog: Backlog[str] = Backlog()
    began, may_end, after = threading.Event(), threading.Event(), []
    backlog.add(lambda: began.set() or (may_end.wait(10.0) and "first"), 0.0)
    worker = threading.Thread(target=lambda: backlog._do_next(), name="worker")
    worker.start()
    assert began.wait(10.0)
    backlog.add(lambda: after.append(threading.current_thread().name) or "second", 5.0)
    threading.Timer(0.05, may_end.set).start()
    assert list(backlog.results(RESULT_AFTER_S)) == ["first"]
    worker.join()
    assert after == [] and backlog.undone and len(backlog) == 1
    backlog.run()
    assert not backlog.undone and len(backlog) == 1, "done, and still to be taken"


def test_a_further_conclusion_is_urgent_only_while_no_cause_is_known():
    """The first cause counts after the usual time, also where it is found late; then a second is soon enough."""
    named = CauseWeight(Cause.CAMERA_MOUNT, 1.0)
    told: list[Explanation] = []

    def explanation(_: np.ndarray) -> Explanation:
        told.append(Explanation((named,), named, f"{len(told) + 1}") if len(told) >= 3 else Explanation())
        return told[-1]

    judge = SimpleNamespace(wants_baseline=False, add=lambda _: None, reset=lambda: None, explanation=explanation)
    analysis = CauseAnalysis(judge)
    texts = []
    for number in range(3 * CONCLUDED_EVERY + 1):
        now_s = number / 60.0
        analysis.catch_up(now_s)
        frame = Frame(number, number, np.zeros((2, 2), np.uint8), None)
        texts.append(analysis.ask(True, False, frame, lambda kept: None, np.eye(4), now_s).text)
    known = [next(n for n, text in enumerate(texts) if text == each) for each in ("4", "5")]
    # Of these frames the first conclusion that names a cause, and one more.
    asked = np.array([1, 2]) * CONCLUDED_EVERY - 1
    assert (known - asked).tolist() == [round(60.0 * RESULT_AFTER_S), round(60.0 * CONFIRMED_AFTER_S)]


@pytest.mark.parametrize("scene", ["bump", "bent_finger"])
def test_a_thread_beside_the_frames_changes_no_record(scene: str):
    """A bump that has to be searched for, and a finger whose bend has to be worked out."""
    alone, helped = new_monitor(), new_monitor()
    wanted, stop, busy = threading.Event(), threading.Event(), []

    def work() -> None:
        while not stop.is_set():
            if wanted.wait(0.05):
                wanted.clear()
                busy.append(helped.pending)
                helped.run_pending()

    worker = threading.Thread(target=work)
    worker.start()
    try:
        for frame in frames_of(scene)[0]:
            expected, found = alone.process(frame), helped.process(frame)
            wanted.set()
            assert to_json(found) == to_json(expected)
    finally:
        stop.set()
        worker.join()
    assert sum(busy) >= 2, "the thread had something to do"


@pytest.mark.parametrize("scene", ["bump", "bent_finger"])
def test_no_live_frame_works_beside_itself_and_a_replay_repeats_what_counted_when(
    scene: str, monkeypatch: pytest.MonkeyPatch
):
    """On a machine so busy that what goes on beside the frames is done only after every ninth, and often too late."""
    live, again, live_works, do_next = new_monitor(), new_monitor(), [], Backlog._do_next
    live.run_live()

    def noted(backlog: Backlog[object], *wanted: object) -> None:
        live_works.append(backlog)
        do_next(backlog, *wanted)

    begun, used, analysed = [], [], 0
    for number, frame in enumerate(frames_of(scene)[0]):
        with monkeypatch.context() as patched:
            patched.setattr(Backlog, "_do_next", noted)
            found = live.process(frame)
        assert not live_works
        then = live.beside
        assert then is not None
        assert to_json(again.process(frame, then)) == to_json(found) and again.beside == then
        begun += [frame.seq] * then.searches
        used += [] if then.searched_seq is None else [(then.searched_seq, frame.seq)]
        analysed += then.analysed
        if number % 9 == 8:
            live.run_pending()
    assert [of for of, _ in used] == begun[: len(used)] and all(of < seq for of, seq in used)
    assert used if scene == "bump" else analysed > CONCLUDED_AT[0]


def test_a_replay_of_other_images_keeps_to_the_clock_where_the_recorded_frame_began_no_search():
    frames, _ = frames_of("static")
    noise = np.random.default_rng(1).integers(0, 256, frames[0].image.shape, dtype=np.uint8)
    monitor, begun = new_monitor(), []
    for number, frame in enumerate(frames[:30]):
        monitor.process(frame if number < 5 else replaced(frame, image=noise), Beside())
        begun += [number] * monitor._tracker.searching.searches
    assert begun[0] == 5 and len(begun) >= 2


def test_a_lost_gripper_is_searched_for_at_once_and_then_beside_the_frames(monkeypatch: pytest.MonkeyPatch):
    frames, _ = frames_of("static")
    noise = np.random.default_rng(1).integers(0, 256, frames[0].image.shape, dtype=np.uint8)
    monitor, ran_in = new_monitor(), []

    def watched(*args: object) -> np.ndarray:
        ran_in.append(threading.current_thread().name)
        return search_poses(*args)

    monkeypatch.setattr("gripmon.track.edges.measure.search_poses", watched)
    for number, frame in enumerate(frames[:40]):
        record = monitor.process(frame if number < 5 else replaced(frame, image=noise))
        assert (record.source is Origin.HELD) == (number >= 5)
        if monitor.pending:
            worker = threading.Thread(target=monitor.run_pending, name="worker")
            worker.start()
            worker.join()
    assert ran_in[0] == "MainThread" and len(ran_in) >= 3 and set(ran_in[1:]) == {"worker"}


def test_what_comes_back_elsewhere_while_its_transform_is_held_is_found_soon():
    """Covered for 0.8 s of the second that a transform is held, and knocked meanwhile: no search has to wait for its
    turn.
    """
    frames, _ = frames_of("bump")
    monitor, random, back = new_monitor(), np.random.default_rng(1), 60
    found = []
    for number, frame in enumerate(frames[: back + 12]):
        if back - 24 <= number < back:
            frame = replaced(frame, image=random.integers(0, 256, frame.image.shape, dtype=np.uint8))
        if monitor.process(frame).source is Origin.UPDATE and number >= back - 24:
            found.append(number)
    soon = round(2.0 * RESULT_AFTER_S * FPS) + 2  # the search that saw the noise, and the one after it
    assert found and back <= found[0] <= back + soon


@pytest.mark.parametrize("opening_m", [0.022, 0.045])
def test_an_opening_that_nobody_reports_is_looked_for_once(opening_m: float, monkeypatch: pytest.MonkeyPatch):
    """The jaw stands where neither the gripper file nor anybody says: found at first, expected there then."""
    jaw = JawScript(knots=((0.0, opening_m),), reported=False)
    frames, _ = rendered(Scenario(name="unreported", duration_s=0.5, fps=30.0, jaw=jaw))
    assert all(frame.jaw_opening_m is None for frame in frames)
    fits = []
    settle = FingertipMeter._settle

    def counted(self: FingertipMeter, *args: object) -> object:
        fits.append(len(fits))
        return settle(self, *args)

    monkeypatch.setattr(FingertipMeter, "_settle", counted)
    tracker = Tracker(make_camera(PAPER_LENS), box_gripper(sharp=False), MonitorSettings())
    pose, needed = nominal_cam_T_grip(), []
    for number, frame in enumerate(frames):
        before = len(fits)
        found = tracker.measure(frame, pose, number / 30.0)
        needed.append(len(fits) - before)
        assert found.trusted and abs(found.jaw_opening_m - opening_m) < 2e-4
        pose = found.cam_T_grip
    assert needed[0] > 1 and set(needed[1:]) == {1}, needed
    # Moved on without a word: looked for from there.
    other = rendered(Scenario(name="other", duration_s=0.1, fps=30.0, jaw=JawScript(knots=((0.0, 0.034),))))[0][0]
    found = tracker.measure(replaced(other, jaw_opening_m=None), pose, 1.0)
    assert found.trusted and abs(found.jaw_opening_m - 0.034) < 2e-4


LOOKS, MOST_LOOKS = 4, 6
"""At an image while nothing is seen of the gripper: usually, and where places that a search has found are followed."""


def test_frames_without_the_gripper_are_answered_after_few_looks(monkeypatch: pytest.MonkeyPatch):
    """At the expected place, where it proved to be, at the reference and with another zoom, once each."""
    frames, _ = frames_of("static")
    random = np.random.default_rng(1)
    monitor, looks = new_monitor(), []
    look = FingertipMeter._look

    def counted(self: FingertipMeter, *args: object) -> object:
        looks.append(self)
        return look(self, *args)

    monkeypatch.setattr(FingertipMeter, "_look", counted)
    needed = []
    for number, frame in enumerate(frames[:60]):
        if number >= 5:
            frame = replaced(frame, image=random.integers(0, 256, frame.image.shape, dtype=np.uint8))
        looks.clear()
        monitor.process(frame)
        if number > 5:  # past the one search that is done in its frame
            needed.append(len(looks))
        monitor.run_pending()
    assert max(needed) <= MOST_LOOKS and sorted(needed)[len(needed) // 2] <= LOOKS, needed
