"""The columns of the exported tables, with units and words in the schemas' metadata.

Of a covariance (6 x 6, symmetric) the upper triangle is kept, row by row: 21 numbers, ``UPPER`` of the flat 36.
"""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa

from gripmon import __version__

UPPER = np.ravel_multi_index(np.triu_indices(6), (6, 6))
TRIANGLE = pa.list_(pa.float64(), len(UPPER))
TIME = pa.timestamp("ns", tz="UTC")
CAUSES = pa.list_(pa.struct([("cause", pa.string()), ("probability", pa.float64()), ("part", pa.string())]))

_Column = tuple[str, pa.DataType, str, str]
_DOUBLE, _INTEGER, _TEXT, _TRUTH = pa.float64(), pa.int64(), pa.string(), pa.bool_()

POSE = ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")
AXES = ("x", "y", "z")


def _pose(name: str, what: str) -> list[_Column]:
    units = ("m",) * 3 + ("1",) * 4
    return [
        (f"{name}_{part}", _DOUBLE, unit, f"{what}: position of the TCP in camera axes, unit quaternion x, y, z, w")
        for part, unit in zip(POSE, units, strict=True)
    ]


def _shift(what: str) -> list[_Column]:
    return [(f"tcp_shift_{axis}_m", _DOUBLE, "m", f"{what} along the camera's {axis}") for axis in AXES]


_TRIANGLE_WORDS = "upper triangle, row by row, of 6 x 6: the TCP's position in camera axes, then the rotation vector"
_WHEN: list[_Column] = [
    ("time", TIME, "UTC", "stamp_ns as a time"),
    ("stamp_ns", _INTEGER, "ns", "capture time, or when it was said: Unix"),
    ("seq", _INTEGER, "1", "number of the frame, or of the last one before it"),
]
_RUN: list[_Column] = [
    ("recording_id", _TEXT, "", "the run of the monitor that this is from"),
    ("file_number", pa.int32(), "1", "which of the recording's files it is from"),
]
_REFERENCE: list[_Column] = [
    ("reference_id", _TEXT, "", "the reference in force, which drift is measured against"),
    ("revision", _INTEGER, "1", "of the reference"),
]

FRAMES: list[_Column] = [
    *_WHEN,
    ("verdict", _TEXT, "", "valid, suspect or unknown"),
    ("state", _TEXT, "", "what the monitor was doing"),
    ("source", _TEXT, "", "update, recalibration or held"),
    *_shift("displacement of the TCP against the reference"),
    *[(f"sigma_{axis}_m", _DOUBLE, "m", f"standard deviation of the TCP along the camera's {axis}") for axis in AXES],
    ("protection_m", _DOUBLE, "m", "protection level: bound on the TCP's position error"),
    ("protection_rad", _DOUBLE, "rad", "bound on the angle of the rotation error"),
    ("integrity_risk", _DOUBLE, "1", "probability a frame that the error exceeds a bound"),
    ("d_m", _DOUBLE, "m", "length of the camera's displacement against the reference"),
    ("delta_rad", _DOUBLE, "rad", "turn of the camera against the reference"),
    *_pose("cam_T_grip", "maps gripper to camera coordinates"),
    ("covariance", TRIANGLE, "m2, m rad, rad2", f"of cam_T_grip: {_TRIANGLE_WORDS}"),
    *_pose("smoothed", "cam_T_grip averaged over time"),
    ("smoothed_covariance", TRIANGLE, "m2, m rad, rad2", f"of smoothed: {_TRIANGLE_WORDS}"),
    *_REFERENCE,
    ("rms_px", _DOUBLE, "px", "root mean square of the corners' residuals"),
    ("jaw_opening_m", _DOUBLE, "m", "as the image shows it"),
    ("latency_ns", _INTEGER, "ns", "from when the frame came to the monitor's machine to judged"),
    ("corners_used", pa.int32(), "1", "corners that the transform rests on"),
    ("corners_total", pa.int32(), "1", "corners of the gripper file"),
    ("refused", _TRUTH, "", "nothing was measured in this frame"),
    *_RUN,
]

ALERTS: list[_Column] = [
    *_WHEN,
    ("event", _TEXT, "", "raised, updated, cleared or noted"),
    ("alert_id", _TEXT, "", "the same from raised to cleared; empty for what is only noted"),
    ("kind", _TEXT, "", "what it is about"),
    ("cause", _TEXT, "", "the most probable one"),
    ("part", _TEXT, "", "the finger that the cause is about"),
    ("severity", _TEXT, "", "info, warning or error"),
    ("text", _TEXT, "", "one line for a person"),
    ("causes", CAUSES, "1", "all that were weighed, with their probabilities"),
    *_shift("of the TCP against the reference"),
    ("rotation_rad", _DOUBLE, "rad", "turn against the reference"),
    ("rate_m_per_min", _DOUBLE, "m/min", "speed of a creep"),
    ("time_left_s", _DOUBLE, "s", "until a creep reaches the limit"),
    ("since_ns", _INTEGER, "ns", "when it was raised: Unix"),
    ("acknowledged", _TRUTH, "", "an operator has taken note of it"),
    ("state", _TEXT, "", "what the monitor was doing"),
    *_REFERENCE,
    *_RUN,
]

STATES: list[_Column] = [
    *_WHEN,
    ("state", _TEXT, "", "what the monitor was doing"),
    ("verdict", _TEXT, "", "of the last transform"),
    ("message", _TEXT, "", "what is wrong, in words; empty when all is well"),
    *_REFERENCE,
    ("frames", _INTEGER, "1", "handled since the start"),
    ("frames_refused", _INTEGER, "1", "of these, those that couldn't be measured at all"),
    ("frames_dropped", _INTEGER, "1", "that came while another one was worked on"),
    ("recording_dropped", _INTEGER, "1", "frames that the recording had no time for"),
    ("recording_images_dropped", _INTEGER, "1", "images that the recording had no time for, of frames that it has"),
    ("transforms_unsent", _INTEGER, "1", "before there was a Zenoh session"),
    ("malformed", _INTEGER, "1", "messages received that were none"),
    ("frames_per_s", _DOUBLE, "1/s", "rate of the last frames"),
    ("uptime_s", _DOUBLE, "s", "since the start"),
    ("camera_connected", _TRUTH, "", "the source is open"),
    *_shift("of the TCP against the reference"),
    ("sigma_m", _DOUBLE, "m", "largest standard deviation of the TCP along a camera axis"),
    ("protection_m", _DOUBLE, "m", "bound on the TCP's position error, of the last transform"),
    ("alert_limit_m", _DOUBLE, "m", "error of the TCP's position that the task bears, as configured"),
    ("open_alerts", pa.int32(), "1", "alerts raised and not cleared"),
    ("version", _TEXT, "", "of gripmon"),
    *_RUN,
]

COMMANDS: list[_Column] = [
    *_WHEN,
    ("name", _TEXT, "", "of the command"),
    ("argument", _TEXT, "", "as it was given"),
    ("done", _TRUTH, "", "false: refused"),
    ("text", _TEXT, "", "what was done, or why not"),
    *_RUN,
]

REFERENCES: list[_Column] = [
    ("reference_id", _TEXT, "", "its name, which no other reference has"),
    ("revision", _INTEGER, "1", "grows by one with every change"),
    ("time", TIME, "UTC", "stamp_ns as a time; null for a configured one"),
    ("stamp_ns", _INTEGER, "ns", "of the newest frame behind it or of the command: Unix; null for a configured one"),
    ("origin", _TEXT, "", "configuration, recalibration, undo or reset"),
    *_pose("cam_T_grip", "maps gripper to camera coordinates"),
    ("covariance", TRIANGLE, "m2, m rad, rad2", f"of cam_T_grip: {_TRIANGLE_WORDS}"),
    ("parent", _TEXT, "", "the reference in force before"),
    ("restores", _TEXT, "", "the earlier one that an undo or reset brought back"),
    ("cause", _TEXT, "", "what made it necessary"),
    ("accepted_by", _TEXT, "", "configuration, monitor or operator"),
    ("first_seq", _INTEGER, "1", "the first frame that was averaged"),
    ("last_seq", _INTEGER, "1", "the last one"),
    ("frames_used", _INTEGER, "1", "how many of them were used"),
    ("weighted_rms", _DOUBLE, "1", "of the residuals over their deviations"),
    ("step_m", _DOUBLE, "m", "by how much it moved the reference before it"),
    ("step_rad", _DOUBLE, "rad", "by how much it turned it"),
]


def _schema(table: str, columns: list[_Column]) -> pa.Schema:
    fields = [pa.field(name, kind, metadata={"unit": unit, "description": text}) for name, kind, unit, text in columns]
    units = {name: unit for name, _, unit, _ in columns if unit}
    about = {
        "gripmon.schema": f"gripmon.export.{table}/1",
        "gripmon.version": __version__,
        "gripmon.units": json.dumps(units),
    }
    return pa.schema(fields, metadata=about)


SCHEMAS: dict[str, pa.Schema] = {
    "frames": _schema("frames", FRAMES),
    "alerts": _schema("alerts", ALERTS),
    "states": _schema("states", STATES),
    "commands": _schema("commands", COMMANDS),
    "references": _schema("references", REFERENCES),
}
"""What each table has; a column may be added within a major version, none renamed or dropped."""
