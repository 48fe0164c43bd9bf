"""Frames -> columns of a rerun recording: which entity holds what.

Timelines: ``capture_time`` (the frame's ``stamp_ns``) and ``frame`` (its ``seq``).  A batch of frames becomes one chunk
per entity, which costs a tenth of logging frame by frame.

==================================  ================================================================================
``rig``                             camera axes (x right, y down, z forward), metres
``rig/camera``                      pinhole without lens distortion;  ``image`` and its overlay in distorted pixels
``rig/gripper``                     ``cam_T_grip`` of the frame, and below it the fingers at its jaw opening
``rig/reference``, ``smoothed``     ``cam_T_grip`` of the reference; the smoothed transform
``status/state``, ``verdict``       as state changes;  ``events`` alerts and changes as text
``record``                          the frame's whole record, one JSON line as ``replay`` writes it, to the last digit
``meta``, ``configuration``         about this file, and the monitor's configuration; static, JSON like all below
``reference``                       the reference in force when the file begins, and each new one
``alert``                           alerts that are in no frame's record, from the daemon
``command``, ``state``              commands that were carried out or refused; state messages
``residual/edge_points``            distances of the overlay's edge points, in its order;  other numbers: ``curves``
==================================  ================================================================================
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import msgspec
import rerun as rr

from gripmon.model.gripper import Gripper
from gripmon.model.outputs import Event
from gripmon.model.records import FrameRecord, Meta, ReferenceRecord, to_json
from gripmon.record.columns import EventWriter, Line, Sender
from gripmon.record.compared import ThenWriter
from gripmon.record.curves import CurveWriter
from gripmon.record.overlay import OverlayWriter
from gripmon.record.recorder import RecordingSettings, Row, Scene, those
from gripmon.record.rig import RigWriter


class RowWriter:
    """Writes frames, and what happens beside them, into one stream."""

    def __init__(self, stream: rr.RecordingStream, scene: Scene, file_number: int):
        """Writes what doesn't change: the description of this file, the monitor's configuration, styles, the camera."""
        self._send = send = Sender(stream)
        gripper = Gripper(scene.gripper)
        meta = Meta(
            name=scene.name, recording_id=scene.recording_id, robot=scene.robot, camera=scene.camera,
            gripper=scene.gripper.name, version=scene.version, file_number=file_number, started_ns=time.time_ns(),
            image_policy=_image_policy(scene.settings), has_truth=scene.has_truth,
        )  # fmt: skip
        send.static("meta", _whole(meta))
        if scene.configuration is not None:
            send.static("configuration", _whole(scene.configuration))
        send.static("about", rr.TextDocument(_about(scene), media_type="text/markdown"))
        self._events = EventWriter(send)
        self._curves = CurveWriter(send, gripper.corner_ids)
        self._overlay = OverlayWriter(send, gripper.corner_ids, scene.lens.height_px)
        self._rig = RigWriter(send, scene, gripper)
        self._then = None if scene.then is None else ThenWriter(stream, scene.then, gripper.corner_ids)
        self._references: list[ReferenceRecord] = []
        self._begun = False

    def write(self, rows: Sequence[Row], events: Sequence[Event]) -> None:
        """Send everything since the last call.

        References wait for the first frame that names them: their own stamp may be long before the recording, or unset.
        One that the recording begins with holds from its first frame.
        """
        for reference in those(ReferenceRecord, events):
            self._curves.add_reference(reference)
            self._references.append(reference)
        lines: list[Line] = []
        if rows:
            lines = self._write_references([row.record for row in rows])
            self._curves.write(rows)
            whole = rr.AnyValues.columns(json=[to_json(row.record).decode() for row in rows])
            self._send.frames("record", rows, whole)
            self._overlay.write(rows)
            self._rig.write(rows)
        self._events.write(rows, events, lines)
        if rows and self._then is not None:
            self._then.write(rows)

    def write_pictures(self, rows: Sequence[Row]) -> None:
        """Send the pictures of rows that were written earlier without them."""
        if rows:
            self._curves.write_pictures(rows)
            self._overlay.write_late(rows)

    def repeat(self) -> None:
        """With the next row, write again what is otherwise only written on change."""
        self._events.repeat()
        self._rig.repeat()

    def finish(self) -> None:
        """Called when nothing more is written."""
        self._curves.finish()
        if self._then is not None:
            self._then.finish()

    def _write_references(self, records: Sequence[FrameRecord]) -> list[Line]:
        references, self._references, lines = self._references, [], []
        for reference in references:
            key = (reference.reference_id, reference.revision)
            first = next((r for r in records if (r.reference_id, r.revision) == key), None)
            first = first or (None if self._begun else records[0])
            if first is None:
                self._references.append(reference)
                continue
            self._rig.write_reference(reference, first)
            whole = rr.AnyValues.columns(json=[to_json(reference).decode()])
            self._send.columns("reference", [first.stamp_ns], [first.seq], whole)
            text = f"reference {reference.reference_id} ({reference.origin})"
            lines.append(Line(first.stamp_ns, first.seq, "INFO", text))
        self._begun = True
        return lines


def _whole(message: msgspec.Struct) -> rr.AnyValues:
    return rr.AnyValues(json=to_json(message).decode())


def _about(scene: Scene) -> str:
    lens = scene.lens
    return (
        f"# {scene.robot} / {scene.camera}\n\ngripmon {scene.version}, gripper `{scene.gripper.name}`, "
        f"{lens.width_px} x {lens.height_px} px\n\nLens: `{to_json(lens).decode()}`\n\n"
        "Image: predicted edges blue, edge points green where the fit used them and red where not, measured "
        "corners yellow.  Plot: motion of the TCP in the camera frame against the reference; thin lines are one "
        "standard deviation, wide pale ones the truth where there is one.\n"
    )


def _image_policy(settings: RecordingSettings) -> str:
    """Which images are kept, and how, in words."""
    kind = "PNG" if settings.image_format == "png" else f"JPEG {settings.jpeg_quality} %"
    rate = f"{settings.image_rate_hz:g} images/s" if settings.image_rate_hz > 0.0 else "no images but"
    every = f", of every {settings.image_every}. frame" if settings.image_every > 0 else ""
    around_s = settings.around_alert_s
    around = f", all within {around_s:g} s of a warning or error" if around_s > 0.0 else ""
    return f"{kind}, {rate}{every}, one at every alert and change{around}"
