"""Frames -> columns of a rerun recording: which entity holds what.

Timelines: ``capture_time`` (the frame's ``stamp_ns``) and ``frame`` (its ``seq``).  A whole batch of frames becomes one
chunk an entity, which costs a tenth of logging frame by frame.

==============================  ====================================================================================
``rig``                         camera axes (x right, y down, z forward), metres
``rig/camera``                  pinhole without lens distortion;  ``image`` and its overlay in distorted pixels
``rig/gripper``                 ``cam_T_grip`` of the frame, below it the fingers at the frame's jaw opening
``rig/reference``               ``cam_T_grip`` of the reference
``rig/smoothed``                the smoothed transform
numbers over time               see :mod:`gripmon.record.write.curves`
``status/state``, ``verdict``   as state changes;  ``events`` alerts and changes as text
``record``                      the frame's whole record, one JSON line as ``replay`` writes it, to the last digit
``meta``, ``configuration``     what this file is and what the monitor ran with, static, JSON as all that follows
``reference``                   the one in force at the file's beginning, and each new one
``alert``                       alerts that are in no frame's record: the daemon's own
``command``, ``state``          commands that were carried out or refused; state messages
==============================  ====================================================================================
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import rerun as rr

from gripmon.model.records import FrameRecord, Meta, ReferenceRecord, to_json
from gripmon.record.write.columns import Row, Sender
from gripmon.record.write.curves import CurveWriter
from gripmon.record.write.events import EventWriter, Line
from gripmon.record.write.overlay import OverlayWriter
from gripmon.record.write.rig import RigWriter
from gripmon.record.write.settings import RecordingSettings
from gripmon.record.write.wire import Events, Scene


class RowWriter:
    """Writes rows into one file.  The constructor writes what is static."""

    def __init__(self, stream: rr.RecordingStream, scene: Scene, file_number: int):
        self._send = Sender(stream)
        self._events = EventWriter(self._send)
        self._curves = CurveWriter(self._send, scene)
        self._overlay = OverlayWriter(self._send, scene)
        self._rig = RigWriter(self._send, scene)
        self._references: list[ReferenceRecord] = []
        self._log_static(scene)
        log_origin(self._send, scene, file_number)

    def write(self, rows: Sequence[Row], events: Events) -> None:
        """Send everything that was gathered since the last call.

        References wait for a frame: their own stamp may lie long before the recording, or be no time at all.
        """
        for r in events.references:
            self._curves.add_reference(r)
        self._references += events.references
        lines: list[Line] = []
        if rows:
            lines = [self._write_reference(r, _first_with(r, rows)) for r in self._references]
            self._references.clear()
            self._curves.write(rows)
            self._records(rows)
            self._overlay.write(rows)
            self._rig.write(rows)
        self._events.write(rows, events, lines)

    def repeat(self) -> None:
        """Say again, with the next frame, what else is only said when it changes."""
        self._events.repeat()
        self._rig.repeat()

    def write_pictures(self, rows: Sequence[Row]) -> None:
        """Send the pictures of frames that were written before without them."""
        if rows:
            self._curves.write_pictures(rows)
            self._overlay.write_late(rows)

    def finish(self) -> None:
        """Nothing more comes into this file."""
        self._curves.finish()

    def _write_reference(self, reference: ReferenceRecord, first: FrameRecord) -> Line:
        self._rig.write_reference(reference, first)
        whole = rr.AnyValues.columns(json=[to_json(reference).decode()])
        self._send.columns("reference", [first.stamp_ns], [first.seq], whole)
        return Line(first.stamp_ns, first.seq, "INFO", f"reference {reference.reference_id} ({reference.origin})")

    def _log_static(self, scene: Scene) -> None:
        self._send.static("about", rr.TextDocument(_about(scene), media_type="text/markdown"))

    def _records(self, rows: Sequence[Row]) -> None:
        lines = [to_json(row.record).decode() for row in rows]
        self._send.frames("record", rows, rr.AnyValues.columns(json=lines))


def log_origin(send: Sender, scene: Scene, file_number: int) -> None:
    """What this file is, and what the monitor ran with: each file stands alone."""
    meta = Meta(
        name=scene.name,
        recording_id=scene.recording_id,
        robot=scene.robot,
        camera=scene.camera,
        gripper=scene.gripper,
        version=scene.version,
        file_number=file_number,
        started_ns=time.time_ns(),
        image_policy=image_policy(scene.settings),
        has_truth=scene.has_truth,
        kind="frames" if scene.laser is None else "spots",
    )
    send.static("meta", rr.AnyValues(json=to_json(meta).decode()))
    if scene.configuration is not None:
        send.static("configuration", rr.AnyValues(json=to_json(scene.configuration).decode()))


def _first_with(reference: ReferenceRecord, rows: Sequence[Row]) -> FrameRecord:
    """The first frame that names the reference; else the first of all."""
    key = (reference.reference_id, reference.revision)
    records = [row.record for row in rows]
    return next((r for r in records if (r.reference_id, r.revision) == key), records[0])


def image_policy(settings: RecordingSettings) -> str:
    """Which images are kept, and how, in words."""
    kind = "PNG" if settings.image_format == "png" else f"JPEG {settings.jpeg_quality} %"
    rate = f"{settings.image_rate_hz:g} images/s" if settings.image_rate_hz > 0.0 else "no images but"
    every = f", of every {settings.image_every}. frame" if settings.image_every > 0 else ""
    around = (
        f", all within {settings.around_alert_s:g} s of a warning or error" if settings.around_alert_s > 0.0 else ""
    )
    return f"{kind}, {rate}{every}, one at every alert and change{around}"


def _about(scene: Scene) -> str:
    return (
        f"# {scene.robot} / {scene.camera}\n\ngripmon {scene.version}, gripper `{scene.gripper}`, "
        f"{scene.width_px} x {scene.height_px} px\n\nLens: `{scene.lens}`\n\n"
        "Image: predicted edges blue, edge points green where the fit believed them and red where not, measured "
        "corners yellow.  Plot: motion of the TCP in the camera frame against the reference; thin lines are one "
        "standard deviation, wide pale ones the truth where there is one.\n"
    )
