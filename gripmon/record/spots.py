"""A second camera's laser pulses -> columns of a rerun recording: which entity contains what; and a laser calibration
as a 3D scene.

Timelines: ``capture_time`` (the pulse's ``stamp_ns``) and ``frame`` (``seq`` of its last frame).

==============================  ====================================================================================
``base``                        the robot's base, metres;  ``plane``, ``camera`` and its ``image`` as calibrated
``base/camera/image/spot``      where the spot was detected;  ``foreseen`` where predicted, ``off`` from there to it
``base/ee``, ``base/beam``      the end-effector, and the beam from its laser to the calibrated spot
``off/px``, ``off/sigma_px``    spot minus prediction (u, v), and the band of one standard deviation
``gaps/mm``, ``sigma_mm``       disagreement of the three residual tests, one curve per pair
``test/square``                 normalised square of ``off``;  ``moved``: probability that anything has moved
``shift/mm``, ``mrad``          of the camera, base axes
``timing/judged_ms``            from a pulse's frames to its judgement
``record``                      the pulse's whole record, one JSON line, to the last digit
``status``, ``events``, ``meta``, ``configuration``, ``alert``, ``command``, ``state``: as of a wrist camera
==============================  ====================================================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from gripmon.laser.setup import LaserCalibration, LaserSetup, laser_lines, setup_of, spots_on_plane
from gripmon.model.camera import LensSettings
from gripmon.model.geometry import invert, make_transform, rotation_from_xyzw
from gripmon.model.records import Array, SpotRecord, to_json
from gripmon.record.columns import (
    AXIS,
    Colour,
    Palette,
    Sender,
    SpotRow,
    Writer,
    faded,
    image_view,
    log_view,
    pinhole,
    plot,
    pose_columns,
    two_columns,
)
from gripmon.record.recorder import Events, Scene

if TYPE_CHECKING:
    from gripmon.laser.refinement import Refined

IMAGE = "base/camera/image"
_USED, _LEFT_OUT, _BEAM, _PLANE = (40, 120, 230, 255), (230, 60, 60, 255), (235, 90, 90, 255), (90, 180, 120, 90)
_AXIS_M = 0.1
_PLANE_SIDE_FRACTION = 0.4  # half a side of the plane that is drawn, of its distance
_PLANE_MARGIN, _PLANE_LEAST_M = 1.3, 0.01  # half a side: this much more than the spots need, and at least
_SPOT_PX = 2.5
_UV, _XYZ = ["u", "v"], ["x", "y", "z"]
_GAPS: tuple[Colour, ...] = (Palette.BUSY, Palette.DOUBTFUL, Palette.REPAIR, Palette.GOOD)


class SpotWriter(Writer):
    """Writes the pulses of a second camera's laser."""

    def __init__(self, stream: rr.RecordingStream, scene: Scene, file_number: int):
        assert scene.laser is not None, "a second camera's"
        super().__init__(stream, scene, file_number, _about(scene.lens))
        self._setup = setup_of(scene.laser)
        self._gap_names: tuple[str, ...] = ()
        _log_cell(self._send, scene, scene.laser)
        _log_styles(self._send)

    def write(self, rows: Sequence[SpotRow], events: Events) -> None:
        if rows:
            self._write_records(rows)
            self._curves(rows)
            self._places(rows)
            self.write_pictures([row for row in rows if row.picture is not None])
        self._events.write(rows, events)

    def write_pictures(self, rows: Sequence[SpotRow]) -> None:
        self._send.images(IMAGE, rows)

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
        """One curve per pair, named as in the first pulse that has them."""
        for row in rows:
            names = tuple(" / ".join(gap.ways) for gap in row.record.gaps)
            if names and names != self._gap_names:
                self._gap_names = names
                for entity in ("gaps/mm", "gaps/sigma_mm"):
                    faint = 255 if entity == "gaps/mm" else 110
                    colours = [faded(_GAPS[k % len(_GAPS)], faint) for k in range(len(names))]
                    self._send.lines(entity, names, colours, 1.5)
        distances = [[1e3 * float(np.linalg.norm(gap.gap_m)) for gap in row.record.gaps] for row in rows]
        self._send.scalars("gaps/mm", rows, distances)
        self._send.scalars("gaps/sigma_mm", rows, [[1e3 * gap.sigma_m for gap in row.record.gaps] for row in rows])

    def _places(self, rows: Sequence[SpotRow]) -> None:
        records = [row.record for row in rows]
        self._points("spot/believed", rows, [record.uv_px if record.used else None for record in records])
        self._points("spot/refused", rows, [None if record.used else record.uv_px for record in records])
        self._points("foreseen", rows, [record.foreseen_px for record in records])
        lines = [[r.foreseen_px, r.uv_px] if r.off_px is not None else None for r in records]
        strips = [np.array(line, np.float32) for line in lines if line is not None]
        columns = rr.LineStrips2D.columns(strips=strips).partition([int(line is not None) for line in lines])
        self._send.frames(f"{IMAGE}/off", rows, columns)
        poses = [record.base_T_ee for record in records]
        self._send.frames("base/ee", rows, pose_columns(poses))
        beams = [self._beam(record) for record in records]
        strips = [beam for beam in beams if beam is not None]
        columns = rr.LineStrips3D.columns(strips=strips).partition([int(beam is not None) for beam in beams])
        self._send.frames("base/beam", rows, columns)

    def _points(self, name: str, rows: Sequence[SpotRow], points: Sequence[tuple[float, float] | None]) -> None:
        flat = np.array([point for point in points if point is not None], np.float32).reshape(-1, 2)
        columns = rr.Points2D.columns(positions=flat).partition([int(point is not None) for point in points])
        self._send.frames(f"{IMAGE}/{name}", rows, columns)

    def _beam(self, record: SpotRecord) -> Array | None:
        """From the laser to the calibrated spot, (2, 3) base frame; None if the beam misses the plane."""
        pose = record.base_T_ee
        base_T_ee = make_transform(rotation_from_xyzw(pose.rotation_xyzw), np.array(pose.translation_m))
        ends = np.concatenate(
            [laser_lines(self._setup, base_T_ee[None])[0], spots_on_plane(self._setup, base_T_ee[None])[0]]
        )
        base_T_cam = invert(self._setup.cam_T_base)
        out: Array = ends @ base_T_cam[:3, :3].T + base_T_cam[:3, 3]
        return out.astype(np.float32) if np.isfinite(out).all() else None


def _band_px(record: SpotRecord) -> list[float]:
    """The band of one standard deviation about zero, u and v."""
    if record.off_covariance_px2 is None:
        return []
    u, v = np.sqrt(record.off_covariance_px2[0]), np.sqrt(record.off_covariance_px2[3])
    return [float(u), float(-u), float(v), float(-v)]


def _log_cell(send: Sender, scene: Scene, calibration: LaserCalibration) -> None:
    setup = setup_of(calibration)
    turn, centre = _log_camera(send, setup, scene.lens)
    send.static("base", rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.TransformAxes3D(_AXIS_M))
    send.static("base/ee", rr.TransformAxes3D(0.5 * _AXIS_M))
    send.static("base/camera", rr.TransformAxes3D(0.5 * _AXIS_M))
    middle = turn @ (setup.distance_m / setup.normal_cam[2] * np.array([0.0, 0.0, 1.0])) + centre
    corners = _plane_corners(turn @ setup.normal_cam, middle, _PLANE_SIDE_FRACTION * setup.distance_m)
    send.static("base/plane", _plane(corners, faded(Palette.GOOD, 90)))


def _log_camera(send: Sender, setup: LaserSetup, lens: LensSettings) -> tuple[Array, Array]:
    """Log the camera and its image; returns its rotation (3, 3) and position (3,) in the base frame."""
    base_T_cam = invert(setup.cam_T_base)
    turn, centre = base_T_cam[:3, :3], base_T_cam[:3, 3]
    send.static("base/camera", rr.Transform3D(translation=centre, mat3x3=turn))
    send.static(IMAGE, pinhole(lens, 0.3 * setup.distance_m))
    return turn, centre


def _log_styles(send: Sender) -> None:
    seen = rr.Points2D.from_fields
    send.static(f"{IMAGE}/spot/believed", seen(colors=Palette.EDGE_USED, radii=_SPOT_PX))
    send.static(f"{IMAGE}/spot/refused", seen(colors=Palette.EDGE_REFUSED, radii=_SPOT_PX))
    send.static(f"{IMAGE}/foreseen", seen(colors=Palette.PREDICTED, radii=_SPOT_PX))
    send.static(f"{IMAGE}/off", rr.LineStrips2D.from_fields(colors=Palette.SHIFT, radii=1.0))
    send.static("base/beam", rr.LineStrips3D.from_fields(colors=Palette.BAD, radii=0.001))
    u, v = Palette.AXES[:2]
    send.lines("off/px", _UV, [u, v], 1.5)
    bands = [faded(colour, 110) for colour in (u, u, v, v)]
    send.lines("off/sigma_px", ["+σ u", "-σ u", "+σ v", "-σ v"], bands, 0.7)
    for entity in ("shift/mm", "shift/mrad"):
        send.lines(entity, _XYZ, list(Palette.AXES), 1.5)
    send.static("test/square", rr.SeriesLines(names=["square"], colors=[Palette.BUSY]))
    send.static("test/moved", rr.SeriesLines(names=["probability moved"], colors=[Palette.BAD]))


def _about(lens: LensSettings) -> str:
    return (
        f"a second camera, watched with a pulsed laser, {lens.width_px} x {lens.height_px} px\n\n"
        f"Lens: `{to_json(lens).decode()}`\n\nImage: the last pulse, with the spot green where it was accepted and red "
        "where not, and where the calibration predicts it blue."
    )


def spot_blueprint(scene: Scene) -> rrb.Blueprint:
    """Left: the pulse's image with the spot, and the events.  Right: the cell in space, then the tests."""
    cell = rrb.Spatial3DView(origin="base", contents=["base/**"], name="Base, camera, plane and beam", line_grid=False)
    judged = rrb.Vertical(
        cell,
        plot("off", "off/**", "Spot less predicted (px), band of one standard deviation", legend=False),
        plot("gaps", "gaps/**", "Disagreement of the three residual tests (mm)"),
        rrb.Tabs(
            plot("test", "test/moved", "Probability that something moved", legend=False),
            plot("test", "test/square", "Normalised square", legend=False),
            plot("shift", "shift/**", "Camera (mm, mrad)"),
            plot("timing", "timing/**", "Time (ms)"),
            rrb.TextDocumentView(origin="about", name="About"),
            active_tab=0,
        ),
        rrb.StateTimelineView(origin="status", name="State and verdict", time_view=AXIS),
        row_shares=[3.5, 2.5, 2.5, 2.5, 2],
    )
    image = image_view(scene, IMAGE, IMAGE, "spot: green accepted, red not; predicted blue")
    return two_columns([image, log_view()], [7, 2.4], judged)


def write_calibration(path: Path, refined: Refined, base_T_ee: Array, uv_px: Array) -> None:
    """Write a calibration: everything in the base frame, residuals in the camera's image.  Raises OSError."""
    path.open("wb").close()
    recording = rr.RecordingStream("gripmon_laser")
    recording.save(path)
    setup, log = refined.setup, Sender(recording).static
    turn, centre = _log_camera(Sender(recording), setup, refined.camera)
    spots = spots_on_plane(setup, base_T_ee)[0] @ turn.T + centre
    origins = laser_lines(setup, base_T_ee)[0] @ turn.T + centre
    seen = np.isfinite(spots).all(axis=1)
    colours = [_USED if used else _LEFT_OUT for used in refined.used]
    log("base", rr.Transform3D(translation=[0.0, 0.0, 0.0]))
    log("base/axes", rr.Arrows3D(vectors=_AXIS_M * np.eye(3), colors=[(220, 40, 40), (60, 160, 60), (40, 90, 220)]))
    shown = [colours[k] for k in np.flatnonzero(seen)]
    log("base/spots", rr.Points3D(spots[seen], colors=shown, radii=0.002))
    log("base/beams", rr.LineStrips3D(np.stack([origins[seen], spots[seen]], axis=1), colors=_BEAM, radii=0.0005))
    normal = turn @ setup.normal_cam
    middle = np.median(spots[seen], axis=0)
    side = max(_PLANE_MARGIN * float(np.linalg.norm(spots[seen] - middle, axis=1).max()), _PLANE_LEAST_M)
    log("base/plane", _plane(_plane_corners(normal, middle, side), _PLANE))
    log("base/camera/image/spots", rr.Points2D(uv_px, colors=colours, radii=2.0))
    lines = np.stack([uv_px, uv_px - refined.residuals_px], axis=1)[seen]
    log("base/camera/image/residuals", rr.LineStrips2D(lines, colors=_LEFT_OUT))
    recording.flush()
    recording.disconnect()


def _plane_corners(normal: Array, middle: Array, side: float) -> Array:
    """Corners (4, 3) of a square on a plane; ``side``: half of its side, m."""
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    out: Array = middle + side * np.array([first + second, first - second, -first - second, -first + second])
    return out


def _plane(corners: Array, colour: Colour) -> rr.Mesh3D:
    return rr.Mesh3D(vertex_positions=corners, triangle_indices=[[0, 1, 2], [0, 2, 3]], albedo_factor=colour)
