"""Files and folders -> recordings."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from gripmon.model.errors import InputError, NoResultError
from gripmon.record.read.container import MAGIC, RrdFile, UnreadableFileError
from gripmon.record.read.contents import Contents, read_contents
from gripmon.record.read.lines import LineFile, read_lines
from gripmon.record.read.recordings import Recording

Progress = Callable[[int, int], None]
_SUFFIX = ".rrd"
_LINES_SUFFIX = ".jsonl"


@dataclass(frozen=True)
class Collection:
    """What was found, in order of time; ``faults`` are one line each, about files that could not be used at all."""

    recordings: tuple[Recording, ...]
    faults: tuple[str, ...]


def open_recordings(paths: Sequence[Path], progress: Progress | None = None) -> Collection:
    """Everything but the images of the given files, and of all ``.rrd`` files in the given folders and below.

    Files of several runs and robots may be mixed, in any order; those with one recording id become one recording.  An
    ``estimates.jsonl`` that is named itself is a recording without images.  Whatever the files are, this raises
    nothing: what could not be used is said.  ``progress`` is called with bytes behind and bytes in all.
    """
    faults: list[str] = []
    files = _distinct(_files(paths, faults), faults)
    sizes = [_size(path) for path in files]
    runs: dict[str, list[Contents]] = {}
    behind = 0
    for path, size in zip(files, sizes, strict=True):

        def step(done: int, behind: int = behind) -> None:
            if progress is not None:
                progress(behind + done, sum(sizes))

        for contents in _read(path, faults, step):
            runs.setdefault(contents.recording_id, []).append(contents)
        behind += size
        step(0, behind)
    recordings = [Recording(run) for run in runs.values()]
    recordings.sort(key=lambda r: (int(r.frames.stamp_ns[0]) if len(r.frames) else 0, r.robot, r.camera))
    return Collection(tuple(recordings), tuple(faults))


def needed_recordings(paths: Sequence[Path], progress: Progress | None = None) -> Collection:
    """As :func:`open_recordings`, for those who can do nothing without one.

    Raises :class:`~gripmon.model.errors.InputError` for a file that is not there, or where none of them is a recording;
    :class:`~gripmon.model.errors.NoResultError` where recordings can't be read: that isn't the user's mistake.
    """
    for path in paths:
        if not path.exists():
            right = "a recording (.rrd), a folder of them, or estimates.jsonl"
            raise InputError(f"{path}: there is no such file; {right}")
    found = open_recordings(paths, progress)
    if not found.recordings:
        named = any(path.suffix.lower() in (_SUFFIX, _LINES_SUFFIX) for path in paths)
        raise (NoResultError if named else InputError)("; ".join(found.faults) or "no recording (.rrd) there")
    return found


def recording_files(paths: Sequence[Path]) -> list[Path]:
    """The files that are meant, each once; a folder stands for the recordings in it and below.

    Raises :class:`~gripmon.model.errors.InputError` for what isn't there, and for a folder without any.
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
    """Whether a file begins as rerun's do.  OSError where it can't be read."""
    with path.open("rb") as file:
        return os.read(file.fileno(), len(MAGIC)) == MAGIC


def recordings_below(folder: Path) -> list[Path]:
    """All ``.rrd`` files in a folder and its folders, by name; but none in hidden ones, where files are being made.

    OSError where the folder itself can't be read.
    """
    os.scandir(folder).close()
    found = []
    for where, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [Path(where, n) for n in names if not n.startswith(".") and Path(n).suffix.lower() == _SUFFIX]
    return sorted(found)


def _files(paths: Sequence[Path], faults: list[str]) -> Iterator[Path]:
    for path in paths:
        try:
            if not path.is_dir():
                yield path
                continue
            found = recordings_below(path)
        except OSError as error:
            faults.append(f"{path}: {error.strerror}; not used")
            continue
        if not found:
            faults.append(f"{path}: holds no {_SUFFIX} file; name the folder that recordings were written to")
        yield from found


def _distinct(paths: Iterator[Path], faults: list[str]) -> list[Path]:
    """Each file once, whatever names it was given by."""
    known: dict[tuple[int, int], Path] = {}
    for path in paths:
        try:
            status = path.stat()
        except OSError as error:
            faults.append(f"{path}: {error.strerror}; not used")
            continue
        key = status.st_dev, status.st_ino
        if key in known:
            faults.append(f"{path}: is the same file as {known[key]}; read once")
        known.setdefault(key, path)
    return list(known.values())


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _read(path: Path, faults: list[str], step: Callable[[int], None]) -> list[Contents]:
    """What a file holds of each recording; what it doesn't goes to ``faults``."""
    try:
        if path.suffix.lower() == _LINES_SUFFIX and not is_rrd(path):
            return [read_lines(LineFile(path), step)]
        file = RrdFile(path)
        found = [read_contents(file, store, step) for store in file.stores]
    except UnreadableFileError as error:
        faults.append(f"{path}: {error}; not used")
        return []
    except OSError as error:
        faults.append(f"{path}: {error.strerror or error}; not used")
        return []
    except Exception as error:  # noqa: BLE001 - a file from anywhere must not end the reading of the others
        what = " ".join(f"{type(error).__name__}: {error}".split())
        faults.append(f"{path}: can't be read ({what:.200}); not used")
        return []
    ours = [contents for contents in found if contents.is_ours and not contents.is_of_spots]
    if not ours and any(contents.is_of_spots for contents in found):
        faults.append(f"{path}: holds a second camera's laser spots, no frames; gripmon view shows them; not used")
    elif not ours:
        applications = ", ".join(sorted({repr(store.application)[:60] for store in file.stores}))
        what = f"is a recording of the application {applications} that holds no frames of a monitor's"
        faults.append("; ".join([f"{path}: {what}", *file.faults, "not used"]))
    return ours
