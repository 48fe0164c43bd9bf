"""What the monitor's ROS 2 does by itself, without ROS: settings, a missing rclpy, commands, diagnostics, joints."""

from __future__ import annotations

import math
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.configurations import demo_in
from support.loopback import frame_record, state_record, wait_until

from gripmon.cli import main
from gripmon.daemon.config import builtin_config
from gripmon.daemon.config.settings import Settings
from gripmon.daemon.config.typed import to_settings
from gripmon.io.publish.commands import PendingCommand
from gripmon.io.ros2 import output as output_module
from gripmon.io.ros2.diagnostics import ERROR, OK, STALE, WARN, level_of, summary_of, values_of
from gripmon.io.ros2.node import Ros2Missing, check_rclpy, domain_of
from gripmon.io.ros2.output import Ros2Output, inverse
from gripmon.io.ros2.settings import Ros2Settings, as_token
from gripmon.io.sources.payload import PayloadError, message_image
from gripmon.model.geometry import from_record, invert, make_transform, to_record
from gripmon.model.jaw import JawError, JointOpening, positions_by_joint
from gripmon.model.records import (
    AlertKind,
    Cause,
    CommandName,
    CommandReply,
    Severity,
    StandingAlert,
    State,
    Verdict,
)

CAMERA = {"kind": "ros2", "image": "/eye"}
JOINTS = {"joint_states": "/joints", "opening": {"joints": ["finger"]}}


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        ({"source": {"kind": "ros2"}}, "source.image: is missing; text: topic of the images"),
        ({"source": CAMERA | {"image": "eye"}}, "source.image: is 'eye'; text: topic of the images"),
        ({"source": CAMERA | {"domain_id": 233}}, "source.domain_id: is 233; a whole number >= 0 and <= 232"),
        ({"source": CAMERA | {"joint_states": "/j"}}, "source.opening: is missing; a section: joints (their names)"),
        ({"source": CAMERA | {"opening": {"joints": ["f"]}}}, "source.joint_states: is missing; the topic of"),
        ({"source": CAMERA | JOINTS}, "source.joint_states: has no effect with jaw.source fixed; jaw.source: frames"),
        ({"source": CAMERA, "jaw": {"source": "frames"}}, "a source without joint_states and opening brings no jaw"),
        ({"ros2": {"enabled": True, "node": "2"}}, "ros2.node: is '2'; text (name of the node"),
        ({"ros2": {"enabled": True, "namespace": "arm"}}, "ros2.namespace: is 'arm'; text"),
        ({"ros2": {"enabled": True, "tf_topic": "/tf/"}}, "ros2.tf_topic: is '/tf/'; text: name of a topic"),
        ({"ros2": {"enabled": True, "publish": "gripper_from_camera"}}, "ros2.parent_frame: is not given, and"),
        ({"ros2": {"enabled": True, "child_frame": "wrist_optical_frame"}}, "the parent's name, too; a frame of its"),
        (
            {"source": {"kind": "zenoh", "topic": "/eye", "format": "ros2_image"}},
            "source.topic: is gone: ROS 2 is spoken by rclpy now; source: {kind: ros2, image: /the/topic}",
        ),
    ],
)
def test_settings_that_can_not_be(
    sections: dict[str, object], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    sections = {"jaw": {"source": "fixed"}} | sections
    assert main(["check", str(demo_in(tmp_path, **sections))]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1) and said in err


def test_an_earlier_configurations_router_is_told_and_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    from gripmon.daemon.config import load_config

    config = load_config(demo_in(tmp_path, ros2={"router": "tcp/127.0.0.1:7447", "node": "watch"}))
    assert config.settings.ros2 == Ros2Settings(node="watch")
    assert "ros2.router: rclpy finds ROS 2's nodes without it; remove the key" in caplog.text


def test_names_and_frames_follow_from_ours():
    named = Ros2Settings().named("arm-1", "2nd")
    assert (named.namespace, named.pose_topic) == ("/arm_1/_2nd", "~/cam_T_grip")
    assert (named.parent_frame, named.child_frame) == ("2nd_optical_frame", "arm-1_2nd_gripmon")
    assert as_token("Übung") == "_bung"
    given = Ros2Settings(namespace="/", parent_frame="a", child_frame="b", pose_topic="/p")
    assert given.named("arm", "wrist") == given
    # All of it is read from a file.
    demo = yaml.safe_load(builtin_config("demo.yaml").read_text())
    assert to_settings(demo | {"ros2": msgspec.json.decode(msgspec.json.encode(named))}, Settings).ros2 == named


def import_from(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Only rclpy of a folder is found, or none."""
    for name in [name for name in sys.modules if name.partition(".")[0] in ("rclpy", "sensor_msgs")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delenv("RMW_IMPLEMENTATION", raising=False)
    without = [each for each in sys.path if not (Path(each or ".") / "rclpy").exists()]
    monkeypatch.setattr(sys, "path", [*without, str(folder)])


def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], **sections: object) -> str:
    """The one line of check and of run."""
    path, lines = str(demo_in(tmp_path, **sections)), []
    for command in (["check", path], ["run", path, "--duration", "1"]):
        assert main(command) == 2
        lines.append(capsys.readouterr().err)
    assert lines[0] == lines[1] and lines[0].count("\n") == 1
    return lines[0]


def test_without_rclpy_one_line_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    import_from(monkeypatch, tmp_path)
    for key, sections in (
        ("source.kind", {"source": CAMERA, "jaw": {"source": "fixed"}}),
        ("ros2.enabled", {"ros2": {"enabled": True}}),
    ):
        line = refused(tmp_path, capsys, **sections)
        assert f"{key}: needs rclpy, which {sys.executable} doesn't have; an environment that sees the robot's" in line
        assert "python3 -m venv --system-site-packages" in line and "pip install '.[ros2]'" in line


def test_an_rclpy_of_another_python_or_without_messages_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "rclpy"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "_rclpy_pybind11.cpython-38-x86_64-linux-gnu.so").touch()
    import_from(monkeypatch, tmp_path)
    wrong = rf"the rclpy in {folder} is of another Python \(.*cpython-38.*, this one is 3\.\d+; that Python, or an env"
    with pytest.raises(Ros2Missing, match=wrong):
        check_rclpy()
    (folder / "_rclpy_pybind11.cpython-38-x86_64-linux-gnu.so").unlink()
    (folder / "__init__.py").write_text("raise RuntimeError('librcl.so:\\n not found')")
    with pytest.raises(Ros2Missing, match=r"^rclpy can't be imported \(librcl.so: not found\); an environment"):
        check_rclpy()
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_nowhere_cpp")
    with pytest.raises(Ros2Missing, match="RMW_IMPLEMENTATION is rmw_nowhere_cpp, which this rclpy can't load"):
        check_rclpy()


def test_the_domain_is_the_configurations_else_the_environments(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    assert domain_of(None) == 0
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    assert (domain_of(None), domain_of(0)) == (7, 0)
    for wrong in ("233", "-1", "seven"):
        monkeypatch.setenv("ROS_DOMAIN_ID", wrong)
        with pytest.raises(Ros2Missing, match=rf"ROS_DOMAIN_ID is {wrong}; 0 to 232"):
            domain_of(None)


@pytest.fixture
def output(monkeypatch: pytest.MonkeyPatch) -> Ros2Output:
    """Without a node; only its commands are used."""
    monkeypatch.setattr(output_module, "RosNode", lambda *_: SimpleNamespace(fault=str, close=bool))
    output = Ros2Output(Ros2Settings(), "arm", "wrist", others=lambda: tuple(output.twins))
    output.twins = []
    yield output
    output.close()


def asked(output: Ros2Output, name: CommandName) -> tuple[threading.Thread, SimpleNamespace]:
    """A service's caller, and the response that it will have."""
    response = SimpleNamespace(success=False, message="")
    thread = threading.Thread(target=output._serve, args=(name, None, response))
    thread.start()
    return thread, response


def next_of(output: Ros2Output) -> PendingCommand:
    """The next command, once it has come."""
    found: list[PendingCommand | None] = []
    wait_until(lambda: found.append(output.poll()) or found[-1], "a command")
    assert found[-1] is not None
    return found[-1]


def test_a_service_is_answered_by_the_loop(output: Ros2Output):
    for done in (True, False):
        caller, response = asked(output, CommandName.ACCEPT)
        taken = next_of(output)
        assert (taken.command.name, taken.command.argument) == (CommandName.ACCEPT, "")
        taken.answer(CommandReply(CommandName.ACCEPT, done, "said so", "plate-2", 4))
        caller.join()
        assert (response.success, response.message) == (done, "said so")


def test_what_nobody_waits_for_any_more_is_not_carried_out(output: Ros2Output, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(output_module, "TIMEOUT_S", 0.05)
    caller, response = asked(output, CommandName.UNDO)
    caller.join()
    assert not response.success and response.message.endswith("within 0.05 s; it is not carried out")
    assert output.poll() is None
    # One that the loop has begun is answered to nobody.
    monkeypatch.setattr(output_module, "TIMEOUT_S", 0.5)
    caller, response = asked(output, CommandName.UNDO)
    taken = next_of(output)
    caller.join()
    assert response.message.endswith("it may still be carried out, ask for the state")
    taken.answer(CommandReply(CommandName.UNDO, True, "late", "plate-2", 4))


def test_two_monitors_of_a_name_and_one_that_stops_carry_out_nothing(output: Ros2Output):
    output.twins = ["0af3"]
    caller, response = asked(output, CommandName.RESET)
    caller.join()
    assert "0af3" in response.message and not response.success and output.poll() is None
    output.twins = []
    caller, response = asked(output, CommandName.RESET)
    wait_until(lambda: output._asked._waiting, "the command")
    output.close()  # one that waits already, and one that comes later
    caller.join()
    later, response_later = asked(output, CommandName.RESET)
    later.join()
    for each in (response, response_later):
        assert "the monitor stops; the command is not carried out" in each.message and not each.success
    assert output.poll() is None


def test_the_covariance_of_the_inverse():
    """Against the scatter of inverted samples."""
    rng = np.random.default_rng(3)
    cam_T_grip = make_transform(Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([0.01, -0.02, 0.13]))
    root = 1e-3 * rng.normal(size=(6, 6))
    transform, covariance = inverse(to_record(cam_T_grip), (root @ root.T).ravel())
    np.testing.assert_allclose(from_record(transform), invert(cam_T_grip), atol=1e-12)
    errors = rng.normal(size=(100_000, 6)) @ root.T
    turned = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ cam_T_grip[:3, :3]
    moved = cam_T_grip[:3, 3] + errors[:, :3]
    back = np.swapaxes(turned, 1, 2)
    place = -np.einsum("nij,nj->ni", back, moved) - invert(cam_T_grip)[:3, 3]
    turn = Rotation.from_matrix(back @ cam_T_grip[:3, :3]).as_rotvec()
    scatter = np.cov(np.hstack([place, turn]).T)
    scale = np.sqrt(np.diag(scatter))
    np.testing.assert_allclose(
        covariance.reshape(6, 6) / np.outer(scale, scale), scatter / np.outer(scale, scale), atol=0.02
    )


def alert(severity: Severity, *, acknowledged: bool = False) -> StandingAlert:
    return StandingAlert("7", AlertKind.DRIFT, severity, f"a {severity}", 5, acknowledged)


@pytest.mark.parametrize(
    ("changes", "alerts", "level"),
    [
        ({}, [], OK),
        ({}, [alert(Severity.INFO)], OK),
        ({}, [alert(Severity.WARNING)], WARN),
        ({}, [alert(Severity.WARNING, acknowledged=True)], OK),
        ({}, [alert(Severity.WARNING), alert(Severity.ERROR)], ERROR),
        ({"verdict": Verdict.SUSPECT}, [], WARN),
        ({"verdict": Verdict.UNKNOWN, "state": State.LOST}, [alert(Severity.WARNING)], ERROR),
        ({"verdict": Verdict.UNKNOWN, "state": State.STALE}, [alert(Severity.ERROR)], STALE),
        ({"message": "no jaw opening received"}, [], WARN),
    ],
)
def test_levels_of_diagnostics(changes: dict[str, object], alerts: list[StandingAlert], level: int):
    state = msgspec.structs.replace(state_record(), **changes)
    assert level_of(state, alerts) == level
    for text in [state.message, *(entry.text for entry in alerts)]:
        assert text in summary_of(state, alerts)


def test_values_of_diagnostics():
    frame = frame_record(0, reason="blurred")
    changes = {"stamp_ns": frame.stamp_ns + 250_000_000, "verdict": Verdict.SUSPECT, "tcp_shift_m": (1e-3, -2e-3, 3e-3)}
    state = msgspec.structs.replace(state_record(), **changes)
    values = values_of(state, frame, [alert(Severity.WARNING)], {"7": Cause.CAMERA_MOUNT, "8": Cause.UNKNOWN})
    expected = {
        "what to do": "begin no motion by the transform, and grasp nothing",
        "alerts": "drift (warning)",
        "cause": str(Cause.CAMERA_MOUNT),
        "frame age (s)": "0.250",
        "reason": "blurred",
        "verdict": "suspect",
        "reference_id": "plate-2",
        "tcp_shift_m": "0.001 -0.002 0.003",
        "drift.rotation_rad": "0.0026",
        "protection.position_m": "0.00045",
        "valid_by": "absolute",
    }
    assert values.items() >= expected.items()
    assert "alert_limit_m" not in values, "what isn't known isn't said"
    assert "frame age (s)" not in values_of(state, None, [], {})


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("encoding", "kind"), [("mono8", "u1"), ("mono16", "u2"), ("32FC1", "f4"), ("bgr8", "u1")])
def test_pixels_of_a_message(encoding: str, kind: str, big: bool):
    """In either byte order, with padded rows."""
    shape = (4, 5, 3) if encoding == "bgr8" else (4, 5)
    image = np.arange(np.prod(shape), dtype=kind).reshape(shape) * np.array(251, kind)
    rows = image.reshape(4, -1).astype(f"{'>' if big else '<'}{kind}")
    padded = b"".join(row.tobytes() + bytes(2 * rows.itemsize) for row in rows)
    message = SimpleNamespace(height=4, width=5, encoding=encoding, is_bigendian=big, step=len(padded) // 4)
    np.testing.assert_array_equal(message_image(message, padded, (5, 4)), image)
    for wrong, said in (
        ({"encoding": "64UC1"}, "encoding '64UC1'; one of mono8, "),
        ({"width": 6}, "6x4 pixels; 5x4 as the camera's calibration says"),
        ({"step": 2}, "step 2; at least"),
    ):
        with pytest.raises(PayloadError, match=said):
            message_image(SimpleNamespace(**vars(message) | wrong), padded, (5, 4))
    with pytest.raises(PayloadError, match=r"bytes; \d+ \(4 rows of"):
        message_image(message, padded[:-1], (5, 4))


def test_openings_from_joints():
    """Two fingers that turn: the opening is an offset and a scale away from the sum of their angles."""
    opening = JointOpening(joints=("left", "right"), scale=-0.05, offset_m=0.06)
    heard = positions_by_joint(["elbow", "right", "left"], np.array([1.0, 0.1, 0.1]))
    assert opening.opening_m(heard) == pytest.approx(0.05)
    assert opening.opening_m(positions_by_joint(["elbow"], [1.0])) is None
    assert opening.opening_m(positions_by_joint(["left", "right"], [])) is None, "only velocities"
    for names, positions, said in (
        (["left"], [0.1], "joint state of left without right"),
        (["left", "right"], [0.1, math.nan], "the position of left, right is not finite"),
        (["left", "right"], [0.1], "1 positions of 2 joints"),
        (["left", "left"], [0.1, 0.1], "two joints have the same name"),
    ):
        with pytest.raises(JawError, match=said):
            opening.opening_m(positions_by_joint(names, positions))
