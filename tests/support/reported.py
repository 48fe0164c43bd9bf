"""Runs to report on: frames whose every number is known, as a recording has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from gripmon.model.geometry import exp_rotation, from_record, make_transform, rotation_angle, to_record
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    AlertRecord,
    Cause,
    CauseWeight,
    Drift,
    FrameRecord,
    Meta,
    Origin,
    RecordedCommand,
    RecordedConfiguration,
    ReferenceRecord,
    Severity,
    State,
    StateRecord,
    Verdict,
)
from gripmon.record.recordings import Picture
from gripmon.record.table import FrameTable
from support import recorded
from support.playback_runs import table_of

FPS = 50
PERIOD_NS = 1_000_000_000 // FPS
START_NS = 1_700_000_000_000_000_000
NOISE_M = (2e-6, 4e-6, 9e-6)
NOISE_RAD = 5e-5
REFERENCE = msgspec.structs.replace(recorded.REFERENCE, origin="recalibration", accepted_by="operator")
_DIFFERENT = 50


@dataclass
class Run:
    """What :class:`gripmon.record.recordings.Recording` has."""

    records: list[FrameRecord]
    robot: str = "arm"
    camera: str = "wrist"
    references: tuple[ReferenceRecord, ...] = (REFERENCE,)
    commands: tuple[RecordedCommand, ...] = ()
    states: tuple[StateRecord, ...] = ()
    configuration: RecordedConfiguration | None = None
    faults: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ()
    meta: Meta | None = None
    recording_id: str = "run-1"
    files: tuple[Path, ...] = (Path("run-0001.rrd"),)
    image_seqs: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))
    overlay_seqs: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def frames(self) -> FrameTable:
        return table_of(self.records)

    @property
    def alerts(self) -> tuple[AlertRecord, ...]:
        return tuple(
            AlertRecord(
                robot=self.robot,
                camera=self.camera,
                seq=record.seq,
                stamp_ns=record.stamp_ns,
                state=record.state,
                reference_id=record.reference_id,
                revision=record.revision,
                **msgspec.structs.asdict(alert),
            )
            for record in self.records
            for alert in record.alerts
        )

    def prepare(self, seqs: Sequence[int]) -> None:
        """There are no images."""

    def picture(self, seq: int) -> Picture | None:
        return None


def records(shifts_m: np.ndarray, seed: int = 0, start_ns: int = START_NS) -> list[FrameRecord]:
    """A frame for each row of ``shifts_m`` (n, 3), of the TCP against the reference, with noise; NaN: not measured."""
    reference = from_record(REFERENCE.cam_T_grip)
    rng = np.random.default_rng(seed)
    shown = [
        recorded.record(i) for i in range(min(len(shifts_m), _DIFFERENT))
    ]  # their corners: dear, and not looked at
    out = []
    for i, shift_m in enumerate(shifts_m):
        seen = shift_m + rng.normal(size=3) * NOISE_M
        turn = exp_rotation(rng.normal(size=3) * NOISE_RAD)
        cam_T_grip = make_transform(turn @ reference[:3, :3], reference[:3, 3] + seen)
        drift = Drift(float(np.linalg.norm(seen)), rotation_angle(turn), tuple(seen.tolist()))
        made = msgspec.structs.replace(shown[i % _DIFFERENT], seq=i, cam_T_grip=to_record(cam_T_grip), drift=drift)
        if np.isnan(shift_m).any():
            made = msgspec.structs.replace(
                made, cam_T_grip=None, covariance=None, drift=None, protection=None, since_reference=None,
                absolute=None, verdict=Verdict.UNKNOWN,
                state=State.LOST, source=Origin.HELD, reason="nothing is seen",
            )  # fmt: skip
        out.append(msgspec.structs.replace(made, stamp_ns=start_ns + i * PERIOD_NS, latency_ns=2_000_000 + 1000 * i))
    return out


def said(run: list[FrameRecord], i: int, **changes: object) -> None:
    """An alert with frame ``i``; by default a step by the camera's mount that is raised."""
    shift = run[i].drift
    alert = Alert(
        AlertKind.STEP,
        Cause.CAMERA_MOUNT,
        Severity.ERROR,
        "a step: at 22:13:25 the TCP was 3 mm from where the reference had it",
        event=AlertEvent.RAISED,
        alert_id="1-a",
        since_ns=run[i].stamp_ns,
        causes=(CauseWeight(Cause.CAMERA_MOUNT, 0.9), CauseWeight(Cause.UNKNOWN, 0.1)),
        tcp_shift_m=None if shift is None else shift.tcp_shift_m,
    )
    alert = msgspec.structs.replace(alert, **changes)
    run[i] = msgspec.structs.replace(run[i], alerts=(*run[i].alerts, alert))


def stepped(n: int = 500, at: int = 250, **changes: object) -> Run:
    """A camera that is knocked at one frame, which is noticed three frames later."""
    shifts_m = np.zeros((n, 3))
    shifts_m[at:] = (0.0, 3e-3, 0.0)
    made = records(shifts_m)
    said(made, at + 3)
    return Run(made, **changes)
