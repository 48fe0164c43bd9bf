"""Frames to record, and what a recording holds, read back with rerun's own reader."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import PaperLens, make_camera
from gripmon.model.geometry import exp_rotation, make_transform, to_record
from gripmon.model.records import (
    Absolute,
    Alert,
    CornerFault,
    CornerRecord,
    Drift,
    Frame,
    FrameRecord,
    MeasurementTrace,
    Origin,
    Protection,
    RecordedConfiguration,
    ReferenceRecord,
    Since,
    SinceReference,
    State,
    ValidBy,
    Verdict,
)
from gripmon.record.recorder import RecordingSettings, Scene
from gripmon.record.write import ProcessRecorder, open_recorder

START_NS = 1_700_000_000_123_456_789
OVERLAY = "rig/camera/image"
INTERVAL_NS = 16_666_667
WIDTH_PX, HEIGHT_PX = 320, 240
CAMERA = make_camera(
    PaperLens(
        width_px=WIDTH_PX, height_px=HEIGHT_PX, fx_px=400.0, fy_px=400.0, cx_px=159.5, cy_px=119.5, kappa_per_px2=0.0
    )
)
GRIPPER = read_gripper(Path(__file__).resolve().parents[2] / "configs" / "grippers" / "two_box_fingers.yaml")
COVARIANCE = tuple(np.diag([1e-10, 4e-10, 9e-10, 1e-8, 1e-8, 1e-8]).ravel().tolist())
REFERENCE = ReferenceRecord(
    reference_id="first",
    revision=1,
    stamp_ns=0,
    origin="configuration",
    cam_T_grip=to_record(make_transform(exp_rotation(np.array([0.5, 0.1, -0.2])), np.array([0.001, -0.002, 0.11]))),
    covariance=COVARIANCE,
)


def settings(**changes: Any) -> RecordingSettings:
    return msgspec.structs.replace(RecordingSettings(min_free_bytes=0, flush_period_s=0.1), **changes)


def scene(directory: Path, name: str = "run", **changes: Any) -> Scene:
    """``changes``: of the settings."""
    return Scene(
        name=name, directory=str(directory), settings=settings(**changes), robot="arm", camera="wrist",
        lens=CAMERA.settings, gripper=GRIPPER.model, reference=REFERENCE,
    )  # fmt: skip


def recorder(
    directory: Path,
    truth: Callable[[int], Any] | None = None,
    patience_s: float = 0.0,
    configuration: RecordedConfiguration | None = None,
    **changes: Any,
) -> ProcessRecorder:
    opened = open_recorder(
        settings(**changes),
        robot="arm",
        camera_name="wrist",
        camera=CAMERA,
        gripper=GRIPPER,
        reference=REFERENCE,
        directory=directory,
        name="run",
        truth_tcp_m=truth,
        patience_s=patience_s,
        configuration=configuration,
    )
    assert isinstance(opened, ProcessRecorder)
    return opened


def image(i: int) -> np.ndarray:
    """Grey gradients that differ from frame to frame and survive JPEG."""
    u, v = np.meshgrid(np.arange(WIDTH_PX), np.arange(HEIGHT_PX))
    return np.clip(100.0 + 80.0 * np.sin(0.02 * u + 0.1 * i) + 0.2 * v, 0.0, 255.0).astype(np.uint8)


def frame(i: int, picture: np.ndarray | None = None) -> Frame:
    return Frame(seq=i, stamp_ns=START_NS + i * INTERVAL_NS, image=image(i) if picture is None else picture)


def record(
    i: int,
    state: State = State.TRACKING,
    verdict: Verdict = Verdict.VALID,
    alerts: tuple[Alert, ...] = (),
    **changes: Any,
) -> FrameRecord:
    """A record whose every number differs from frame to frame and from field to field."""
    rng = np.random.default_rng(i)
    cam_T_grip = make_transform(exp_rotation(rng.normal(size=3)), rng.normal(size=3) * 0.01 + [0.0, 0.0, 0.11])
    corners = [
        CornerRecord(name, tuple(rng.uniform(0.0, HEIGHT_PX, 2).tolist()), 0.1, used=True)
        for name in GRIPPER.corner_ids
    ]
    corners[1] = CornerRecord(corners[1].id, None, None, used=False, reason=CornerFault.HIDDEN)
    made = FrameRecord(
        seq=i,
        stamp_ns=START_NS + i * INTERVAL_NS,
        verdict=verdict,
        state=state,
        source=Origin.UPDATE,
        cam_T_grip=to_record(cam_T_grip),
        covariance=COVARIANCE,
        smoothed=None,
        drift=Drift(rng.uniform(), rng.uniform(), tuple(rng.normal(size=3).tolist())),
        reference_id="first",
        revision=1,
        rms_px=float(rng.uniform()),
        jaw_opening_m=0.03 + 1e-4 * i,
        corners=tuple(corners),
        alerts=alerts,
        latency_ns=int(rng.integers(100_000, 200_000)),
        protection=Protection(rng.uniform(), rng.uniform(), 1e-5, "nothing is wrong"),
        valid_by=ValidBy.REFERENCE,
        since_reference=SinceReference(rng.uniform(), rng.uniform(), Since.FIRST_PROVED, START_NS + i),
        absolute=Absolute(rng.uniform(), rng.uniform(), *msgspec.structs.astuple(to_record(cam_T_grip))),
    )
    return msgspec.structs.replace(made, **changes)


def trace(i: int) -> MeasurementTrace:
    rng = np.random.default_rng(1000 + i)
    points = 40 + i
    predicted_corners = rng.uniform(0.0, HEIGHT_PX, (len(GRIPPER.corner_ids), 2))
    predicted_corners[2] = np.nan
    return MeasurementTrace(
        edge_uv_px=rng.uniform(0.0, HEIGHT_PX, (points, 2)),
        edge_used=rng.random(points) < 0.8,
        edge_index=np.zeros(points, np.intp),
        edge_residual_px=rng.normal(size=points),
        predicted_edges_uv_px=tuple(rng.uniform(0.0, HEIGHT_PX, (n, 2)) for n in (5, 2, 9)),
        predicted_corners_uv_px=predicted_corners,
    )


def wait_until(condition: Callable[[], bool], timeout_s: float = 20.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


@dataclass(frozen=True)
class Cell:
    """A value of one entity: the two times it carries (None for static) and its components by name."""

    stamp_ns: int | None
    seq: int | None
    values: dict[str, Any]


class Recorded:
    """Everything in the given files.  Opening them asserts that each is complete (its footer can be read)."""

    def __init__(self, *paths: Path):
        from rerun.chunk import RrdReader

        self.cells: dict[str, list[Cell]] = {}
        self.recording_ids: set[str] = set()
        self.blueprint: set[str] = set()
        for path in paths:
            reader = RrdReader(path)
            assert len(reader.store().stream().to_chunks()) > 0
            self.recording_ids |= {entry.recording_id for entry in reader.recordings()}
            for entry in reader.blueprints():
                self.blueprint |= {_text(chunk) for chunk in reader.stream(store=entry).to_chunks()}
            for chunk in reader.stream().to_chunks():
                self._add(chunk.entity_path.removeprefix("/"), chunk.to_record_batch())
        for cells in self.cells.values():
            cells.sort(key=lambda cell: -1 if cell.seq is None else cell.seq)

    def _add(self, path: str, batch: Any) -> None:
        names = batch.schema.names
        stamps = batch.column("capture_time").cast("int64").to_pylist() if "capture_time" in names else None
        seqs = batch.column("frame").to_pylist() if "frame" in names else None
        components = [n for n in names if n not in ("capture_time", "frame") and not n.startswith("rerun.")]
        columns = {name.split(":")[-1]: batch.column(name).to_pylist() for name in components}
        for row in range(batch.num_rows):
            self.cells.setdefault(path, []).append(
                Cell(
                    None if stamps is None else stamps[row],
                    None if seqs is None else seqs[row],
                    {name: column[row] for name, column in columns.items()},
                )
            )

    def timed(self, path: str) -> list[Cell]:
        return [cell for cell in self.cells.get(path, []) if cell.seq is not None]

    def by_seq(self, path: str, component: str) -> dict[int, Any]:
        found = {}
        for cell in self.timed(path):
            assert cell.seq is not None and cell.seq not in found, f"{path}: frame {cell.seq} twice"
            found[cell.seq] = cell.values[component]
        return found

    def seqs(self) -> list[int]:
        return sorted(self.by_seq("record", "json"))


def decoded(blob: list[list[int]]) -> np.ndarray:
    (data,) = blob
    picture = cv2.imdecode(np.array(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


def _text(chunk: Any) -> str:
    batch = chunk.to_record_batch()
    return str({name: batch.column(name).to_pylist() for name in batch.schema.names if ":" in name})
