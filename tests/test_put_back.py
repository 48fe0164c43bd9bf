"""Putting the camera back by hand: which way is right, in words, and obeying them ends within the alert limit.

The camera is moved here by its position and its three directions in the gripper's frame, not by the product's algebra.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterator
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from support.commanded import Loop
from support.loopback import frame_record, free_endpoint
from support.meters import box_gripper
from support.published import Published
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.watched import pose_of, reference_of

from gripmon.cli import main
from gripmon.daemon.mount import at_reference, mount_of, to_stand_at
from gripmon.io.wire import PublishSettings
from gripmon.model.camera import make_camera
from gripmon.model.geometry import to_record
from gripmon.model.mount import moves, summary
from gripmon.model.records import CommandName, CommandReply, FrameRecord, Mount, Origin, Verdict
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.simulate import Scenario, paper_rig

LIMITS = 1e-3, math.radians(2.0)


class Eye(NamedTuple):
    """Where a camera is and which way it looks, (3,) each in the gripper's frame."""

    at_m: np.ndarray
    right: np.ndarray
    down: np.ndarray
    forward: np.ndarray

    @property
    def cam_T_grip(self) -> np.ndarray:
        out = np.eye(4)
        out[:3, :3] = [self.right, self.down, self.forward]
        out[:3, 3] = -out[:3, :3] @ self.at_m
        return out

    def moved(self, words: str) -> Eye:
        """As somebody does who is told ``shift up 0.30 mm`` or ``turn right 0.40°``."""
        what, way, amount = re.fullmatch(r"(shift|turn) (\w+) ([\d.]+)(?: mm|°)", words).groups()  # type: ignore[union-attr]
        at_m, right, down, forward = self
        size = 1e-3 * float(amount) if what == "shift" else math.radians(float(amount))
        c, s = math.cos(size), math.sin(size)
        if what == "shift":
            along = {"right": right, "left": -right, "down": down, "up": -down, "forward": forward, "back": -forward}
            return self._replace(at_m=at_m + size * along[way])
        if way in ("left", "down", "anticlockwise"):
            s = -s
        if way in ("right", "left"):  # the view goes to that side
            return self._replace(forward=c * forward + s * right, right=c * right - s * forward)
        if way in ("up", "down"):
            return self._replace(forward=c * forward - s * down, down=c * down + s * forward)
        # Clockwise, seen from behind: its right side goes down.
        return self._replace(right=c * right + s * down, down=c * down - s * right)


def eye_of(cam_T_grip: np.ndarray) -> Eye:
    turn = cam_T_grip[:3, :3]
    return Eye(-turn.T @ cam_T_grip[:3, 3], *turn)


def mount(eye: Eye, home: np.ndarray, **changes: object) -> Mount:
    record = frame_record(cam_T_grip=to_record(eye.cam_T_grip), source=Origin.UPDATE, **changes)  # type: ignore[arg-type]
    return mount_of(record, reference_of(home), *LIMITS)


WAYS = {
    "shift left": "shift right", "shift up": "shift down", "shift back": "shift forward",
    "turn left": "turn right", "turn up": "turn down", "turn clockwise": "turn anticlockwise",
}  # fmt: skip
BOTH_WAYS = WAYS | {there: back for back, there in WAYS.items()}
UPSIDE_DOWN = np.diag([-1.0, -1.0, 1.0, 1.0]) @ nominal_cam_T_grip()


@pytest.mark.parametrize("home", [nominal_cam_T_grip(), UPSIDE_DOWN], ids=["upright", "upside down"])
@pytest.mark.parametrize(("moved", "back"), BOTH_WAYS.items())
def test_a_mount_that_is_moved_one_way_is_to_be_moved_the_other_way(home: np.ndarray, moved: str, back: str):
    amount = "2.20 mm" if moved.startswith("shift") else "2.20°"
    told = mount(eye_of(home).moved(f"{moved} {amount}"), home)
    first, *others = sorted(moves(told), key=lambda move: -abs(move.share))
    assert first.text == f"{back} {amount}"
    assert all(move.text.endswith(" 0") and move.done for move in others)
    assert not told.placed and summary(told).startswith(f"{back} {amount} first: the TCP is ")


def test_what_is_said_is_what_a_person_sees_in_the_picture():
    """A far point ahead goes to the left of the picture when the camera turns to the right, and so on."""
    home, camera = eye_of(nominal_cam_T_grip()), make_camera(PAPER_LENS)
    far_m = home.at_m + 50.0 * home.forward
    for words, (u, v) in {"turn right": (-1, 0), "turn left": (1, 0), "turn up": (0, 1), "turn down": (0, -1)}.items():
        pixels = []
        for eye in (home, home.moved(f"{words} 1.0°")):
            pose = eye.cam_T_grip
            pixels.append(camera.project((pose[:3, :3] @ far_m + pose[:3, 3])[None])[0])
        moved = pixels[1] - pixels[0]
        assert np.sign(np.where(np.abs(moved) > 1.0, moved, 0.0)).tolist() == [u, v], words


def test_the_limit_of_a_turn_is_what_it_moves_the_tcp_by():
    home = nominal_cam_T_grip()
    told = mount(eye_of(home), home)
    assert told.placed and told.turn_limits_rad is not None
    for axis, way in enumerate(("turn up", "turn right", "turn clockwise")):
        limit_deg = math.degrees(told.turn_limits_rad[axis])
        for factor, within in ((0.98, True), (1.02, False)):
            turned = mount(eye_of(home).moved(f"{way} {factor * limit_deg:.5f}°"), home)
            assert turned.within is within and moves(turned)[3 + axis].done is within
    assert math.degrees(told.turn_limits_rad[2]) == pytest.approx(2.0)  # it rolls about the TCP: by its own limit


def test_in_place_is_only_said_of_what_is_certain():
    home = nominal_cam_T_grip()
    near = eye_of(home).moved("shift up 0.90 mm")
    assert mount(near, home).placed and summary(mount(near, home)).startswith("in place: the TCP is 0.90 mm off")
    unsure = mount(near, home, verdict=Verdict.SUSPECT, reason="first after a jump")
    assert not unsure.placed
    assert summary(unsure) == "within the limits, but not certain: first after a jump"
    held = frame_record(cam_T_grip=to_record(near.cam_T_grip), source=Origin.HELD, verdict=Verdict.SUSPECT)
    told = mount_of(msgspec.structs.replace(held, reason="hidden"), reference_of(home), *LIMITS)
    assert moves(told) == () and not told.placed  # it is of before somebody moved the camera
    assert summary(told) == "can't tell where the camera stands: hidden"
    assert summary(mount_of(None, reference_of(home), *LIMITS)).endswith("no frame comes")


def test_it_is_put_back_to_where_a_person_had_it_not_to_where_a_knock_left_it():
    configured = reference_of(nominal_cam_T_grip())
    made = msgspec.structs.replace(configured, reference_id="recalibration-2", revision=2, accepted_by="monitor")
    accepted = msgspec.structs.replace(configured, reference_id="recalibration-3", revision=3, accepted_by="operator")
    assert to_stand_at((configured, made, made)) == configured
    assert to_stand_at((configured, made, accepted, made)) == accepted
    assert to_stand_at((made,)) == made


def seen(monitor: Monitor, eye: Eye, clock: itertools.count[int], frames: int = 3) -> FrameRecord:
    """What the monitor says of pictures of a simulated gripper from there."""
    scene = paper_rig(box_gripper(sharp=False), eye.cam_T_grip).simulator(Scenario(name="static"), 1)
    for _ in range(frames):
        seq = next(clock)
        record = monitor.process(scene.frame(seq))
        monitor.run_pending()
    return record


def test_obeying_the_words_before_the_real_monitors_eyes_puts_it_back():
    home = nominal_cam_T_grip()
    reference, clock = reference_of(home), itertools.count()
    monitor = Monitor(make_camera(PAPER_LENS), box_gripper(sharp=False), MonitorSettings(), reference)
    seen(monitor, eye_of(home), clock, 6)
    for moved, back in WAYS.items():  # far enough to be outside, near enough to be followed
        amount = "1.30 mm" if moved.startswith("shift") else "2.20°" if "clockwise" in moved else "0.80°"
        record = seen(monitor, eye_of(home).moved(f"{moved} {amount}"), clock)
        told = mount_of(record, reference, *LIMITS)
        first = max(moves(told), key=lambda move: abs(move.share), default=None)
        assert first is not None and first.text.startswith(back) and not told.placed, (moved, summary(told))
    eye = eye_of(home)
    for words in ("turn right 0.9°", "turn up 0.6°", "turn clockwise 2.2°", "shift left 1.3 mm", "shift back 0.8 mm"):
        eye = eye.moved(words)
    for _looks in range(4):
        told = mount_of(seen(monitor, eye, clock), reference, *LIMITS)
        if told.placed:
            break
        for move in reversed(moves(told)):  # turns first
            if not move.text.endswith(" 0"):
                eye = eye.moved(move.text)
    assert told.placed, summary(told)
    off = pose_of(to_record(eye.cam_T_grip))[:3, 3] - home[:3, 3]
    assert np.linalg.norm(off) < 0.3e-3  # in truth, too


@pytest.fixture
def asked() -> Iterator[tuple[str, list[CommandReply]]]:
    """A monitor's endpoint, and its answer to every question: the last of the list."""
    endpoint, home = free_endpoint(), nominal_cam_T_grip()
    told = mount(eye_of(home).moved("turn left 1.50°").moved("shift up 0.30 mm"), home)
    replies = [CommandReply(CommandName.STATE, True, "", "factory-1", 1, mount=told)]
    monitor = Published(PublishSettings(listen=(endpoint,)), identified=True)
    loop = Loop(monitor.commands, lambda _: replies[-1])
    yield endpoint, replies
    loop.end()
    monitor.close()


def test_watch_shows_it_on_a_terminal_and_to_a_program(
    asked: tuple[str, list[CommandReply]], capsys: pytest.CaptureFixture[str]
):
    endpoint, replies = asked
    watch = ["watch", "--mount", "--connect", endpoint]
    assert main([*watch, "--once"]) == 0
    name, first, _, *bars = capsys.readouterr().out.splitlines()
    assert name == "arm/wrist, to stand as at factory-1 (revision 1)" and first.startswith("turn right 1.50° first: ")
    assert len(bars) == 9
    (turn,) = (line for line in bars if "turn right" in line)
    left, _, right = turn.partition("|")
    assert "█" in right and "█" not in left and " ok " not in turn
    (shift,) = (line for line in bars if "shift down 0.30 mm" in line)
    assert " ok shift down" in shift and "|█" in shift
    assert main([*watch, "--once", "--json", "--robot", "arm"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [move["done"] for move in told["moves"]] == [True, True, True, True, False, True]
    assert not told["placed"] and told["mount"]["turn_rad"][1] == pytest.approx(math.radians(1.5), rel=1e-3)

    made = msgspec.structs.replace(replies[0], reference_id="recalibration-2", revision=2)
    replies.append(made)
    assert main([*watch, "--seconds", "1", "--period", "0.1"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1  # said once, since nothing changes
    assert main([*watch, "--once"]) == 0
    after = capsys.readouterr().out.splitlines()[-1]
    assert after.endswith("gripmon send undo factory-1 --robot arm --camera wrist")


def test_watch_says_what_keeps_it_from_telling(
    asked: tuple[str, list[CommandReply]], capsys: pytest.CaptureFixture[str]
):
    endpoint, replies = asked
    watch = ["watch", "--mount", "--once", "--seconds", "0.1", "--connect"]

    def refused(*arguments: str) -> str:
        assert main([*watch, endpoint, *arguments]) == 3
        return capsys.readouterr().err

    replies.append(msgspec.structs.replace(replies[0], mount=mount_of(None, reference_of(UPSIDE_DOWN), *LIMITS)))
    assert refused() == "watch: arm/wrist: can't tell where the camera stands: no frame comes\n"
    replies.append(msgspec.structs.replace(replies[0], mount=None))
    assert "it doesn't say how its camera is mounted" in refused()
    assert refused("--robot", "leg").startswith("watch: no monitor is on the network; ")
    assert main(["watch", "--robot", "arm", "--connect", endpoint]) == 2
    assert main([*watch, endpoint, "--alerts"]) == 2
    assert capsys.readouterr().err.count("\n") == 2


def test_the_outline_is_drawn_where_the_gripper_will_be_seen():
    home = nominal_cam_T_grip()
    eye = eye_of(home).moved("turn right 1.0°").moved("shift up 1.0 mm")
    record = frame_record(cam_T_grip=to_record(eye.cam_T_grip), source=Origin.UPDATE, absolute=None)
    np.testing.assert_allclose(at_reference(record, reference_of(home)), home, atol=1e-12)
