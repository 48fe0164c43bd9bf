"""Pulses of a second camera's laser -> columns of a rerun recording: which entity holds what.

Timelines: ``capture_time`` (the pulse's ``stamp_ns``) and ``frame`` (``seq`` of its last frame).

==============================  ====================================================================================
``base``                        the robot's base, metres;  ``plane``, ``camera`` and its ``image`` as calibrated
``base/camera/image/spot``      where the spot was seen;  ``foreseen`` by the calibration, ``off`` from that to this
``base/ee``, ``base/beam``      the end-effector, and the beam from its laser to where the calibration has the spot
``off/px``, ``off/sigma_px``    the spot less where it was foreseen (u, v), and the band of one standard deviation
``gaps/mm``, ``sigma_mm``       how far the three ways to the spot disagree, one curve a pair
``test/square``                 normalised square of ``off``;  ``moved``: probability that anything has moved
``shift/mm``, ``mrad``          of the camera, base axes
``timing/judged_ms``            from a pulse's frames to its judgement
``record``                      the pulse's whole record, one JSON line, to the last digit
``status``, ``events``, ``meta``, ``configuration``, ``alert``, ``command``, ``state``: as of a wrist camera
==============================  ====================================================================================
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from gripmon.laser.setup import LaserCalibration, laser_lines, setup_of, spots_on_plane
from gripmon.model.geometry import invert, make_transform, rotation_from_xyzw
from gripmon.model.records import Array, SpotRecord, to_json
from gripmon.record.write import palette
from gripmon.record.write.columns import Sender, SpotRow
from gripmon.record.write.events import EventWriter
from gripmon.record.write.laser_scene import plane_corners
from gripmon.record.write.rows import log_origin
from gripmon.record.write.spot_layout import IMAGE
from gripmon.record.write.wire import Events, Scene

_AXIS_M, _SIDE = 0.1, 0.4
_SPOT_PX = 2.5
_UV, _XYZ = ["u", "v"], ["x", "y", "z"]
_GAPS: tuple[palette.Colour, ...] = (palette.BUSY, palette.DOUBTFUL, palette.REPAIR, palette.GOOD)


class SpotWriter:
    """Writes rows into one file.  The constructor writes what is static."""

    def __init__(self, stream: rr.RecordingStream, scene: Scene, file_number: int):
        assert scene.laser is not None, "a second camera's"
        self._send = Sender(stream)
        self._events = EventWriter(self._send)
        self._setup = setup_of(scene.laser)
        self._gap_names: tuple[str, ...] = ()
        _log_cell(self._send, scene, scene.laser)
        _log_styles(self._send)
        _log_about(self._send, scene)
        log_origin(self._send, scene, file_number)

    def write(self, rows: Sequence[SpotRow], events: Events) -> None:
        """Send everything that was gathered since the last call."""
        if rows:
            self._send.frames("record", rows, rr.AnyValues.columns(json=[to_json(r.record).decode() for r in rows]))
            self._curves(rows)
            self._places(rows)
            self.write_pictures([row for row in rows if row.picture is not None])
        self._events.write(rows, events, [])

    def write_pictures(self, rows: Sequence[SpotRow]) -> None:
        """Send the pictures of pulses."""
        pictures = [row.picture for row in rows if row.picture is not None]
        if pictures:
            columns = rr.EncodedImage.columns(
                blob=[np.frombuffer(p.blob, np.uint8) for p in pictures], media_type=[p.media_type for p in pictures]
            )
            self._send.frames(IMAGE, rows, columns)

    def repeat(self) -> None:
        """Say again, with the next pulse, what else is only said when it changes."""
        self._events.repeat()

    def finish(self) -> None:
        """Nothing is kept back."""

    def _curves(self, rows: Sequence[SpotRow]) -> None:
        send, records = self._send, [row.record for row in rows]
        send.scalars("off/px", rows, [record.off_px or () for record in records])
        send.scalars("off/sigma_px", rows, [_band_px(record) for record in records])
        send.curve("test/square", rows, [record.square for record in records])
        send.curve("test/moved", rows, [record.probability_moved for record in records])
        send.curve("timing/judged_ms", rows, [1e-6 * record.latency_ns for record in records])
        shifts = [record.shift for record in records]
        send.scalars("shift/mm", rows, [() if s is None else [1e3 * v for v in s.translation_m] for s in shifts])
        send.scalars("shift/mrad", rows, [() if s is None else [1e3 * v for v in s.rotation_rad] for s in shifts])
        self._gaps(rows)

    def _gaps(self, rows: Sequence[SpotRow]) -> None:
        """One curve a pair; which ones there are, the first pulse that has them says."""
        for row in rows:
            names = tuple(" / ".join(gap.ways) for gap in row.record.gaps)
            if names and names != self._gap_names:
                self._gap_names = names
                for entity in ("gaps/mm", "gaps/sigma_mm"):
                    faint = 255 if entity == "gaps/mm" else 110
                    colours = [palette.faded(_GAPS[k % len(_GAPS)], faint) for k in range(len(names))]
                    self._send.static(entity, rr.SeriesLines(names=names, colors=colours, widths=[1.5] * len(names)))
        distances = [[1e3 * float(np.linalg.norm(gap.gap_m)) for gap in row.record.gaps] for row in rows]
        self._send.scalars("gaps/mm", rows, distances)
        self._send.scalars("gaps/sigma_mm", rows, [[1e3 * gap.sigma_m for gap in row.record.gaps] for row in rows])

    def _places(self, rows: Sequence[SpotRow]) -> None:
        records = [row.record for row in rows]
        for used in (True, False):
            some = [record.uv_px if record.used == used else None for record in records]
            self._points(f"spot/{'believed' if used else 'refused'}", rows, some)
        self._points("foreseen", rows, [record.foreseen_px for record in records])
        lines = [[r.foreseen_px, r.uv_px] if r.off_px is not None else None for r in records]
        strips = [np.array(line, np.float32) for line in lines if line is not None]
        columns = rr.LineStrips2D.columns(strips=strips).partition([int(line is not None) for line in lines])
        self._send.frames(f"{IMAGE}/off", rows, columns)
        poses = [record.base_T_ee for record in records]
        placed = rr.Transform3D.columns(
            translation=[pose.translation_m for pose in poses], quaternion=[pose.rotation_xyzw for pose in poses]
        )
        self._send.frames("base/ee", rows, placed)
        beams = [self._beam(record) for record in records]
        strips = [beam for beam in beams if beam is not None]
        columns = rr.LineStrips3D.columns(strips=strips).partition([int(beam is not None) for beam in beams])
        self._send.frames("base/beam", rows, columns)

    def _points(self, name: str, rows: Sequence[SpotRow], points: Sequence[tuple[float, float] | None]) -> None:
        flat = np.array([point for point in points if point is not None], np.float32).reshape(-1, 2)
        columns = rr.Points2D.columns(positions=flat).partition([int(point is not None) for point in points])
        self._send.frames(f"{IMAGE}/{name}", rows, columns)

    def _beam(self, record: SpotRecord) -> Array | None:
        """From the laser to the spot as calibrated, (2, 3) base frame; None where the beam misses the plane."""
        pose = record.base_T_ee
        base_T_ee = make_transform(rotation_from_xyzw(pose.rotation_xyzw), np.array(pose.translation_m))
        ends = np.concatenate(
            [laser_lines(self._setup, base_T_ee[None])[0], spots_on_plane(self._setup, base_T_ee[None])[0]]
        )
        base_T_cam = invert(self._setup.cam_T_base)
        out: Array = ends @ base_T_cam[:3, :3].T + base_T_cam[:3, 3]
        return out.astype(np.float32) if np.isfinite(out).all() else None


def _band_px(record: SpotRecord) -> list[float]:
    """Of one standard deviation about zero, u and v."""
    if record.off_covariance_px2 is None:
        return []
    u, v = np.sqrt(record.off_covariance_px2[0]), np.sqrt(record.off_covariance_px2[3])
    return [float(u), float(-u), float(v), float(-v)]


def _log_cell(send: Sender, scene: Scene, calibration: LaserCalibration) -> None:
    setup = setup_of(calibration)
    base_T_cam = invert(setup.cam_T_base)
    turn, centre = base_T_cam[:3, :3], base_T_cam[:3, 3]
    send.static("base", rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.TransformAxes3D(_AXIS_M))
    send.static("base/ee", rr.TransformAxes3D(0.5 * _AXIS_M))
    middle = turn @ (setup.distance_m / setup.normal_cam[2] * np.array([0.0, 0.0, 1.0])) + centre
    corners = plane_corners(turn @ setup.normal_cam, middle, _SIDE * setup.distance_m)
    send.static(
        "base/plane",
        rr.Mesh3D(vertex_positions=corners, triangle_indices=[[0, 1, 2], [0, 2, 3]],
                  albedo_factor=palette.faded(palette.GOOD, 90)),
    )  # fmt: skip
    send.static("base/camera", rr.Transform3D(translation=centre, mat3x3=turn), rr.TransformAxes3D(0.5 * _AXIS_M))
    send.static(
        IMAGE,
        rr.Pinhole(
            resolution=[scene.width_px, scene.height_px], focal_length=scene.focal_px, principal_point=scene.centre_px,
            camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.3 * setup.distance_m,
        ),
    )  # fmt: skip


def _log_styles(send: Sender) -> None:
    seen = rr.Points2D.from_fields
    send.static(f"{IMAGE}/spot/believed", seen(colors=palette.EDGE_USED, radii=_SPOT_PX))
    send.static(f"{IMAGE}/spot/refused", seen(colors=palette.EDGE_REFUSED, radii=_SPOT_PX))
    send.static(f"{IMAGE}/foreseen", seen(colors=palette.PREDICTED, radii=_SPOT_PX))
    send.static(f"{IMAGE}/off", rr.LineStrips2D.from_fields(colors=palette.SHIFT, radii=1.0))
    send.static("base/beam", rr.LineStrips3D.from_fields(colors=palette.BAD, radii=0.001))
    u, v = palette.AXES[:2]
    send.static("off/px", rr.SeriesLines(names=_UV, colors=[u, v], widths=[1.5] * 2))
    bands = [palette.faded(colour, 110) for colour in (u, u, v, v)]
    send.static("off/sigma_px", rr.SeriesLines(names=["+σ u", "-σ u", "+σ v", "-σ v"], colors=bands, widths=[0.7] * 4))
    for entity in ("shift/mm", "shift/mrad"):
        send.static(entity, rr.SeriesLines(names=_XYZ, colors=list(palette.AXES), widths=[1.5] * 3))
    send.static("test/square", rr.SeriesLines(names=["square"], colors=[palette.BUSY]))
    send.static("test/moved", rr.SeriesLines(names=["probability moved"], colors=[palette.BAD]))


def _log_about(send: Sender, scene: Scene) -> None:
    about = (
        f"# {scene.robot} / {scene.camera}\n\ngripmon {scene.version}, a second camera, watched with a pulsed laser, "
        f"{scene.width_px} x {scene.height_px} px\n\nLens: `{scene.lens}`\n\nImage: the last pulse, with the spot "
        "green where it was believed and red where not, and where the calibration foresees it blue.\n"
    )
    send.static("about", rr.TextDocument(about, media_type="text/markdown"))
