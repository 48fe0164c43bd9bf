"""Frames out of a recording, for replay through the same core.

To the bit it only is what happened where every frame's image was kept without loss (``image_every: 1``, ``image_format:
png``); float images are recorded with 8 bits.  A recording holds fewer images by default, and as JPEG: replaying it
comes close.

A frame that was refused because it was no image, or none of this camera's, has no image in the recording either.  It is
given again as what its record says of it: without image, with the same refusal in the same words.  What the watch of
the stream would have seen in such pixels (that another camera delivers them) is lost.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from operator import attrgetter
from pathlib import Path

import numpy as np

from gripmon.model.records import Frame, FrameRecord, RecordedCommand, RecordedConfiguration, ReferenceRecord, Refusal
from gripmon.record.read.opening import open_recordings
from gripmon.record.read.recordings import Recording, Shot, decode_image

_NEVER_AS_IMAGE = frozenset({Refusal.NOT_AN_IMAGE, Refusal.WRONG_TYPE, Refusal.NOT_FINITE})
"""What looks like another image, or like none, once it has been encoded with 8 bits."""
_MAY_BE_TOO_LARGE = frozenset({*_NEVER_AS_IMAGE, Refusal.WRONG_SIZE})


class UnusableError(Exception):
    """These files hold nothing to replay; ``str()`` is one line."""


class SeveralRunsError(Exception):
    """Frames of several runs have no order; ``str()`` is one line."""


class RecordedFrames:
    """A source of every frame of one run whose image is in these ``.rrd`` files of ours, in the order of ``seq``.

    Each with its stamp, its name and the jaw opening that was reported.  Images are read when their turn comes.
    ``faults`` says what of the files could not be used, one line each; ``passed_over`` counts frames that could not be
    read when their turn came, ``images_damaged`` those whose pixels can't be decoded.  Raises :class:`UnusableError`
    where there is no image at all, and :class:`SeveralRunsError`.
    """

    live = False
    connected = True
    dropped = 0

    def __init__(self, paths: Path | Sequence[Path]) -> None:
        self._run, self.faults = _one_run([paths] if isinstance(paths, Path) else list(paths))
        run = self._run
        self.paths: tuple[Path, ...] = run.files
        self.configuration: RecordedConfiguration | None = run.configuration
        self.reference: ReferenceRecord | None = run.references[0] if run.references else None
        """The one in force when the first of these files began."""
        self.commands: tuple[RecordedCommand, ...] = tuple(sorted(run.commands, key=attrgetter("seq", "stamp_ns")))
        if not len(run.image_seqs):
            no_images = f"{self.paths[0]}: holds no images; a recording made with image_rate_hz above 0"
            raise UnusableError("; ".join([*[no_images] * bool(len(run.frames)), *self.faults]) or no_images)
        with_image = np.isin(run.frames.seq, run.image_seqs)
        refused = run.frames.seq[run.frames.refused & ~with_image]
        stand_ins = [record.seq for record in run.records(refused) if _stands_in(record)] if len(refused) else []
        # An image without a record, at the end of a recording that was cut off, was judged by nobody.
        self._seqs = run.frames.seq[with_image | np.isin(run.frames.seq, stand_ins)]
        self.frames_without_image = len(run.frames) - len(self._seqs)
        self.stand_ins = len(stand_ins)
        self.passed_over = self.images_damaged = 0
        self._given = self._frames()
        self.shot: Shot | None = None
        """The image of the frame that was read last, as it was recorded."""
        self.record: FrameRecord | None = None
        """What was decided about that frame when it was recorded."""

    def __len__(self) -> int:
        return len(self._seqs)

    def read(self) -> Frame | None:
        """The next frame, None after the last."""
        return next(self._given, None)

    def close(self) -> None:
        """Nothing more is read."""
        self._given.close()

    def _frames(self) -> Generator[Frame]:
        shots, given = self._run.shots(), 0
        shot = next(shots, None)
        for record in self._run.records(self._seqs):
            while shot is not None and shot.seq < record.seq:
                shot = next(shots, None)
            own = shot if shot is not None and shot.seq == record.seq else None
            if own is None and not _stands_in(record):
                continue
            self.shot, self.record = own, record
            given += 1
            yield self._frame(record, own)
        self.passed_over = len(self._seqs) - given

    def _frame(self, record: FrameRecord, shot: Shot | None) -> Frame:
        image, fault, refused = None, None, Refusal.NOT_AN_IMAGE
        refusal = _refusal_of(record)
        if refusal is not None and (shot is None or refusal[0] in _NEVER_AS_IMAGE):
            refused, fault = refusal
        else:
            assert shot is not None, "only refused frames stand in"
            image = decode_image(shot.blob)
            fault = None if image is not None else "the recorded image is damaged"
            self.images_damaged += image is None
        jaw_m = self._run.jaw_reported_m(record.seq) if shot is None else shot.jaw_reported_m
        return Frame(record.seq, record.stamp_ns, image, jaw_m, record.name, fault, refused)


def _one_run(paths: Sequence[Path]) -> tuple[Recording, tuple[str, ...]]:
    """The run that all files are of, and what is wrong with them."""
    found = open_recordings(paths)
    if not found.recordings:
        raise UnusableError("; ".join(found.faults) or "there is no recording; an .rrd file of gripmon's")
    if len(found.recordings) > 1:
        first = ", ".join(str(run.files[0]) for run in found.recordings[:4])
        more = ", …" if len(found.recordings) > 4 else ""
        raise SeveralRunsError(f"these are files of {len(found.recordings)} runs ({first}{more}); the files of one")
    (run,) = found.recordings
    return run, (*found.faults, *run.faults)


def _stands_in(record: FrameRecord) -> bool:
    """Whether a frame without image can be given again from its record alone."""
    refusal = _refusal_of(record)
    return refusal is not None and refusal[0] in _MAY_BE_TOO_LARGE


def _refusal_of(record: FrameRecord) -> tuple[Refusal, str] | None:
    """The refusal with its words; None for a frame that was measured, or at which measuring failed."""
    kind, colon, words = (record.reason or "").partition(": ")
    if not colon or kind not in set(Refusal):
        return None
    return Refusal(kind), words
