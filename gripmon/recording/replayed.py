"""Frames out of a recording, for replay through the same core.

A recording holds fewer images than there were frames (``image_rate_hz``), and by default as JPEG: replaying it comes
close to what happened.  To the bit it only is with ``image_format: png`` and a rate above the camera's.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import msgspec

from gripmon.recording.overlay import IMAGE
from gripmon.records import Frame, FrameRecord
from gripmon.sources.base import SourceError

RECORD = "record"
JAW_REPORTED = "jaw/reported_m"


class _Shot(NamedTuple):
    stamp_ns: int
    blob: bytes


class _Contents(NamedTuple):
    """What a file holds, by ``seq``."""

    shots: dict[int, _Shot]
    records: dict[int, FrameRecord]
    jaw_reported_m: dict[int, float]


class RecordedFrames:
    """A source of every frame whose image is in an ``.rrd`` file of ours, in order, with its stamp and its jaw opening.

    All encoded images are held in memory.  Raises :class:`SourceError` for a file that can't be read or holds no image.
    """

    live = False
    connected = True
    dropped = 0

    def __init__(self, path: Path) -> None:
        self._name = path.name
        self._contents = contents = _read(path)
        if not contents.shots:
            raise SourceError(f"path: {path} holds no images; a recording made with image_rate_hz above 0")
        self.frames_without_image = len(contents.records.keys() - contents.shots.keys())
        self._seqs = sorted(contents.shots)
        self._next = 0

    def __len__(self) -> int:
        return len(self._seqs)

    def read(self) -> Frame | None:
        """The next frame, None after the last."""
        import cv2
        import numpy as np

        if self._next >= len(self._seqs):
            return None
        seq = self._seqs[self._next]
        self._next += 1
        shot, record = self._contents.shots[seq], self._contents.records.get(seq)
        image = cv2.imdecode(np.frombuffer(shot.blob, np.uint8), cv2.IMREAD_UNCHANGED)
        fault = None if image is not None else "the recorded image is damaged"
        name = self._name if record is None or not record.name else record.name
        return Frame(seq, shot.stamp_ns, image, self._contents.jaw_reported_m.get(seq), name, fault)

    def close(self) -> None:
        """Nothing more is read."""
        self._next = len(self._seqs)


def _read(path: Path) -> _Contents:
    from rerun.chunk import RrdReader

    contents = _Contents({}, {}, {})
    decode = msgspec.json.Decoder(FrameRecord).decode
    wanted = [f"/{entity}" for entity in (IMAGE, RECORD, JAW_REPORTED)]
    try:
        chunks = RrdReader(path).stream().filter(content=wanted, has_timeline="frame").to_chunks()
    except Exception as error:  # whatever rerun's reader raises: the file is at fault
        reason = " ".join(str(error).split())
        remedy = "a complete .rrd file (`rerun rrd optimize` saves what is whole in one that was cut off)"
        raise SourceError(f"path: {path} can't be read ({reason}); {remedy}") from error
    for chunk in chunks:
        batch = chunk.to_record_batch()
        entity = chunk.entity_path.removeprefix("/")
        seqs = batch.column("frame").to_pylist()
        if entity == RECORD:
            texts = batch.column("json").to_pylist()
            contents.records.update((seq, decode(text)) for seq, (text,) in zip(seqs, texts, strict=True))
        elif entity == JAW_REPORTED:
            openings = batch.column("Scalars:scalars").to_pylist()
            contents.jaw_reported_m.update(
                (seq, opening[0]) for seq, opening in zip(seqs, openings, strict=True) if opening
            )
        else:
            stamps_ns = batch.column("capture_time").cast("int64").to_pylist()
            blobs = batch.column("EncodedImage:blob")
            for row, (seq, stamp_ns) in enumerate(zip(seqs, stamps_ns, strict=True)):
                contents.shots[seq] = _Shot(stamp_ns, blobs[row].values[0].values.to_numpy().tobytes())
    return contents
