"""A recording of frames that can wait: one whole file, or what was there before."""

from __future__ import annotations

import contextlib
import logging
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from gripmon.daemon.config import Config
from gripmon.daemon.config.recorded import to_recorded
from gripmon.daemon.starting import RECORDING_PATIENCE_S
from gripmon.model.errors import InputError
from gripmon.record.keeping import keep_whole
from gripmon.record.write import NullRecorder, Recorder, open_recorder


@contextmanager
def one_recording(path: Path | None, config: Config) -> Iterator[Recorder]:
    """A recorder into exactly one file, finished when the context ends; the null recorder without a path.

    Raises :class:`InputError` where the file can't be made, :class:`NoResultError` at the end where writing failed:
    what was there before stays then.
    """
    if path is None:
        yield NullRecorder()
        return
    # One file, whatever its length.
    settings = msgspec.structs.replace(
        config.settings.recording, enabled=True, max_file_bytes=2**62, max_file_s=math.inf, budget_bytes=0
    )
    with contextlib.ExitStack() as opened:
        try:
            scratch = opened.enter_context(tempfile.TemporaryDirectory(prefix=f".{path.stem}-", dir=path.parent))
        except OSError as error:
            raise InputError(f"--recording {path}: can't be written ({error.strerror or error}); a file") from None
        recorder = open_recorder(
            settings,
            robot=config.settings.robot,
            camera_name=config.settings.camera_name,
            camera=config.camera,
            gripper=config.gripper,
            reference=config.reference,
            directory=Path(scratch),
            name=path.stem,
            patience_s=RECORDING_PATIENCE_S,
            configuration=to_recorded(config),
        )
        opened.enter_context(_told_at_the_end())
        try:
            yield recorder
        finally:
            recorder.close(timeout_s=60.0)
            # A disk that failed for a moment has left a whole file of the frames after it.
            missing = _missing(recorder)
            keep_whole(sorted(Path(scratch).glob("*.rrd")), path, recorder.failure or missing, whole=missing is None)


def _missing(recorder: Recorder) -> str | None:
    """What is not in a recording that is to hold all; None if nothing is missing."""
    if recorder.dropped:
        return f"{recorder.dropped} frames are missing"
    return f"{recorder.images_dropped} images are missing" if recorder.images_dropped else None


@contextmanager
def _told_at_the_end() -> Iterator[None]:
    """What a daemon logs of its recording while it goes on, a replay says in one line when it is over."""
    logger = logging.getLogger("gripmon.record")
    propagates, silent = logger.propagate, logging.NullHandler()
    logger.addHandler(silent)
    logger.propagate = False
    try:
        yield
    finally:
        logger.propagate = propagates
        logger.removeHandler(silent)
