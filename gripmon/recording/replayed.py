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


class _Shot(NamedTuple):
    stamp_ns: int
    blob: bytes


class RecordedFrames:
    """A source of every frame whose image is in an ``.rrd`` file of ours, in order, with its stamp and its jaw opening.

    All encoded images are held in memory.  Raises :class:`SourceError` for a file that can't be read or holds no image.
    """

    live = False
    connected = True
    dropped = 0

    def __init__(self, path: Path) -> None:
        self._name = path.name
        self._shots, self._records = _read(path)
        if not self._shots:
            raise SourceError(f"path: {path} holds no images; a recording made with image_rate_hz above 0")
        self.frames_without_image = len(self._records.keys() - self._shots.keys())
        self._seqs = sorted(self._shots)
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
        shot, record = self._shots[seq], self._records.get(seq)
        image = cv2.imdecode(np.frombuffer(shot.blob, np.uint8), cv2.IMREAD_UNCHANGED)
        fault = None if image is not None else "the recorded image is damaged"
        jaw_opening_m = None if record is None else record.jaw_opening_m
        name = self._name if record is None or not record.name else record.name
        return Frame(seq, shot.stamp_ns, image, jaw_opening_m, name, fault)

    def close(self) -> None:
        """Nothing more is read."""
        self._next = len(self._seqs)


def _read(path: Path) -> tuple[dict[int, _Shot], dict[int, FrameRecord]]:
    """Encoded images and records by ``seq``."""
    from rerun.chunk import RrdReader

    shots: dict[int, _Shot] = {}
    records: dict[int, FrameRecord] = {}
    decode = msgspec.json.Decoder(FrameRecord).decode
    try:
        chunks = RrdReader(path).stream().filter(content=[f"/{IMAGE}", f"/{RECORD}"], has_timeline="frame").to_chunks()
    except Exception as error:  # whatever rerun's reader raises: the file is at fault
        reason = " ".join(str(error).split())
        remedy = "a complete .rrd file (`rerun rrd optimize` saves what is whole in one that was cut off)"
        raise SourceError(f"path: {path} can't be read ({reason}); {remedy}") from error
    for chunk in chunks:
        batch = chunk.to_record_batch()
        seqs = batch.column("frame").to_pylist()
        if chunk.entity_path == f"/{RECORD}":
            for seq, texts in zip(seqs, batch.column("json").to_pylist(), strict=True):
                records[seq] = decode(texts[0])
            continue
        stamps_ns = batch.column("capture_time").cast("int64").to_pylist()
        blobs = batch.column("EncodedImage:blob")
        for row, (seq, stamp_ns) in enumerate(zip(seqs, stamps_ns, strict=True)):
            shots[seq] = _Shot(stamp_ns, blobs[row].values[0].values.to_numpy().tobytes())
    return shots, records
