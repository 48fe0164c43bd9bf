"""Recorded frames: a folder of images, in the natural order of their names, or a video file."""

from __future__ import annotations

import csv
import io
import itertools
import logging
import math
import threading
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from gripmon.io.sources.base import SourceError, Stored
from gripmon.io.sources.stored import needed, video_frames
from gripmon.model.images import IMAGE_SUFFIXES, natural_key, read_image, regular_bytes
from gripmon.model.records import Frame
from gripmon.model.records.values import NS_PER_S

if TYPE_CHECKING:
    from _csv import Reader as _Lines

_log = logging.getLogger(__name__)

TIMESTAMPS_NAME = "timestamps.csv"
COLUMNS = ("file", "stamp_ns", "jaw_opening_m")
MOST_FPS = 10_000
"""Highest frame rate of a recording (1/s)."""
UNIX_US = range(1_400_000_000_000_000, 2_300_000_000_000_000)
"""The years 2014 to 2042 in microseconds."""


class FolderSettings(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="folder"
):
    """Images in a folder, optionally with a table ``timestamps.csv``: ``file,stamp_ns[,jaw_opening_m]``."""

    path: Annotated[str, msgspec.Meta(min_length=1, description="folder with the images")]
    fps: Annotated[
        float, msgspec.Meta(gt=0, le=MOST_FPS, description="frame rate where there are no time stamps (1/s)")
    ] = 25.0
    timestamps: Annotated[
        str | None,
        msgspec.Meta(description="file with time stamps; absent: timestamps.csv in the folder, if there is one"),
    ] = None


@dataclass(frozen=True, slots=True)
class TableRow:
    """An image's row in a table of time stamps."""

    stamp_ns: int
    jaw_opening_m: float | None


class FolderSource(Stored):
    """Every image of a folder, in order: ``frame10.png`` comes after ``frame9.png``.

    A table of time stamps determines the frames: a file that is missing becomes a frame with a fault, an image that
    isn't in the table is refused at the start.  Grey files stay grey, colour becomes BGR, an alpha channel is dropped,
    16 bits and float stay unchanged.  Truncated or foreign files become frames with a fault.
    """

    def __init__(self, settings: FolderSettings, relative_to: Path) -> None:
        self._folder = relative_to / settings.path
        if not self._folder.is_dir():
            raise SourceError(f"path: there is no folder {self._folder}; a folder with images")
        names = sorted(
            (p.name for p in self._folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()),
            key=natural_key,
        )
        table = self._folder / TIMESTAMPS_NAME if settings.timestamps is None else relative_to / settings.timestamps
        if settings.timestamps is not None or table.exists():
            rows = read_table(table)
            unnamed = sorted(set(names) - rows.keys(), key=natural_key)
            if unnamed:
                raise SourceError(f"{table}: no row for {unnamed[0]}; a row for each image ({len(unnamed)} have none)")
            names = sorted(rows, key=natural_key)
            _check_order(table, names, rows)
        else:
            rows = {name: TableRow(round(i * NS_PER_S / settings.fps), None) for i, name in enumerate(names)}
        if not names:
            raise SourceError(f"path: no image in {self._folder}; files such as *.png, *.jpg, *.tif, *.pgm")
        self._names, self._rows = names, rows
        self._seq = 0

    def __len__(self) -> int:
        return len(self._names)

    def read(self) -> Frame | None:
        if self._seq >= len(self._names):
            return None
        name = self._names[self._seq]
        row = self._rows[name]
        image, fault = read_image(self._folder / name)
        frame = Frame(self._seq, row.stamp_ns, image, row.jaw_opening_m, name, fault)
        self._seq += 1
        return frame

    def close(self) -> None:
        self._seq = len(self._names)


def read_table(path: Path) -> dict[str, TableRow]:
    """A table ``file,stamp_ns[,jaw_opening_m]`` by file name.  Raises :class:`SourceError`."""
    try:
        text = regular_bytes(path).decode("utf-8-sig")
    except FileNotFoundError:
        raise SourceError(f"timestamps: there is no file {path}; a table {','.join(COLUMNS[:2])}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: can't be read ({getattr(error, 'strerror', error)}); a table in UTF-8") from None
    lines = csv.reader(text.splitlines())
    try:
        return _rows(path, lines)
    except csv.Error as error:
        raise SourceError(f"{path}: line {lines.line_num}: {error} (an open quote?); {','.join(COLUMNS)}") from None


def table_of(rows: Mapping[str, TableRow]) -> bytes:
    """The text of such a table, with a column for the openings."""
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(COLUMNS)
    for name, row in rows.items():
        lines.writerow((name, row.stamp_ns, "" if row.jaw_opening_m is None else repr(row.jaw_opening_m)))
    return text.getvalue().encode()


def opening_beside(path: Path) -> float | None:
    """An image's jaw opening (m) in the ``timestamps.csv`` beside it, None if unknown.  Raises :class:`SourceError`."""
    table = path.parent / TIMESTAMPS_NAME
    row = read_table(table).get(path.name) if table.exists() else None
    return None if row is None else row.jaw_opening_m


def _rows(path: Path, lines: _Lines) -> dict[str, TableRow]:
    header = tuple(cell.strip() for cell in next(lines, []))
    if header not in (COLUMNS[:2], COLUMNS):
        raise SourceError(f"{path}: line 1 is '{','.join(header)}'; file,stamp_ns or file,stamp_ns,jaw_opening_m")
    rows: dict[str, TableRow] = {}
    for cells in lines:
        if not cells:
            continue
        where = f"{path}: line {lines.line_num}"
        if len(cells) != len(header):
            raise SourceError(f"{where} has {len(cells)} values; {len(header)}: {','.join(header)}")
        name = cells[0].strip()
        if not name or Path(name).name != name:
            raise SourceError(f"{where}: '{name}' is not a file name; the plain name of a file in the folder")
        if name in rows:
            raise SourceError(f"{where}: {name} is there twice; one row for each file")
        rows[name] = TableRow(_stamp(cells[1], where), _opening(cells[2], where) if len(cells) == 3 else None)
    return rows


def _stamp(cell: str, where: str) -> int:
    try:
        stamp_ns = int(cell)
    except ValueError:
        raise SourceError(f"{where}: stamp_ns is {cell.strip()!r:.60}; a whole number of nanoseconds") from None
    if not 0 <= stamp_ns < 2**63:
        raise SourceError(f"{where}: stamp_ns is {stamp_ns}; 0 or more, below 2^63")
    return stamp_ns


def _opening(cell: str, where: str) -> float | None:
    if not cell.strip():
        return None
    try:
        opening_m = float(cell)
    except ValueError:
        opening_m = math.nan
    if not 0.0 <= opening_m <= 1.0:
        raise SourceError(
            f"{where}: jaw_opening_m is {cell.strip()!r:.60}; metres, 0 to 1, or nothing where it isn't known"
        )
    return opening_m


def _check_order(path: Path, names: list[str], rows: dict[str, TableRow]) -> None:
    for earlier, later in itertools.pairwise(names):
        if rows[later].stamp_ns <= rows[earlier].stamp_ns:
            raise SourceError(
                f"{path}: stamp_ns doesn't rise from {earlier} to {later}; stamps that rise in the files' order"
            )
    # As nanoseconds since a start, times of our days in microseconds are some twenty days.
    most_fps = MOST_FPS // 10 if rows[names[-1]].stamp_ns in UNIX_US else MOST_FPS
    steps_ns = sorted(rows[later].stamp_ns - rows[earlier].stamp_ns for earlier, later in itertools.pairwise(names))
    if len(steps_ns) >= 3 and (usual_ns := steps_ns[len(steps_ns) // 2]) < NS_PER_S / most_fps:
        wrong = f"stamp_ns rises by {usual_ns} from image to image, as of more than {most_fps:,} frames/s"
        raise SourceError(f"{path}: {wrong}; nanoseconds")


class VideoSettings(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="video"
):
    """A video file that FFmpeg reads."""

    path: Annotated[str, msgspec.Meta(min_length=1, description="the video file")]
    fps: (
        Annotated[
            float,
            msgspec.Meta(gt=0, le=MOST_FPS, description="replaces the container's time stamps by frame / fps (1/s)"),
        ]
        | None
    ) = None


class VideoSource(Stored):
    """Frames with the container's time stamps, counted from its beginning, since a container has no Unix time.

    Containers round (Matroska to 1 ms).  A frame whose stamp doesn't increase becomes a frame with a fault: give
    ``fps`` for files without usable stamps.  Images are BGR, even for grey videos.  What OpenCV can't decode, such as
    AV1, is left to PyAV.
    """

    def __init__(self, settings: VideoSettings, relative_to: Path) -> None:
        self._path = relative_to / settings.path
        if not self._path.is_file():
            raise SourceError(f"path: there is no file {self._path}; a video file")
        self._first: _Timed | None
        self._first, self._frames, self._due_s = _opened_video(self._path)
        self._fps = settings.fps
        self._seq = 0
        self._last_ns = self._last_stamp_ns = -1
        self._longest_ns = 0
        self._open = True
        self._lock = threading.Lock()  # releasing a capture while it reads would crash

    def read(self) -> Frame | None:
        with self._lock:
            return self._next_frame()

    def close(self) -> None:
        with self._lock:
            self._end()

    def _next_frame(self) -> Frame | None:
        if not self._open:
            return None
        found, self._first = self._first, None
        try:
            at_ns, image = found or next(self._frames)
        except (StopIteration, SourceError) as end:
            end_s = 1e-9 * self._last_ns
            if isinstance(end, SourceError):  # OpenCV says none
                _log.warning("the video ends after %.3g s: %s", end_s, end)
            elif self._due_s > end_s + 1e-9 * self._longest_ns:
                _log.warning("%s ends after %.3g s of %.3g s; is it truncated?", self._path, end_s, self._due_s)
            self._end()
            return None
        stamp_ns, fault = self._stamp(at_ns)
        if image is None:
            fault = "the video frame can't be decoded"
        frame = Frame(self._seq, stamp_ns, image if fault is None else None, None, self._path.name, fault)
        self._seq += 1
        self._last_stamp_ns = stamp_ns
        return frame

    def _end(self) -> None:
        self._open = False
        self._frames.close()

    def _stamp(self, at_ns: int) -> tuple[int, str | None]:
        if self._seq:
            self._longest_ns = max(self._longest_ns, at_ns - self._last_ns)
        self._last_ns = max(at_ns, self._last_ns)
        if self._fps is not None:
            return round(self._seq * NS_PER_S / self._fps), None
        if at_ns <= self._last_stamp_ns:
            return max(self._last_stamp_ns, 0), "the container's time stamp does not rise; give source.fps"
        return at_ns, None


_Timed = tuple[int, Any]
"""When a frame is, by its container (ns; -1: it doesn't say), and its image, H x W x 3 (BGR); None: there is none."""


def _opened_video(path: Path) -> tuple[_Timed, Generator[_Timed], float]:
    """A video's first frame, the others, and when, by its header, its last frame but one is due (s); 0: unknown.

    The number of frames is an estimate in some containers, by the length and the mean rate.
    """
    import cv2

    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise SourceError(f"path: {path} can't be opened as a video; a complete file in a format of FFmpeg's")
    # Pixels are as the sensor has them, as in every other container: the lens is of the sensor.
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    fps = capture.get(cv2.CAP_PROP_FPS)
    due_s = (capture.get(cv2.CAP_PROP_FRAME_COUNT) - 2.0) / fps if fps > 0.0 else 0.0
    codec = round(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("latin-1")
    frames, why = by_opencv(capture), repr(codec)
    if (first := next(frames, None)) is not None:
        return first, frames, due_s
    try:
        needed("av")
    except SourceError as error:
        raise SourceError(f"path: {path}: OpenCV can't decode this {codec!r}, PyAV may ({error})") from None
    frames = _by_pyav(path)
    try:
        if (first := next(frames, None)) is not None:
            return first, frames, due_s
    except SourceError as error:
        why = str(error)
    raise SourceError(f"path: {path} has no frame that can be decoded ({why}); a complete video")


def by_opencv(capture: Any) -> Generator[_Timed]:
    """The frames of an open ``cv2.VideoCapture``, which is released in the end."""
    try:
        while capture.grab():
            at_ms = capture.get(_CAP_PROP_POS_MSEC)
            decoded, image = capture.retrieve()
            yield round(1e6 * at_ms) if math.isfinite(at_ms) else -1, image if decoded else None
    finally:
        capture.release()


_CAP_PROP_POS_MSEC = 0  # OpenCV's


def _by_pyav(path: Path) -> Generator[_Timed]:
    """As PyAV has them, whatever it says of the way up.  Raises :class:`SourceError` where the file is damaged."""
    first_s: float | None = None
    for at_s, frame in video_frames(str(path), 0.0):
        first_s = at_s if first_s is None else first_s
        yield round(1e9 * (at_s - first_s)), frame.to_ndarray(format="bgr24")
