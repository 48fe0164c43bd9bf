"""What our records become in ROS 2, decoded by another CDR library and held against the definitions."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import ros2_idl as idl
from support.loopback import frame_record, state_record

from gripmon.io.ros2.node import DIAGNOSTICS, POSE, TF, typestore
from gripmon.io.ros2.publisher import ERROR, OK, STALE, WARN, Messages, inverse
from gripmon.model.records import AlertKind, Severity, StandingAlert, State, Transform, Verdict

STAMP_NS = 1_700_000_000_123_456_789
ROTATION = Rotation.from_euler("xyz", [0.3, -0.7, 1.9])
TRANSLATION_M = (0.011, -0.022, 0.133)
TRANSFORM = Transform(TRANSLATION_M, tuple(ROTATION.as_quat().tolist()))


@pytest.fixture(scope="module")
def messages() -> Messages:
    return Messages("wrist_optical_frame", "arm_wrist_gripmon")


def cdr(message: object, type_name: str) -> bytes:
    return bytes(typestore().serialize_cdr(message, type_name))


def random_covariance() -> np.ndarray:
    """6 x 6, everything correlated with everything; 20 µm and 0.3 mrad."""
    roots = np.random.default_rng(5).normal(size=(6, 6)) * np.repeat([1e-5, 1.5e-4], 3)[:, None]
    return roots @ roots.T


def test_tf(messages: Messages):
    payload = cdr(messages.tf(messages.header(STAMP_NS), TRANSFORM), TF)
    assert payload[:4] == bytes([0, 1, 0, 0])
    (placed,) = idl.TFMessage.deserialize(payload).transforms
    assert placed.header == idl.Header(idl.Time(1_700_000_000, 123_456_789), "wrist_optical_frame")
    assert placed.child_frame_id == "arm_wrist_gripmon"
    translation, rotation = placed.transform.translation, placed.transform.rotation
    assert (translation.x, translation.y, translation.z) == TRANSLATION_M
    assert (rotation.x, rotation.y, rotation.z, rotation.w) == TRANSFORM.rotation_xyzw
    assert idl.TFMessage.deserialize(payload).serialize() == payload


def test_pose_with_covariance(messages: Messages):
    covariance = random_covariance()
    payload = cdr(messages.pose(messages.header(STAMP_NS), TRANSFORM, tuple(covariance.ravel())), POSE)
    message = idl.PoseWithCovarianceStamped.deserialize(payload)
    assert message.header == idl.Header(idl.Time(1_700_000_000, 123_456_789), "wrist_optical_frame")
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    assert (position.x, position.y, position.z) == TRANSLATION_M
    assert (orientation.x, orientation.y, orientation.z, orientation.w) == TRANSFORM.rotation_xyzw
    assert message.pose.covariance == covariance.ravel().tolist()
    assert message.serialize() == payload


def test_the_inverse_maps_back():
    grip_T_cam, _ = inverse(TRANSFORM, np.eye(6).ravel())
    point_grip_m = np.array([0.02, -0.01, 0.005])
    point_cam_m = ROTATION.apply(point_grip_m) + TRANSLATION_M
    back_m = Rotation.from_quat(grip_T_cam.rotation_xyzw).apply(point_cam_m) + grip_T_cam.translation_m
    np.testing.assert_allclose(back_m, point_grip_m, atol=1e-15)


def test_the_covariance_of_the_inverse():
    """Against the scatter of inverted samples: each error is read off by the definition, nothing is linearised."""
    covariance = random_covariance()
    errors = np.random.default_rng(6).multivariate_normal(np.zeros(6), covariance, size=200_000)
    rotations = Rotation.from_rotvec(errors[:, 3:]) * ROTATION
    translations_m = np.array(TRANSLATION_M) + errors[:, :3]
    inverted = rotations.inv()
    omegas = (inverted * ROTATION).as_rotvec()  # exp(omega') R' = R'_true, where R' is the transpose of R
    rhos = -inverted.apply(translations_m) + ROTATION.inv().apply(TRANSLATION_M)
    scatter = np.cov(np.hstack([rhos, omegas]).T)
    _, ours = inverse(TRANSFORM, covariance.ravel())
    scale = np.sqrt(np.diag(scatter))
    np.testing.assert_allclose(
        ours.reshape(6, 6) / np.outer(scale, scale), scatter / np.outer(scale, scale), atol=0.015
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
        ({"verdict": Verdict.UNKNOWN, "state": State.LOST}, [], ERROR),
        ({"verdict": Verdict.UNKNOWN, "state": State.LOST}, [alert(Severity.WARNING)], ERROR),
        ({"verdict": Verdict.UNKNOWN, "state": State.STALE}, [alert(Severity.ERROR)], STALE),
        ({"message": "no jaw opening received"}, [], WARN),
    ],
)
def test_levels_of_diagnostics(messages: Messages, changes: dict[str, object], alerts: list[StandingAlert], level: int):
    state = msgspec.structs.replace(state_record(), **changes)
    payload = cdr(messages.diagnostics("gripmon: arm/wrist", state, None, alerts, "yes"), DIAGNOSTICS)
    (status,) = idl.DiagnosticArray.deserialize(payload).status
    assert status.level == level
    for text in [state.message, *(entry.text for entry in alerts)]:
        assert text in status.message


def test_values_of_diagnostics(messages: Messages):
    state = msgspec.structs.replace(
        state_record(),
        stamp_ns=STAMP_NS + 250_000_000,
        tcp_shift_m=(0.001, -0.002, 0.003),
        sigma_m=12e-6,
        alert_limit_m=5e-4,
    )
    frame = frame_record(0, stamp_ns=STAMP_NS, reason="blurred")
    payload = cdr(
        messages.diagnostics("gripmon: arm/wrist", state, frame, [alert(Severity.WARNING)], "no: verdict suspect"),
        DIAGNOSTICS,
    )
    array = idl.DiagnosticArray.deserialize(payload)
    assert array.header == idl.Header(idl.Time(1_700_000_000, 373_456_789), "")
    (status,) = array.status
    assert (status.name, status.hardware_id) == ("gripmon: arm/wrist", "arm/wrist")
    assert status.message == "tracking, transform valid; a warning"
    values = {entry.key: entry.value for entry in status.values}
    assert len(values) == len(status.values)
    assert values == {
        "state": "tracking",
        "verdict": "valid",
        "valid by": "absolute",
        "broadcast": "no: verdict suspect",
        "reference": "plate-2",
        "revision": "3",
        "frame age (s)": "0.250",
        "reason": "blurred",
        "tcp shift (mm)": "3.7417",  # of (1, -2, 3) mm
        "tcp shift x y z in the camera frame (mm)": "1.0000 -2.0000 3.0000",
        "rotation (deg)": "0.1490",  # of 2.6 mrad
        "position sigma (mm)": "0.0120",
        "protection level (mm)": "0.4500",
        "rotation protection level (deg)": "0.3151",  # of 5.5 mrad
        "integrity risk per frame": "1e-05",
        "hypothesis": "an edge belongs to something else",
        "alert limit (mm)": "0.5",
        "alerts": f"{AlertKind.DRIFT} (warning)",
        "camera connected": "true",
        "frames per s": "30.00",
        "frames": "7",
        "frames refused": "0",
        "frames dropped": "0",
        "uptime (s)": "1",
        "version": "0",
    }
    assert array.serialize() == payload
