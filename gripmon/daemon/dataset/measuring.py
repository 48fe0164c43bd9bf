"""Runs one episode through the monitor: its stretches, or why there are none.  This is what workers run."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

import msgspec

from gripmon.analyse.stretches import Stretch, stretches_of
from gripmon.daemon.api import Monitor
from gripmon.daemon.config import Config
from gripmon.daemon.config.checks import view_fault
from gripmon.daemon.overlay import outlines_of, overlay
from gripmon.io.sources import FolderSettings, OpenedSource, Source, SourceError, VideoSettings, open_source
from gripmon.io.sources.episodes import Episode
from gripmon.judge.recalibrate import Proposal
from gripmon.judge.references import CommandRefused
from gripmon.model.camera import make_camera
from gripmon.model.errors import in_short
from gripmon.model.geometry import from_record
from gripmon.model.records import (
    Alert,
    Command,
    CommandName,
    Frame,
    FrameRecord,
    Image,
    ReferenceRecord,
    Verdict,
)
from gripmon.record.table import FrameTable, TableBuilder

PICTURE_WIDTH_PX = 320
"""Width of thumbnails of about 18 kB, in which fingertips are recognisable; 390,000 take 7 GB."""

Pictured = tuple[Image, FrameRecord]
Rows = tuple[Stretch, ...]


def measure(config: Config, episode: Episode, lens: str = "file") -> Rows:
    """The rows of an episode: its stretches, or a single one that says what is wrong with it.  Never raises.

    The episode gets its own reference: the monitor is commanded to recalibrate with its first measured frame, and
    starts again from the new reference; if it isn't recalibrated, or only after a motion, the configuration's reference
    stays.  ``lens``: "file" for the camera calibration that comes with the frames, if any; "config" for the
    configuration's in any case.
    """
    try:
        return _measured(config, episode, lens)
    except SourceError as error:
        return failed(config, episode, str(error))
    except Exception as error:  # noqa: BLE001  one bad episode must not stop the others
        return failed(config, episode, in_short(error))


def failed(config: Config, episode: Episode, fault: str) -> Rows:
    """The row of an episode that can't be measured."""
    return (Stretch(episode=episode.name, camera=_camera(config, episode), reason=fault),)


def _camera(config: Config, episode: Episode, source: Source | None = None) -> str:
    """Name of the camera: topic or feature; for plain images and videos that of the configuration."""
    if isinstance(episode.source, FolderSettings | VideoSettings):
        return config.settings.camera_name
    return str(getattr(source, "topic", None) or episode.source.camera or "unknown")


def _measured(config: Config, episode: Episode, lens: str) -> Rows:
    source = open_source(episode.source)
    camera = _camera(config, episode, source)
    from_file = getattr(source, "camera", None) if lens == "file" else None
    if from_file is not None:
        settings = msgspec.structs.replace(config.settings, camera=from_file)
        config = dataclasses.replace(config, settings=settings, camera=make_camera(from_file))
        if (fault := view_fault(config.view(), config.gripper, config.camera)) is not None:
            raise SourceError(f"{fault.key}: with the file's camera {fault.wrong}; {fault.right}")
    run, own = _Run(config), False
    with OpenedSource(source) as frames:
        coming = iter(frames)
        renewed = run.until_renewed(coming)
        if renewed is not None:
            with OpenedSource(open_source(episode.source)) as again:
                anew = _Run(dataclasses.replace(config, reference=renewed)).whole(again)
            own = anew.began_at_reference
            run = anew if own else run.whole(coming)  # a reference of after a motion doesn't fit what was before
    table = run.table()
    plain: dict[str, Any] = {
        "episode": episode.name, "camera": camera, "own_reference": own, "gripper": config.gripper_path.stem,
        "lens": "configuration" if from_file is None else "file",
    }  # fmt: skip
    try:
        rows = stretches_of(table, run.alerts, run.reasons, config.settings.monitor.policy)
    except ValueError as error:
        why = Counter(reason for reason in run.reasons if reason).most_common(1)
        reason = f"{error}{f' ({why[0][1]} times: {why[0][0]})' if why else ''}"
        return (Stretch(**plain, frames=len(table), reason=reason),)
    shown = run.pictures(len(rows))
    return tuple(msgspec.structs.replace(row, **plain, picture=shown.get(row.stretch)) for row in rows)


class _Run:
    """A monitor's run over an episode, with memory for one table row per frame."""

    def __init__(self, config: Config) -> None:
        self._config, self._monitor, self._builder = config, Monitor(config), TableBuilder()
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

    def whole(self, frames: Iterable[Frame]) -> _Run:
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
        if record.verdict is Verdict.VALID and frame.image is not None:
            self._last = frame.image, record
            self._first = self._first or self._last
        return record

    def table(self) -> FrameTable:
        return TableBuilder.join([self._builder])

    def pictures(self, stretches: int) -> dict[int, bytes]:
        """JPEGs by number of the stretch: the first valid frame and, if the camera moved, the last."""
        shown = {0: self._first} | ({stretches - 1: self._last} if stretches > 1 else {})
        return {number: self._drawn(*each) for number, each in shown.items() if each is not None}

    def _drawn(self, image: Image, record: FrameRecord) -> bytes:
        assert record.measured_T is not None, "a valid frame has a transform"
        cam_T_grip, opening_m = from_record(record.measured_T), record.jaw_opening_m
        outlines = outlines_of(self._config.camera, self._config.gripper, cam_T_grip, opening_m)
        return overlay(image, record, outlines, PICTURE_WIDTH_PX)
