"""Runs one episode through the monitor: its stretches, or why there are none.  This is what workers run."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from typing import Any

import msgspec

from gripmon.analyse.dataset import Measured
from gripmon.analyse.stretches import stretches_of
from gripmon.daemon.api import Monitor
from gripmon.daemon.config import Config
from gripmon.daemon.config.checks import view_fault
from gripmon.daemon.dataset.fitting import chosen, fit_of, spread
from gripmon.io.sources import FolderSettings, Source, SourceError, VideoSettings, open_source
from gripmon.io.sources.episodes import Episode
from gripmon.judge.recalibrate import Proposal
from gripmon.judge.references import CommandRefused
from gripmon.model.camera import make_camera
from gripmon.model.errors import in_short
from gripmon.model.records import (
    Alert,
    Command,
    CommandName,
    Frame,
    FrameRecord,
    Image,
    MeasurementTrace,
    ReferenceRecord,
    Verdict,
)
from gripmon.record.table import FrameTable, TableBuilder

PICTURE_WIDTH_PX = 320
"""Width of thumbnails of about 8 kB, in which fingertips are recognisable; 390,000 take 3 GB."""
_JPEG_QUALITY = 75

Pictured = tuple[Image, MeasurementTrace]
Configs = tuple[Config, ...]
"""One configuration per possible gripper file, otherwise equal."""


def measure(configs: Configs, episode: Episode, lens: str = "file") -> Measured:
    """An episode's stretches; ``fault`` says what is wrong with it.  Never raises.

    Uses the one of ``configs`` whose gripper the episode shows; there is no result if several or none of them fit.

    The episode gets its own reference: the monitor is commanded to recalibrate with its first measured frame, and
    starts again from the new reference; if it isn't recalibrated, or only after a motion, the configuration's reference
    stays.  ``lens``: "file" for the camera calibration that comes with the frames, if any; "config" for the
    configuration's in any case.
    """
    try:
        return _measured(configs, episode, lens)
    except SourceError as error:
        return failed(configs, episode, str(error))
    except Exception as error:  # noqa: BLE001  one bad episode must not stop the others
        return failed(configs, episode, in_short(error))


def failed(configs: Configs, episode: Episode, fault: str) -> Measured:
    """The result for an episode that can't be measured."""
    return Measured(episode.name, _camera(configs[0], episode), episode.key, episode.version, fault=fault)


def _camera(config: Config, episode: Episode, source: Source | None = None) -> str:
    """Name of the camera: topic or feature; for plain images and videos that of the configuration."""
    if isinstance(episode.source, FolderSettings | VideoSettings):
        return config.settings.camera_name
    return str(getattr(source, "topic", None) or episode.source.camera or "unknown")


def _measured(configs: Configs, episode: Episode, lens: str) -> Measured:
    source = open_source(episode.source)
    camera = _camera(configs[0], episode, source)
    from_file = getattr(source, "camera", None) if lens == "file" else None
    if from_file is not None:
        configs = tuple(
            dataclasses.replace(
                one, settings=msgspec.structs.replace(one.settings, camera=from_file), camera=make_camera(from_file)
            )
            for one in configs
        )
    config = configs[0]
    if len(configs) > 1:
        frames = spread(_frames(source))
        found = chosen([fit_of(one, frames) for one in configs])
        if isinstance(found, str):
            return Measured(episode.name, camera, episode.key, episode.version, fault=found)
        config, source = configs[found], open_source(episode.source)
    elif from_file is not None and (fault := view_fault(config.view(), config.gripper, config.camera)) is not None:
        raise SourceError(f"{fault.key}: with the file's camera {fault.wrong}; {fault.right}")
    run, coming, own = _Run(config), _frames(source), False
    renewed = run.until_renewed(coming)
    if renewed is not None:
        anew = _Run(dataclasses.replace(config, reference=renewed)).whole(_frames(open_source(episode.source)))
        own = anew.began_at_reference
        run = anew if own else run.whole(coming)  # a reference of after a motion doesn't fit what was before
    source.close()
    table = run.table()
    plain = Measured(
        episode.name, camera, episode.key, episode.version, frames=len(table), own_reference=own,
        gripper=config.gripper_path.stem, lens="configuration" if from_file is None else "file",
    )  # fmt: skip
    try:
        stretches = tuple(stretches_of(table, run.alerts, run.reasons, config.settings.monitor.policy))
    except ValueError as error:
        why = Counter(reason for reason in run.reasons if reason).most_common(1)
        return msgspec.structs.replace(plain, fault=f"{error}{f' ({why[0][1]} times: {why[0][0]})' if why else ''}")
    return msgspec.structs.replace(plain, stretches=stretches, pictures=run.pictures(len(stretches)))


def _frames(source: Source) -> Iterator[Frame]:
    try:
        while isinstance(frame := source.read(), Frame):
            yield frame
    finally:
        source.close()


class _Run:
    """A monitor's run over an episode, with memory for one table row per frame."""

    def __init__(self, config: Config) -> None:
        self._monitor, self._builder = Monitor(config), TableBuilder()
        self.alerts: list[tuple[int, Alert]] = []
        self.reasons: list[str | None] = []
        self.began_at_reference = True
        self._first: Pictured | None = None
        self._last: Pictured | None = None

    def until_renewed(self, frames: Iterator[Frame]) -> ReferenceRecord | None:
        """Process frames until the monitor, commanded at the first measured one, recalibrates; None: it hasn't."""
        asked, revision = False, self._monitor.reference.revision
        for frame in frames:
            record = self.process(frame)
            if not asked and record.measured:
                asked = True
                try:
                    self._monitor.command(Command(CommandName.RECALIBRATE, ""), record.stamp_ns)
                except CommandRefused:
                    continue
            found = self._monitor.recalibration
            if self._monitor.proposal is not None and isinstance(found, Proposal) and found.needs_person is None:
                # The camera may be elsewhere than the configuration's reference has it: that is why this was asked for.
                self._monitor.command(Command(CommandName.ACCEPT, ""), record.stamp_ns)
            if self._monitor.reference.revision != revision:
                return self._monitor.reference
        return None

    def whole(self, frames: Iterator[Frame]) -> _Run:
        """The run after all of ``frames``."""
        for frame in frames:
            self.process(frame)
        return self

    def process(self, frame: Frame) -> FrameRecord:
        record = self._monitor.process(frame)
        self.began_at_reference &= not self._monitor.displaced_at_start
        self._builder.add(record)
        self.alerts += [(record.stamp_ns, alert) for alert in record.alerts]
        self.reasons.append(record.reason)
        if record.verdict is Verdict.VALID and frame.image is not None and (trace := self._monitor.trace()) is not None:
            self._first = self._first or (frame.image, trace)
            self._last = frame.image, trace
        return record

    def table(self) -> FrameTable:
        return TableBuilder.join([self._builder])

    def pictures(self, stretches: int) -> tuple[bytes, ...]:
        """JPEGs of the first valid frame and, if the camera moved, of the last."""
        shown = [self._first, self._last] if stretches > 1 else [self._first]
        return tuple(_drawn(*each) for each in shown if each is not None)


def _drawn(image: Image, trace: MeasurementTrace) -> bytes:
    """A small JPEG with the predicted edges (blue) and the edge points that were used (green)."""
    import cv2
    import numpy as np

    shift, scale = 4, PICTURE_WIDTH_PX / image.shape[1]
    grey: Any = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if grey.dtype != np.uint8:
        grey = (255.0 * (grey / grey.max())).astype(np.uint8)
    canvas = cv2.cvtColor(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)

    def placed(points: Any) -> Any:
        return np.round(((np.asarray(points) + 0.5) * scale - 0.5) * (1 << shift)).astype(np.int32)

    for edge in trace.predicted_edges_uv_px:
        cv2.polylines(canvas, [placed(edge)[:, None]], False, (255, 120, 40), 1, cv2.LINE_AA, shift)
    for point in placed(trace.edge_uv_px[trace.edge_used]).tolist():
        cv2.circle(canvas, point, 1 << (shift - 1), (60, 220, 60), -1, cv2.LINE_AA, shift)
    return bytes(cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes())
