"""The demo runs at a pace that the machine keeps; a run that measured too little says so before anything else."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import msgspec
import numpy as np
import pytest

from gripmon.daemon import pace
from gripmon.daemon.simulated import at_own_pace, demo_config
from gripmon.io.sources import SimulatedSettings
from gripmon.io.sources.realtime import SimulatedCamera
from gripmon.model.coverage import LEAST_SHARE, too_few
from gripmon.model.priority import NICENESS, give_way, real_time, stand_beside
from gripmon.model.records import Frame
from gripmon.monitor import warm_up


@pytest.mark.parametrize(
    ("possible_hz", "fps", "live"),
    [(200.0, 60.0, True), (120.0, 60.0, True), (119.0, 30.0, True), (59.0, 15.0, True), (29.0, 15.0, False)],
)
def test_the_fastest_pace_with_a_margin_is_chosen(possible_hz: float, fps: float, live: bool):
    chosen = pace.pace_for(possible_hz)
    assert (chosen.fps, chosen.live) == (fps, live)
    assert (f"{possible_hz:.0f} frames/s: the camera runs at {fps:g} frames/s" in chosen.text()) == live
    assert ("too few for a live camera" not in chosen.text()) == live


def test_a_machine_that_renders_hardly_anything_is_not_said_to_render_nothing():
    assert "renders and processes less than 1 frames/s, too few" in pace.pace_for(0.4).text()


@dataclasses.dataclass
class Slow:
    """Frames that take a while each, without load."""

    takes_s: float

    def frame(self, index: int) -> Frame:
        time.sleep(self.takes_s)
        return Frame(index, index, np.zeros((576, 768), np.uint8), 0.02, "slow")

    frame_count = 1200


def test_what_can_be_rendered_is_measured():
    """Two renderers that take 80 ms for a frame make 25 frames/s together, at most."""
    warm_up()
    config = demo_config(20.0)
    measured = pace.measure_pace(config, Slow(0.08), 2)  # type: ignore[arg-type]
    assert 2.0 < measured.possible_hz < 26.0
    assert measured.fps == 15.0


@pytest.mark.parametrize("live", [True, False])
def test_the_demo_takes_the_measured_rate_and_nothing_else(monkeypatch: pytest.MonkeyPatch, live: bool):
    monkeypatch.setattr(pace, "measure_pace", lambda *_: pace.Pace(30.0, 50.0, live))
    config = demo_config(20.0, seed=7)
    slower, _ = at_own_pace(config)
    source = slower.settings.source
    assert isinstance(source, SimulatedSettings) and isinstance(config.settings.source, SimulatedSettings)
    assert source == msgspec.structs.replace(config.settings.source, fps=30.0, realtime=live)


def test_a_thread_gives_way_alone():
    """Linux has a niceness for each thread; the loop's stays."""
    before, seen = os.getpriority(os.PRIO_PROCESS, threading.get_native_id()), []

    def work() -> None:
        give_way()
        seen.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [min(before + NICENESS, 19)]
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == before


def _policies(*names: str) -> dict[str, tuple[int, int]]:
    """Scheduling policy and real-time priority of threads; others may end meanwhile."""
    threads = [(each.name, each.native_id or 0) for each in threading.enumerate() if each.name in names]
    return {name: (os.sched_getscheduler(tid), os.sched_getparam(tid).sched_priority) for name, tid in threads}


def test_real_time_puts_the_loop_above_its_helpers_and_those_above_other_programs():
    """The real system call; where the system doesn't allow it, it says what would."""
    go_on, seen = threading.Event(), dict[str, tuple[int, int]]()
    before = threading.Thread(target=go_on.wait, name="before")
    before.start()
    calling = threading.current_thread().name
    try:
        with real_time() as (given, said), ThreadPoolExecutor(1, "analysis", stand_beside) as pool:
            pool.submit(lambda: None).result()
            seen = _policies(calling, "before", "analysis_0")
            way = pool.submit(lambda: (give_way(), os.sched_getscheduler(threading.get_native_id()))[1]).result()
        after = _policies(calling, "before")
    finally:
        go_on.set()
        before.join()
    assert {after[calling], after["before"]} == {(os.SCHED_OTHER, 0)} and way == os.SCHED_OTHER
    if given:
        assert said.startswith("real-time priority 2 for the loop, 1 for what works beside it; cores ")
        assert seen[calling] == (os.SCHED_RR, 2)
        assert seen["before"] == seen["analysis_0"] == (os.SCHED_RR, 1)
    else:
        assert "refused it" in said and {*seen.values()} == {(os.SCHED_OTHER, 0)}


@pytest.mark.skipif(os.getuid() != 0, reason="only root may become somebody without privileges")
def test_without_the_privilege_the_log_says_what_would_be_right():
    code = (
        "import os, resource, gripmon.model.priority as p; resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0));"
        "os.setgid(65534); os.setuid(65534); c = p.real_time(); print(*c.__enter__(), os.sched_getscheduler(0))"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said == (
        "False real-time priority was asked for, and the system refused it (Operation not permitted): allow priority "
        "2, by LimitRTPRIO=2 of the service, or ulimit -r 2 0\n"
    )


def test_renderers_give_way():
    here = os.getpriority(os.PRIO_PROCESS, 0)
    camera = SimulatedCamera(Slow(0.0), size_px=(768, 576), fps=30.0, name="slow", processes=2)
    try:
        assert [os.getpriority(os.PRIO_PROCESS, pid) for pid in camera.pids] == [min(here + NICENESS, 19)] * 2
    finally:
        camera.close()


def test_nine_in_ten_are_enough():
    assert too_few(90, dropped=10) == too_few(0) == ""
    assert too_few(89, dropped=11) and LEAST_SHARE == 0.9


@pytest.mark.parametrize(
    ("lost", "reasons"),
    [
        ({"dropped": 1161}, "1161 dropped, because this machine was too slow"),
        ({"refused": 3, "unseen": 50}, "50 in which the gripper was not found, 3 refused"),
        ({"missing": 4, "unmeasured": 20}, "20 in which nothing could be measured, 4 missing"),
    ],
)
def test_the_commonest_reason_comes_first(lost: dict[str, int], reasons: str):
    said = too_few(27, **lost)
    assert said.startswith(f"only 27 of {27 + sum(lost.values())} frames were measured ({reasons}")
    assert said.endswith("the figures mean little" if sum(lost.values()) > 27 else "the figures are of these alone")
