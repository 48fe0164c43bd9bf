"""The monitor in a process of its own, with its images: ``gripmon run`` on the written configuration."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
import threading
from collections import deque
from pathlib import Path

import msgspec

from gripmon.client import Ambiguous, NotCarriedOut, TransformClient
from gripmon.daemon.config import Config, load_config
from gripmon.daemon.mount import MountView, view_of
from gripmon.daemon.overlay import outlines_of, overlay, picture_of
from gripmon.io.sources import FolderSettings
from gripmon.io.wire import PublishError
from gripmon.model.geometry import from_record
from gripmon.model.images import read_image
from gripmon.model.records import FrameRecord
from gripmon.teach.messages import BadRequest

_LINES = 200
_ASK_EVERY_S, _ANSWER_S, _ENDS_S = 0.2, 2.0, 20.0
_STAMP = re.compile(r"^\d{4}-\d\d-\d\d \S+ ")
_PICTURE_PX = 1000
_ENDED = {0: "ended", 3: "ended: no usable frame", 4: "ended: another monitor has this name", 130: "stopped"}


class MonitorView(msgspec.Struct, frozen=True, kw_only=True):
    """``record``: of the newest reply's frame; ``mount``: how the camera stands; ``shown`` counts the pictures;
    ``lines`` of its log, the newest last; ``ended``: how it ended, None while it runs or if it was never started.
    """

    running: bool
    ended: str | None
    record: FrameRecord | None
    mount: MountView | None
    shown: int
    lines: tuple[str, ...]


class MonitorProcess:
    """At most one monitor at a time, queried for its newest frame like ``gripmon send snapshot``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process: subprocess.Popen[str] | None = None
        self._threads: list[threading.Thread] = []
        self._lines: deque[str] = deque(maxlen=_LINES)
        self._record: FrameRecord | None = None
        self._mount: MountView | None = None
        self._picture: bytes | None = None
        self._shown = 0

    def start(self) -> None:
        """Start the monitor.  Raises :class:`BadRequest` while one runs, and
        :class:`~gripmon.model.errors.InputError` for an invalid configuration.
        """
        if self.running:
            raise BadRequest("the monitor is already running")
        config = load_config(self._folder / "config.yaml")
        self._lines.clear()
        self._record = self._picture = self._mount = None
        words = [sys.executable, "-m", "gripmon", "run", "config.yaml", "--out", "run"]
        self._process = subprocess.Popen(
            words, cwd=self._folder, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            text=True, errors="replace",
        )  # fmt: skip
        each = ((self._listen, (self._process,)), (self._ask, (self._process, config)))
        self._threads = [threading.Thread(target=run, args=arguments, daemon=True) for run, arguments in each]
        for thread in self._threads:
            thread.start()

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def stop(self) -> None:
        """Stop it like Ctrl-C; may be called twice."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(_ENDS_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        for thread in self._threads:
            thread.join(_ANSWER_S + 1.0)

    def seen(self) -> MonitorView:
        """For the page."""
        process = self._process
        code = None if process is None else process.poll()
        return MonitorView(
            running=process is not None and code is None,
            ended=None if code is None else _ENDED.get(code, f"ended with exit code {code}"),
            record=self._record,
            mount=self._mount,
            shown=self._shown,
            lines=tuple(self._lines),
        )

    def picture(self) -> bytes:
        """JPEG of the newest image with the measurements in it.  Raises :class:`BadRequest`."""
        if self._picture is None:
            raise BadRequest("the monitor has sent no image yet")
        return self._picture

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        for line in process.stderr:
            self._lines.append(_STAMP.sub("", line.rstrip()))

    def _ask(self, process: subprocess.Popen[str], config: Config) -> None:
        settings = config.settings
        where = settings.publish.listen or settings.publish.connect
        try:
            client = TransformClient(settings.robot, settings.camera_name, connect=where)
        except (PublishError, ValueError) as error:
            self._lines.append(f"no picture: {error}")
            return
        with client:
            while process.poll() is None:
                try:
                    reply, data = client.snapshot(_ANSWER_S)
                except (NotCarriedOut, Ambiguous):
                    reply, data = None, None  # it is starting or ending
                if reply is not None and reply.snapshot is not None:
                    seen = reply.snapshot
                    self._record = seen.record
                    self._mount = view_of(reply, settings.robot, settings.camera_name)
                    moved = reply.mount is not None and not reply.mount.within
                    with contextlib.suppress(ValueError):
                        self._picture = picture_of(seen, data, _PICTURE_PX, seen.reference_px if moved else None)
                        self._shown += 1
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_ASK_EVERY_S)
        self._last_line(config)

    def _last_line(self, config: Config) -> None:
        """A folder may end before the first query: show the last frame's record, with the folder's own image."""
        source = config.settings.source
        with contextlib.suppress(OSError, msgspec.MsgspecError, IndexError):
            lines = (self._folder / "run" / "estimates.jsonl").read_bytes().splitlines()
            record = msgspec.json.decode(lines[-1], type=FrameRecord)
            self._record = record
            if isinstance(source, FolderSettings) and record.name is not None:
                image, _ = read_image(config.directory / source.path / record.name)
                if image is not None:
                    pose = None if record.measured_T is None else from_record(record.measured_T)
                    outlines = outlines_of(config.camera, config.gripper, pose, record.jaw_opening_m)
                    self._picture = overlay(image, record, outlines, _PICTURE_PX)
                    self._shown += 1
