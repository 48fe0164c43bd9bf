"""Reading recordings: what monitors recorded, as columns, records and pictures, whatever state the files are in.

``open_recordings(paths, progress)`` takes files and folders of several runs and robots in any order and returns a
:class:`Collection`: the recordings, each one run of one monitor, and the faults, one line each, about what could not be
used.  Files are never changed, and images are read only when needed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np

from gripmon.model.errors import InputError, NoResultError, in_short
from gripmon.model.records import Frame, FrameRecord, RecordedCommand, RecordedConfiguration, ReferenceRecord, Refusal
from gripmon.record.container import MAGIC
from gripmon.record.contents import Contents, LineFile, Shot, contents_of
from gripmon.record.recorder import Picture
from gripmon.record.recordings import Recording, decode_image
from gripmon.record.rrd import RrdFile, UnreadableFileError

Progress = Callable[[int, int], None]
_SUFFIX, _LINES_SUFFIX = ".rrd", ".jsonl"

_NEVER_AS_IMAGE = frozenset({Refusal.NOT_AN_IMAGE, Refusal.WRONG_TYPE, Refusal.NOT_FINITE})
"""Refusals of images that can't be recovered from an encoding with 8 bits."""
_MAY_BE_TOO_LARGE = frozenset({*_NEVER_AS_IMAGE, Refusal.WRONG_SIZE})


@dataclass(frozen=True)
class Collection:
    """The recordings found, in order of time; ``faults``, one line each: files that could not be used at all."""

    recordings: tuple[Recording, ...]
    faults: tuple[str, ...]


def open_recordings(paths: Sequence[Path], progress: Progress | None = None) -> Collection:
    """Read everything but the images of the given files, and of all ``.rrd`` files in the given folders and below.

    Files of several runs and robots may be mixed in any order; those with the same recording id become one recording.
    An ``estimates.jsonl`` given by name is a recording without images.  Bad files raise nothing: what could not be used
    is in ``faults``.  ``progress`` is called with bytes read and bytes in total.
    """
    faults: list[str] = []
    files = _distinct(_files(paths, faults), faults)
    runs: dict[str, list[Contents]] = {}
    behind, total = 0, sum(files.values())
    for path, size in files.items():

        def step(done: int, behind: int = behind) -> None:
            if progress is not None:
                progress(behind + done, total)

        for contents in _read(path, faults, step):
            runs.setdefault(contents.recording_id, []).append(contents)
        behind += size
        step(0, behind)
    recordings = [Recording(run) for run in runs.values()]
    recordings.sort(key=lambda r: (int(r.frames.stamp_ns[0]) if len(r.frames) else 0, r.robot, r.camera))
    return Collection(tuple(recordings), tuple(faults))


def needed_recordings(paths: Sequence[Path], progress: Progress | None = None) -> Collection:
    """As :func:`open_recordings`, for callers that need at least one.

    Raises :class:`~gripmon.model.errors.InputError` for a missing file, or if none is a recording;
    :class:`~gripmon.model.errors.NoResultError` if recordings can't be read, which isn't the user's mistake.
    """
    for path in paths:
        if not path.exists():
            right = "a recording (.rrd), a folder of them, or estimates.jsonl"
            raise InputError(f"{path}: there is no such file; {right}")
    found = open_recordings(paths, progress)
    if not found.recordings:
        named = any(p.suffix.lower() in (_SUFFIX, _LINES_SUFFIX) or (p.is_dir() and recordings_below(p)) for p in paths)
        raise (NoResultError if named else InputError)("; ".join(found.faults) or "no recording (.rrd) there")
    return found


def recording_files(paths: Sequence[Path]) -> list[Path]:
    """The given files, each once; a folder stands for the recordings in it and below.

    Raises :class:`~gripmon.model.errors.InputError` for a missing path and for a folder without recordings.
    """
    files: list[Path] = []
    for path in paths:
        found = recordings_below(path) if path.is_dir() else [path] * path.is_file()
        if not found:
            wrong = f"no {_SUFFIX} file in it" if path.is_dir() else "there is no such file"
            raise InputError(f"{path}: {wrong}; recordings of gripmon run, or their folder")
        files += found
    return list({file.resolve(): file for file in files}.values())


def is_rrd(path: Path) -> bool:
    """Whether a file begins like a rerun recording.  Raises OSError if it can't be read."""
    with path.open("rb") as file:
        return os.read(file.fileno(), len(MAGIC)) == MAGIC


def rrd_files(paths: Sequence[Path]) -> list[Path]:
    """As :func:`recording_files`, where each must be a rerun recording."""
    files = recording_files(paths)
    for path in files:
        try:
            wrong = "" if is_rrd(path) else "isn't a recording; an .rrd file of gripmon's"
        except OSError as error:
            wrong = f"can't be read ({error.strerror})"
        if wrong:
            raise InputError(f"{path}: {wrong}")
    return files


def recordings_below(folder: Path) -> list[Path]:
    """All ``.rrd`` files in a folder and below, by name, except in hidden folders, which contain unfinished files.

    Raises OSError if the folder itself can't be read.
    """
    os.scandir(folder).close()
    found = []
    for where, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [Path(where, n) for n in names if not n.startswith(".") and Path(n).suffix.lower() == _SUFFIX]
    return sorted(found)


def _files(paths: Sequence[Path], faults: list[str]) -> Iterable[Path]:
    for path in paths:
        try:
            found = recordings_below(path) if path.is_dir() else [path]
        except OSError as error:
            faults.append(f"{path}: {error.strerror}; not used")
            continue
        if not found:
            estimates = path / "estimates.jsonl"
            right = f"{estimates} by its name" if estimates.is_file() else "the folder that recordings were written to"
            faults.append(f"{path}: holds no {_SUFFIX} file; {right}")
        yield from found


def _distinct(paths: Iterable[Path], faults: list[str]) -> dict[Path, int]:
    """Each file once, by whatever names it was given, with its size in bytes."""
    known: dict[tuple[int, int], Path] = {}
    sizes = {}
    for path in paths:
        try:
            status = path.stat()
        except OSError as error:
            faults.append(f"{path}: {error.strerror}; not used")
            continue
        key = status.st_dev, status.st_ino
        if key in known:
            faults.append(f"{path}: is the same file as {known[key]}; read once")
        elif known.setdefault(key, path) is path:
            sizes[path] = status.st_size
    return sizes


def _read(path: Path, faults: list[str], step: Callable[[int], None]) -> list[Contents]:
    """What a file contains of each recording; faults are added to ``faults``."""
    try:
        lines = path.suffix.lower() == _LINES_SUFFIX and not is_rrd(path)
        file = LineFile(path) if lines else RrdFile(path)
        found = contents_of(file, step)
    except UnreadableFileError as error:
        faults.append(f"{path}: {error}; not used")
        return []
    except OSError as error:
        faults.append(f"{path}: {error.strerror or error}; not used")
        return []
    except Exception as error:  # noqa: BLE001 - one bad file must not stop the reading of the others
        faults.append(f"{path}: can't be read ({in_short(error):.200}); not used")
        return []
    ours = [contents for contents in found if contents.is_ours and not contents.is_of_spots]
    if not ours and any(contents.is_of_spots for contents in found):
        faults.append(f"{path}: holds laser spots of an earlier version, no frames; gripmon view shows them; not used")
    elif not ours:
        applications = ", ".join(sorted({repr(contents.store.application)[:60] for contents in found}))
        what = f"is a recording of the application {applications} that holds no frames of a monitor's"
        faults.append("; ".join([f"{path}: {what}", *file.faults, "not used"]))
    return ours


class RecordedFrames:
    """A source for replay: every frame of one run whose image is in these ``.rrd`` files, in the order of ``seq``, each
    with its stamp, name and reported jaw opening.

    A replay is bit-exact only if every frame's image was recorded losslessly (``image_every: 1``,
    ``image_format: png``); float images are recorded with 8 bits.  By default a recording has fewer images, as JPEG,
    and a replay comes close.  A frame that was refused because it was not an image, or not of this camera, has no image
    in the recording.  It is replayed from its record: without image, with the same refusal in the same words.

    Images are read when they are needed; ``passed_over`` counts frames that could no longer be read,
    ``images_damaged`` those whose pixels can't be decoded.  Raises :class:`~gripmon.model.errors.NoResultError` if
    there is no image at all, and :class:`~gripmon.model.errors.InputError` for files of several runs, whose frames have
    no common order.
    """

    live = False
    connected = True
    dropped = 0

    def __init__(self, paths: Path | Sequence[Path]) -> None:
        self._run, self._unused = _one_run([paths] if isinstance(paths, Path) else list(paths))
        run = self._run
        self.paths: tuple[Path, ...] = run.files
        self.configuration: RecordedConfiguration | None = run.configuration
        self.reference: ReferenceRecord | None = run.references[0] if run.references else None
        """The reference in force when the first of these files began."""
        self.commands: tuple[RecordedCommand, ...] = tuple(sorted(run.commands, key=attrgetter("seq", "stamp_ns")))
        self._images = run.images()
        if not self._images:
            no_images = f"{self.paths[0]}: holds no images; a recording made with image_rate_hz above 0"
            raise NoResultError("; ".join([*[no_images] * bool(len(run.frames)), *self.faults]) or no_images)
        with_image = np.isin(run.frames.seq, list(self._images))
        refused = run.frames.seq[run.frames.refused & ~with_image]
        stand_ins = [record.seq for record in run.records(refused) if _stands_in(record)]
        # An image without a record, at the end of a truncated recording, was never judged.
        self._seqs = run.frames.seq[with_image | np.isin(run.frames.seq, stand_ins)]
        self.frames_without_image = len(run.frames) - len(self._seqs)
        self.stand_ins = len(stand_ins)
        self.passed_over = self.images_damaged = 0
        self._given = self._frames()
        self.shot: Shot | None = None
        """The recorded image of the frame that was read last."""
        self.record: FrameRecord | None = None
        """The record of that frame."""

    def __len__(self) -> int:
        return len(self._seqs)

    @property
    def faults(self) -> tuple[str, ...]:
        """One line each: what in the files could not be used."""
        return (*self._unused, *self._run.faults)

    def read(self) -> Frame | None:
        """The next frame, None after the last."""
        return next(self._given, None)

    def beside(self, frame: Frame) -> tuple[FrameRecord, Picture | None]:
        """The record of the frame that was read last, and its image as it was recorded; None if that isn't readable."""
        from gripmon.record.pictures import measured_picture

        assert self.record is not None, "every frame that was read has one"
        if self.shot is None or frame.image is None:
            return self.record, None
        return self.record, measured_picture(self.shot.blob, self.shot.media_type, frame.image)

    def close(self) -> None:
        """Nothing more is read."""
        self._given.close()

    def _frames(self) -> Generator[Frame]:
        given = 0
        for record, shot in self._run.with_shots(self._seqs, self._images):
            if shot is None and not _stands_in(record):
                continue
            self.shot, self.record = shot, record
            given += 1
            yield self._frame(record, shot)
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
        jaw_m = self._run.jaw_reported_m(record.seq)
        return Frame(record.seq, record.stamp_ns, image, jaw_m, record.name, fault, refused)


def _one_run(paths: Sequence[Path]) -> tuple[Recording, tuple[str, ...]]:
    """The run that all files belong to, and what is said of others."""
    found = open_recordings(paths)
    if not found.recordings:
        raise NoResultError("; ".join(found.faults) or "there is no recording; an .rrd file of gripmon's")
    if len(found.recordings) > 1:
        first = ", ".join(str(run.files[0]) for run in found.recordings[:4])
        more = ", …" if len(found.recordings) > 4 else ""
        raise InputError(f"these are files of {len(found.recordings)} runs ({first}{more}); the files of one")
    (run,) = found.recordings
    return run, found.faults


def _stands_in(record: FrameRecord) -> bool:
    """Whether a frame without image can be replayed from its record alone."""
    refusal = _refusal_of(record)
    return refusal is not None and refusal[0] in _MAY_BE_TOO_LARGE


def _refusal_of(record: FrameRecord) -> tuple[Refusal, str] | None:
    """The refusal and its text; None for a frame that was measured, or in which the measurement failed."""
    kind, colon, words = (record.reason or "").partition(": ")
    if not colon or kind not in set(Refusal):
        return None
    return Refusal(kind), words
