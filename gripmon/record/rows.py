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
``residual/corners_px``             each corner's distance;  ``residual/edge_points`` each point's of the overlay
==================================  ================================================================================
"""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr

from gripmon.model.camera import LensSettings
from gripmon.model.gripper import Gripper
from gripmon.model.records import FrameRecord, ReferenceRecord, to_json
from gripmon.record.columns import Line, Writer
from gripmon.record.curves import CurveWriter
from gripmon.record.pictures import Row
from gripmon.record.recorder import Events, Scene
from gripmon.record.scene import OverlayWriter, RigWriter


class RowWriter(Writer):
    """Writes the frames of a wrist camera."""

    def __init__(self, stream: rr.RecordingStream, scene: Scene, file_number: int):
        assert scene.gripper is not None, "a wrist camera's"
        gripper = Gripper(scene.gripper)
        super().__init__(stream, scene, file_number, _about(scene.lens, gripper.name))
        self.corner_ids = gripper.corner_ids
        self._curves = CurveWriter(self._send, gripper.corner_ids)
        self._overlay = OverlayWriter(self._send, gripper.corner_ids, scene.lens.height_px)
        self._rig = RigWriter(self._send, scene, gripper)
        self._references: list[ReferenceRecord] = []

    def write(self, rows: Sequence[Row], events: Events) -> None:
        """Send everything since the last call.

        References wait for a frame: their own stamp may be long before the recording, or unset.
        """
        for r in events.references:
            self._curves.add_reference(r)
        self._references += events.references
        lines: list[Line] = []
        if rows:
            lines = [self._write_reference(r, _first_with(r, rows)) for r in self._references]
            self._references.clear()
            self._curves.write(rows)
            self._write_records(rows)
            self._overlay.write(rows)
            self._rig.write(rows)
        self._events.write(rows, events, lines)

    def repeat(self) -> None:
        super().repeat()
        self._rig.repeat()

    def write_pictures(self, rows: Sequence[Row]) -> None:
        if rows:
            self._curves.write_pictures(rows)
            self._overlay.write_late(rows)

    def finish(self) -> None:
        self._curves.finish()

    def _write_reference(self, reference: ReferenceRecord, first: FrameRecord) -> Line:
        self._rig.write_reference(reference, first)
        whole = rr.AnyValues.columns(json=[to_json(reference).decode()])
        self._send.columns("reference", [first.stamp_ns], [first.seq], whole)
        return Line(first.stamp_ns, first.seq, "INFO", f"reference {reference.reference_id} ({reference.origin})")


def _first_with(reference: ReferenceRecord, rows: Sequence[Row]) -> FrameRecord:
    """The first frame that names the reference; else the first frame."""
    key = (reference.reference_id, reference.revision)
    records = [row.record for row in rows]
    return next((r for r in records if (r.reference_id, r.revision) == key), records[0])


def _about(lens: LensSettings, gripper: str) -> str:
    return (
        f"gripper `{gripper}`, {lens.width_px} x {lens.height_px} px\n\nLens: `{to_json(lens).decode()}`\n\n"
        "Image: predicted edges blue, edge points green where the fit used them and red where not, measured "
        "corners yellow.  Plot: motion of the TCP in the camera frame against the reference; thin lines are one "
        "standard deviation, wide pale ones the truth where there is one."
    )
