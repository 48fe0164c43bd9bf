"""Deterministic messages of every kind, kept as bytes in ``wire_samples/``.

``python -m support.sample_messages`` in tests/ writes them again, for a change of the wire that is meant.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from gripmon.model.records import (
    Absolute,
    Alert,
    AlertEvent,
    AlertKind,
    AlertRecord,
    Cause,
    CauseWeight,
    ClockReading,
    CommandError,
    CommandFault,
    CommandName,
    CommandReply,
    CommandRequest,
    CornerFault,
    CornerRecord,
    Drift,
    FrameNote,
    FrameRecord,
    JawReading,
    MonitorState,
    Mount,
    OpenAlert,
    Origin,
    Protection,
    ReferenceInputs,
    ReferenceRecord,
    Severity,
    Since,
    SinceReference,
    Smoothed,
    Snapshot,
    SnapshotImage,
    StandingAlert,
    State,
    StateRecord,
    Transform,
    ValidBy,
    Verdict,
    to_json,
)

FOLDER = Path(__file__).resolve().parents[1] / "wire_samples"

STAMP_NS = 1_767_225_600_123_456_789  # beyond what a double holds exactly: readers need 64-bit integers
MONITOR_ID = "arm-pc-4711-1f0c9a2b"
POSE = Transform((0.0116, -0.0021, 0.1327), (0.5, -0.5, 0.5, 0.5))


def covariance(position_m: float, rotation_rad: float) -> tuple[float, ...]:
    """6 x 6 with these standard deviations on the diagonal, and one correlated pair of axes."""
    sigmas = (position_m, position_m, 4.0 * position_m, rotation_rad, rotation_rad, rotation_rad)
    flat = [a * b * (i == j or 0.5 * ({i, j} == {1, 3})) for i, a in enumerate(sigmas) for j, b in enumerate(sigmas)]
    return tuple(float(f"{value:.6g}") for value in flat)


MOVED = Alert(
    kind=AlertKind.STEP,
    cause=Cause.CAMERA_MOUNT,
    severity=Severity.WARNING,
    text="the camera moved at once by 1.52 mm and 0.40 degrees: camera mount (p = 0.97)",
    event=AlertEvent.UPDATED,
    alert_id="drift-3",
    causes=(CauseWeight(Cause.CAMERA_MOUNT, 0.97), CauseWeight(Cause.FINGER_BENT, 0.03, "left")),
    tcp_shift_m=(0.0015, -0.0002, 0.0001),
    rotation_rad=0.007,
    since_ns=STAMP_NS - 500_000_000,
)
CREEPS = Alert(
    kind=AlertKind.CREEP,
    cause=Cause.UNKNOWN,
    severity=Severity.INFO,
    text="the camera creeps by 0.12 mm/min, 0.40 mm so far; 17 min to the limit",
    event=AlertEvent.RAISED,
    alert_id="drift-4",
    tcp_shift_m=(0.0004, 0.0, 0.0),
    rotation_rad=0.001,
    rate_m_per_min=0.00012,
    time_left_s=1050.0,
    since_ns=STAMP_NS,
)
MEASURED = FrameRecord(
    seq=4711,
    stamp_ns=STAMP_NS,
    verdict=Verdict.VALID,
    state=State.DRIFTING,
    source=Origin.UPDATE,
    cam_T_grip=POSE,
    covariance=covariance(2e-5, 1e-4),
    smoothed=Smoothed((0.01161, -0.00211, 0.13272), (0.5, -0.5, 0.5, 0.5), covariance(4e-6, 2e-5)),
    drift=Drift(0.00152, 0.007, (0.0015, -0.0002, 0.0001)),
    reference_id="recalibration-3-1f0c9a2b",
    revision=3,
    rms_px=0.0625,
    jaw_opening_m=0.034,
    corners=(
        CornerRecord("left_inner_near", (401.25, 310.5), 0.04, used=True),
        CornerRecord("left_outer_near", None, None, used=False, reason=CornerFault.HIDDEN),
    ),
    alerts=(MOVED,),
    latency_ns=2_650_000,
    monitor_id=MONITOR_ID,
    name="/dev/video0",
    protection=Protection(3.5e-4, 4.4e-3, 1e-5, "an edge belongs to something else"),
    valid_by=ValidBy.ABSOLUTE,
    since_reference=SinceReference(2.5e-4, 3.1e-3, Since.REFERENCE, STAMP_NS - 60_000_000_000),
    absolute=Absolute(3.5e-4, 4.4e-3, POSE.translation_m, POSE.rotation_xyzw),
)
BY_REFERENCE = msgspec.structs.replace(
    MEASURED,
    cam_T_grip=Transform((0.0121, -0.0021, 0.1323), (0.5, -0.5, 0.5, 0.5)),
    protection=Protection(2.5e-4, 3.1e-3, 1e-5, "an edge belongs to something else"),
    valid_by=ValidBy.REFERENCE,
    since_reference=SinceReference(2.5e-4, 3.1e-3, Since.FIRST_PROVED, STAMP_NS - 90_000_000_000),
)
HELD = msgspec.structs.replace(
    MEASURED,
    seq=4712,
    stamp_ns=STAMP_NS + 33_333_333,
    verdict=Verdict.SUSPECT,
    state=State.OCCLUDED,
    source=Origin.HELD,
    covariance=covariance(6e-5, 4e-4),
    rms_px=None,
    jaw_opening_m=None,
    corners=tuple(CornerRecord(c.id, None, None, used=False, reason=CornerFault.HIDDEN) for c in MEASURED.corners),
    alerts=(),
    reason="too few edges are seen",
    protection=Protection(1.1e-3, 0.018, 1e-5, "nothing is wrong"),
    since_reference=SinceReference(1.0e-3, 0.017, Since.REFERENCE, STAMP_NS - 60_000_000_000),
    absolute=Absolute(1.1e-3, 0.018, POSE.translation_m, POSE.rotation_xyzw),
)
NOTHING = msgspec.structs.replace(
    HELD,
    seq=4750,
    stamp_ns=STAMP_NS + 1_300_000_000,
    verdict=Verdict.UNKNOWN,
    state=State.LOST,
    cam_T_grip=None,
    covariance=None,
    smoothed=None,
    drift=None,
    protection=None,
    since_reference=None,
    absolute=None,
)
CONFIGURED = ReferenceRecord("config-5f2ac301", 0, 0, "configuration", POSE, covariance(0.002, 0.01))
RECALIBRATED = ReferenceRecord(
    "recalibration-3-1f0c9a2b",
    3,
    STAMP_NS - 60_000_000_000,
    "recalibration",
    POSE,
    covariance(1e-5, 5e-5),
    parent="config-5f2ac301",
    cause=Cause.CAMERA_MOUNT,
    accepted_by="monitor",
    inputs=ReferenceInputs(2900, 2919, 20, ("left_inner_near", "left_outer_near"), 0.93, 0.0045, 0.011),
)
UNDONE = ReferenceRecord(
    "undo-4-77aa01c2", 4, STAMP_NS, "undo", POSE, covariance(0.002, 0.01),
    parent="recalibration-3-1f0c9a2b", restores="config-5f2ac301", accepted_by="operator",
)  # fmt: skip
MOUNT = Mount(
    "config-5f2ac301", 0, 0.001, 0.035, "", (-0.0015, 0.0002, -0.0001), (0.002, -0.0035, 0.0), (0.0075, 0.0075, 0.035),
    0.00151, 0.00403,
)  # fmt: skip
MONITOR = MonitorState(
    references=(CONFIGURED, RECALIBRATED),
    proposal=msgspec.structs.replace(RECALIBRATED, reference_id="recalibration-4-9be01d77", revision=4),
    alerts=(OpenAlert("drift", MOVED),),
    alerts_raised=3,
    cam_T_grip=POSE,
    reference_error=(1e-5, -2e-5, 1e-4, 1e-3, 0.0, -1e-3),
)

SAMPLES: dict[str, msgspec.Struct] = {
    "transform": MEASURED,
    "transform_reference": BY_REFERENCE,
    "transform_held": HELD,
    "transform_null": NOTHING,
    "state": StateRecord(
        robot="arm1",
        camera="wrist",
        state=State.DRIFTING,
        verdict=Verdict.VALID,
        stamp_ns=STAMP_NS + 5_000_000,
        seq=4711,
        reference_id="recalibration-3-1f0c9a2b",
        revision=3,
        frames=4700,
        frames_refused=2,
        frames_dropped=12,
        frames_per_s=29.97,
        uptime_s=157.25,
        camera_connected=True,
        recording_dropped=0,
        message="no jaw opening for 1 s or longer",
        version="0.1.0",
        monitor_id=MONITOR_ID,
        tcp_shift_m=(0.0015, -0.0002, 0.0001),
        sigma_m=8e-5,
        protection_m=3.5e-4,
        alert_limit_m=5e-4,
        open_alerts=(
            StandingAlert(
                "drift-3", AlertKind.STEP, Severity.WARNING, MOVED.text, STAMP_NS - 500_000_000, acknowledged=False
            ),
        ),
        transforms_unsent=0,
        malformed=1,
        valid_by=ValidBy.ABSOLUTE,
    ),
    "alert": AlertRecord(
        robot="arm1",
        camera="wrist",
        seq=4711,
        stamp_ns=STAMP_NS,
        state=State.DRIFTING,
        reference_id="recalibration-3-1f0c9a2b",
        revision=3,
        **msgspec.structs.asdict(MOVED),
    ),
    "alert_creep": AlertRecord(
        robot="arm1",
        camera="wrist",
        seq=4711,
        stamp_ns=STAMP_NS,
        state=State.DRIFTING,
        reference_id="recalibration-3-1f0c9a2b",
        revision=3,
        **msgspec.structs.asdict(CREEPS),
    ),
    "reference": RECALIBRATED,
    "reference_configured": CONFIGURED,
    "reference_undone": UNDONE,
    "clock": ClockReading("0e8f6f0c5cbb4c0f9f0a4b6b9f1f2a3b", 86_400_123_456_789),
    "jaw": JawReading(STAMP_NS, 0.034),
    "frame": FrameNote(stamp_ns=STAMP_NS, jaw_opening_m=0.034, width=768, height=576, encoding="mono8"),
    "command": CommandRequest("recalibration-3-1f0c9a2b", "0e8f6f0c5cbb4c0f9f0a4b6b9f1f2a3b"),
    "reply": CommandReply(
        CommandName.UNDO, True, "back to config-5f2ac301 as undo-4-77aa01c2, revision 4", "undo-4-77aa01c2", 4
    ),
    "reply_refused": CommandReply(CommandName.ACCEPT, False, "no reference is proposed", "recalibration-3-1f0c9a2b", 3),
    "reply_state": CommandReply(
        CommandName.STATE,
        True,
        "drifting, recalibration-3-1f0c9a2b in force, revision 3",
        "recalibration-3-1f0c9a2b",
        3,
        MONITOR,
        mount=MOUNT,
    ),
    "reply_snapshot": CommandReply(
        CommandName.SNAPSHOT,
        True,
        "frame 4711, 0.01 s old, drifting, transform valid: 768 x 576 px, png, 301234 bytes",
        "recalibration-3-1f0c9a2b",
        3,
        MONITOR,
        Snapshot(
            MEASURED,
            0.0125,
            0.034,
            SnapshotImage("png", 768, 576, "mono8", 301234),
            (((401.25, 310.5), (398.0, 402.75)),),
            (((399.0, 311.25), (395.75, 403.5)),),
        ),
        mount=MOUNT,
    ),
    "error": CommandError(
        CommandFault.TIMEOUT, "the monitor has not answered within 2 s; it may still be carried out, ask for the state"
    ),
}


def payload(name: str) -> bytes:
    """What goes over the wire."""
    return to_json(SAMPLES[name])


def kept(name: str) -> bytes:
    """What the file holds, without the line feed at its end."""
    return (FOLDER / f"{name}.json").read_bytes().removesuffix(b"\n")


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for stale in {path.stem for path in FOLDER.iterdir()} - SAMPLES.keys():
        (FOLDER / f"{stale}.json").unlink()
    for sample in SAMPLES:
        (FOLDER / f"{sample}.json").write_bytes(payload(sample) + b"\n")
