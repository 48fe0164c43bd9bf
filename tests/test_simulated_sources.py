"""The simulated camera: the simulator's pictures in real time, from processes that never outlive their parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import psutil
import pytest
from support.counting_maker import SHAPE, CountingMaker

from gripmon.daemon.config import read_gripper
from gripmon.io.sources import (
    SimulatedSettings,
    SourceError,
    Waiting,
    make_simulator,
    open_source,
)
from gripmon.io.sources.realtime import SimulatedCamera, _Schedule
from gripmon.io.sources.simulated import SimulatedSequence
from gripmon.model.camera import PaperLens, make_camera
from gripmon.model.geometry import exp_rotation, make_transform
from gripmon.model.records import Frame
from gripmon.simulate import Rig, make_scenario

ROOT = Path(__file__).resolve().parent.parent


def counting_camera(fps: float = 50.0, processes: int = 1, frame_count: int | None = None, **maker) -> SimulatedCamera:
    return SimulatedCamera(
        CountingMaker(**maker),
        size_px=SHAPE[::-1],
        fps=fps,
        name="counting",
        frame_count=frame_count,
        processes=processes,
    )


@pytest.fixture
def cameras() -> Iterator[list[SimulatedCamera]]:
    opened: list[SimulatedCamera] = []
    yield opened
    for camera in opened:
        camera.close()


@pytest.fixture(scope="module")
def scene() -> Rig:
    lens = PaperLens(width_px=192, height_px=144, fx_px=240.5, fy_px=240.5, cx_px=95.5, cy_px=71.5, kappa_per_px2=3e-6)
    tilted = make_transform(exp_rotation(np.array([0.55, 0.0, 0.0])), np.array([0.0, 0.0, 0.12]))
    return Rig(make_camera(lens), read_gripper(ROOT / "configs/grippers/two_box_fingers.yaml"), tilted)


def frames_of(camera: SimulatedCamera, count: int) -> list[Frame]:
    frames = []
    while len(frames) < count:
        item = camera.read()
        assert item is not None
        if isinstance(item, Frame):
            frames.append(item)
    return frames


# --- which frame comes next ---


@pytest.mark.parametrize(
    ("first", "step", "index", "elapsed_frames", "expected"),
    [
        (0, 1, 0, 0.0, 1),
        (0, 1, 0, 1.9, 1),
        (0, 1, 0, 2.1, 2),
        (0, 1, 4, 9.5, 9),
        (0, 2, 0, 0.5, 2),
        (0, 2, 0, 2.9, 2),
        (0, 2, 0, 3.1, 4),
        (1, 2, 1, 3.9, 3),
        (1, 2, 1, 8.0, 9),
        (2, 3, 5, 11.5, 11),
        (2, 3, 5, 12.0, 14),
    ],
)
def test_frames_whose_time_is_over_are_left_out(
    first: int, step: int, index: int, elapsed_frames: float, expected: int
):
    schedule = _Schedule(64.0, first, step, None)  # a rate without rounding
    following = schedule.following(index, elapsed_frames / 64.0)
    assert following == expected
    assert following % step == first and following > index and following >= int(elapsed_frames)


# --- real time ---


@pytest.mark.parametrize("processes", [1, 2])
def test_a_frame_is_its_number_and_comes_when_it_is_due(cameras: list[SimulatedCamera], processes: int):
    before_ns = time.time_ns()
    cameras.append(counting_camera(processes=processes))
    camera = cameras[0]
    assert camera.live and camera.connected and len(camera.pids) == processes
    last = -1
    start_ns: int | None = None
    for _ in range(12):
        frame = frames_of(camera, 1)[0]
        now_ns = time.time_ns()
        assert frame.image is not None
        np.testing.assert_array_equal(frame.image, np.full(SHAPE, frame.seq % 251, np.uint8))
        assert frame.jaw_opening_m == 1e-3 * frame.seq and frame.name == "counting"
        assert frame.seq > last
        assert before_ns < frame.stamp_ns <= now_ns
        start_ns = frame.stamp_ns - 20_000_000 * frame.seq if start_ns is None else start_ns
        assert frame.stamp_ns == start_ns + 20_000_000 * frame.seq
        last = frame.seq
    assert camera.dropped == last + 1 - 12


def test_the_newest_wins_and_the_others_are_counted(cameras: list[SimulatedCamera]):
    cameras.append(counting_camera(fps=100.0, processes=2))
    first = frames_of(cameras[0], 1)[0]
    before = cameras[0].dropped
    time.sleep(0.3)
    later = frames_of(cameras[0], 1)[0]
    assert later.seq - first.seq > 10
    assert cameras[0].dropped - before == later.seq - first.seq - 1


def test_it_ends_after_its_last_frame(cameras: list[SimulatedCamera]):
    cameras.append(counting_camera(fps=40.0, processes=2, frame_count=7))
    seqs = []
    while (item := cameras[0].read()) is not None:
        assert isinstance(item, Frame)
        seqs.append(item.seq)
    assert seqs == sorted(set(seqs)) and set(seqs) <= set(range(7))
    assert cameras[0].read() is None and not cameras[0].connected


def test_a_slow_renderer_leaves_frames_out(cameras: list[SimulatedCamera]):
    cameras.append(counting_camera(fps=200.0, pause_s=0.03))
    frames = frames_of(cameras[0], 6)
    steps = np.diff([f.seq for f in frames])
    assert (steps[1:] >= 5).all()  # 0.03 s are 6 frame periods; the first that is late still is shown
    assert cameras[0].dropped == frames[-1].seq + 1 - 6
    assert all(f.image is not None and f.image[0, 0] == f.seq % 251 for f in frames)


def test_waiting_between_frames_that_are_far_apart(cameras: list[SimulatedCamera]):
    cameras.append(counting_camera(fps=0.1))
    assert frames_of(cameras[0], 1)[0].seq == 0
    item = cameras[0].read()
    assert isinstance(item, Waiting) and "counting" in item.reason


def test_nobody_reads_for_long_and_the_renderer_goes_on(cameras: list[SimulatedCamera]):
    """More announcements than a pipe holds: the renderer doesn't block, and a current frame still is found."""
    cameras.append(counting_camera(fps=20_000.0))
    camera = cameras[0]
    frames_of(camera, 1)
    time.sleep(1.0)
    caught_up = frames_of(camera, 3)
    assert all(f.image is not None and f.image[0, 0] == f.seq % 251 for f in caught_up)
    assert caught_up[-1].seq + 1 - 4 == camera.dropped


# --- failures and ends ---


def test_a_maker_that_can_make_nothing_is_refused_at_the_start():
    before = set(psutil.Process().children())  # other tests may have left some
    with pytest.raises(SourceError, match=r"scenario: can't be rendered \(ArithmeticError: no picture 0\)"):
        counting_camera(fails_at=0)
    assert set(psutil.Process().children()) <= before


def test_a_failure_later_surfaces_in_the_reader(cameras: list[SimulatedCamera]):
    cameras.append(counting_camera(fails_at=4))
    with pytest.raises(RuntimeError, match="ArithmeticError: no picture 4"):
        frames_of(cameras[0], 6)


def test_a_renderer_that_dies_surfaces_in_the_reader(cameras: list[SimulatedCamera]):
    cameras.append(counting_camera(processes=2))
    frames_of(cameras[0], 2)
    os.kill(cameras[0].pids[1], signal.SIGKILL)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="exit code -9"):
            frames_of(cameras[0], 100)


def test_close_ends_processes_and_a_read_under_way():
    camera = counting_camera(fps=0.1, processes=2)
    frames_of(camera, 1)
    got: list[object] = []
    reader = threading.Thread(target=lambda: got.append(camera.read()))
    reader.start()
    camera.close()
    camera.close()
    reader.join(60.0)
    assert got == [None] or isinstance(got[0], Waiting)
    assert camera.read() is None and not camera.connected
    assert not any(psutil.pid_exists(pid) for pid in camera.pids)


CHILD_SCRIPT = """
import signal, sys, time
sys.path.insert(0, {tests!r})
from test_simulated_sources import counting_camera, frames_of
hits = []
signal.signal(signal.SIGINT, lambda *_: hits.append(1))
camera = counting_camera(processes=2)
print(*camera.pids, flush=True)
while not hits:
    frames_of(camera, 1)
frames_of(camera, 5)
camera.close()
print("closed", flush=True)
"""


@pytest.fixture
def started(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A process group of its own with a camera in it, and the renderers' process ids."""
    script = tmp_path / "script.py"
    script.write_text(CHILD_SCRIPT.format(tests=str(ROOT / "tests")))
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert process.stdout is not None
    try:
        yield process, [int(pid) for pid in process.stdout.readline().split()]
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_ctrl_c_is_left_to_the_parent(started: tuple[subprocess.Popen[str], list[int]]):
    process, pids = started
    assert len(pids) == 2
    os.killpg(process.pid, signal.SIGINT)
    out, _ = process.communicate(timeout=120.0)
    assert (process.returncode, out) == (0, "closed\n")


def test_renderers_end_when_their_parent_is_killed(started: tuple[subprocess.Popen[str], list[int]]):
    process, pids = started
    renderers = [psutil.Process(pid) for pid in pids]
    process.kill()
    _, alive = psutil.wait_procs(renderers, timeout=120.0)
    assert len(renderers) == 2 and not alive


# --- the simulator behind it ---


def test_the_sequence_is_the_scenario_frame_by_frame(scene: Rig):
    settings = SimulatedSettings(scenario="bump", duration_s=0.5, fps=10.0, seed=3, realtime=False)
    source = open_source(settings, scene=scene)
    assert isinstance(source, SimulatedSequence) and not source.live and len(source) == 5
    simulator = make_simulator(settings, scene, Path())
    for index in range(5):
        frame, expected = source.read(), simulator.frame(index)
        assert frame is not None and frame.seq == index
        np.testing.assert_array_equal(frame.image, expected.image)
        assert (frame.stamp_ns, frame.jaw_opening_m) == (expected.stamp_ns, expected.jaw_opening_m)
        assert frame.stamp_ns == simulator.scenario.start_ns + 100_000_000 * index
    assert source.read() is None and source.read() is None
    source.close()


def test_a_scenario_from_a_file(scene: Rig, tmp_path: Path):
    scenario = make_scenario("creep", duration_s=1.0, fps=20.0)
    (tmp_path / "mine.yaml").write_bytes(msgspec.yaml.encode(scenario))
    simulator = make_simulator(SimulatedSettings(scenario="mine.yaml"), scene, tmp_path)
    assert simulator.scenario == scenario and simulator.frame_count == 20


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (SimulatedSettings(scenario="earthquake"), "there is no 'earthquake'; one of demo"),
        (SimulatedSettings(scenario="series1", fps=5.0), "series1"),
        (SimulatedSettings(scenario="absent.yaml"), "absent.yaml can't be used"),
        (SimulatedSettings(scenario="typo.yaml"), "typo.yaml can't be used .*foo"),
        (SimulatedSettings(scenario="typo.yaml", fps=5.0), "has its own duration_s and fps"),
        (SimulatedSettings(scenario="misfit.yaml"), "bent_fingers: there is no finger 'thumb'"),
    ],
)
def test_scenarios_that_can_not_be_are_refused_in_one_line(
    scene: Rig, tmp_path: Path, settings: SimulatedSettings, complaint: str
):
    (tmp_path / "typo.yaml").write_text("name: x\nfoo: 3\n")
    (tmp_path / "misfit.yaml").write_text("bent_fingers: [{finger: thumb, tip_shift_m: [0.001, 0, 0]}]\n")
    with pytest.raises(SourceError, match=rf"^scenario: .*{complaint}") as refused:
        open_source(settings, tmp_path, scene=scene)
    assert "\n" not in str(refused.value) and "; " in str(refused.value)


def test_without_a_scene_there_is_nothing_to_simulate():
    with pytest.raises(SourceError, match="scene"):
        open_source(SimulatedSettings())
