"""Images from a camera into a folder, taken automatically or by a person, with a live view."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec

from gripmon.calibrate.grey_levels import to_bytes, to_grey
from gripmon.calibrate.sighting import Sighting
from gripmon.daemon.setup.views import MOVED_PX, Coverage, View, Viewer, coverage, moved
from gripmon.io.sources import Source, Waiting
from gripmon.io.sources.files import TIMESTAMPS_NAME, TableRow, read_table, table_of
from gripmon.model.atomic import write_atomically
from gripmon.model.canvas import Canvas
from gripmon.model.errors import InputError, in_short
from gripmon.model.images import IMAGE_SUFFIXES, natural_key, read_image
from gripmon.model.records import Frame, Image
from gripmon.model.targets import Target
from gripmon.teach.messages import BadRequest, encoded

MOST_IMAGES = 60
_GREEN = (80, 220, 60)
_READY = "ready to be taken"


class CaptureState(msgspec.Struct, frozen=True, kw_only=True):
    """``note``: what happened to the newest image; ``ended``: a folder or video has no more images; ``shown`` counts
    the live images; ``itself``: images are taken automatically."""

    images: tuple[str, ...]
    running: bool
    itself: bool
    live: bool
    ended: bool
    shown: int
    note: str
    coverage: Coverage | None


class Capture:
    """Writes images of a source to ``folder``: ``000.png``, ``001.png`` …, with their time stamps and jaw openings.

    From a live camera an image is taken automatically when it is sharp, nothing in it has moved since the previous
    frame, something has moved since the last image taken, and the ``target``, if any, is detected.  Of a folder
    or a video every image is taken that is sharp and shows the target.
    """

    def __init__(self, folder: Path, target: Target | None) -> None:
        self.folder, self._target = folder, target
        self._lock = threading.Condition()
        self._source: Source | None = None
        self._thread: threading.Thread | None = None
        self._viewer = Viewer(target)
        self._newest: tuple[Frame, View] | None = None
        self._last_taken: Image | None = None
        self._seen: dict[str, Sighting] = {}
        self._size_px: tuple[int, int] | None = None
        self._note, self._shown = "", 0
        self._itself, self._wanted, self._ended = False, 0, False

    def start(self, source: Source) -> None:
        """Start reading a source, which this object owns from now on."""
        self.stop()
        self._viewer, self._newest, self._note, self._ended = (
            Viewer(self._target),
            None,
            "waiting for the camera",
            False,
        )
        self._itself, self._wanted = False, 1
        self._source = source
        self._thread = threading.Thread(target=self._run, args=(source,), name="gripmon-capture", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Release the camera."""
        source, self._source = self._source, None
        if source is not None:
            source.close()
        with self._lock:
            self._lock.notify_all()
        if self._thread is not None:
            self._thread.join(10.0)

    def by_itself(self, on: bool) -> None:
        """Take images automatically from now on, or no longer; also the image shown, if it can be taken."""
        with self._lock:
            if on and not self._itself and self._note == _READY and self._newest is not None:
                self._note = f"taken: {self._keep(*self._newest)}"
            self._itself = on
            self._lock.notify_all()

    def go_on(self) -> None:
        """Read the next image of a folder or video."""
        with self._lock:
            self._wanted += 1
            self._lock.notify_all()

    def take(self) -> str:
        """Keep the image shown; return its name.  Raises :class:`BadRequest`."""
        with self._lock:
            if self._newest is None:
                raise BadRequest(self._note or "no image has come yet; start the camera")
            if self._newest[1].fault:
                raise BadRequest(f"not taken: {self._newest[1].fault}")
            return self._keep(*self._newest)

    def drop(self, name: str) -> None:
        """Delete an image that was taken.  Raises :class:`BadRequest`."""
        if name not in self.images():
            raise BadRequest(f"there is no image {name}")
        with self._lock:
            (self.folder / name).unlink(missing_ok=True)
            self._seen.pop(name, None)
            rows = self._rows()
            if rows.pop(name, None) is not None:
                self._write_rows(rows)

    def images(self) -> tuple[str, ...]:
        """Names, in the order of capture."""
        if not self.folder.is_dir():
            return ()
        names = (p.name for p in self.folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
        return tuple(sorted(names, key=natural_key))

    def preview(self) -> bytes:
        """JPEG of the newest image, with the target's points marked.  Raises :class:`BadRequest`."""
        newest = self._newest
        if newest is None or newest[0].image is None:
            raise BadRequest(self._note or "no image has come yet")
        grey = to_bytes(to_grey(newest[0].image))
        found = newest[1].sighting
        if not isinstance(found, Sighting):
            return encoded(grey, ".jpg")
        canvas = Canvas(grey, 1.0)
        canvas.circle(found.uv_px, max(2.0, grey.shape[1] / 250.0), _GREEN, -1)
        return encoded(canvas.picture, ".jpg")

    def state(self) -> CaptureState:
        """For the page."""
        source, views = self._source, None
        if self._target is not None:
            views = self._coverage()
        with self._lock:
            return CaptureState(
                images=self.images(), running=source is not None, itself=self._itself,
                live=source is not None and source.live, ended=self._ended, shown=self._shown, note=self._note,
                coverage=views,
            )  # fmt: skip

    def notes(self) -> Iterator[str]:
        """What happens to the images, each change once, until the source ends or the coverage is complete."""
        last = ""
        while self._thread is not None and self._thread.is_alive():
            self._thread.join(0.1)
            if self._note != last:
                last = self._note
                yield last
            views = self._coverage() if self._target is not None else None
            if self._source is not None and self._source.live and views is not None and not views.wants:
                return

    def _coverage(self) -> Coverage | None:
        """The coverage of all images taken, including earlier ones."""
        for name in self.images():
            if name not in self._seen:
                image, _ = read_image(self.folder / name)
                found = None if image is None else Viewer(self._target).look(image).sighting
                if isinstance(found, Sighting):
                    self._seen[name] = found
                    self._size_px = found.size_px
        seen = [self._seen[name] for name in self.images() if name in self._seen]
        size_px = self._size_px
        return None if size_px is None else coverage(seen, size_px)

    def _run(self, source: Source) -> None:
        try:
            while (frame := source.read()) is not None:
                if isinstance(frame, Waiting):
                    self._note = frame.reason
                    continue
                self._see(frame, source.live)
                if not source.live and not self._wait_for_order(source):
                    return
        except Exception as error:  # noqa: BLE001  the page must report any failure of a driver
            self._note = f"{in_short(error)}; start the camera again"
            return
        with self._lock:
            self._ended, self._itself = True, False
            if self._source is source:
                self._note = f"no more images; {len(self.images())} taken"

    def _wait_for_order(self, source: Source) -> bool:
        """Wait until the next image of a folder is requested; False: the source was closed."""
        with self._lock:
            self._wanted -= 1
            self._lock.wait_for(lambda: self._itself or self._wanted > 0 or self._source is not source)
            self._wanted = max(self._wanted, 1)
            return self._source is source

    def _see(self, frame: Frame, live: bool) -> None:
        if frame.image is None:
            self._note = frame.fault or "not an image"
            return
        view = self._viewer.look(frame.image)
        with self._lock:
            self._newest, self._shown = (frame, view), self._shown + 1
            height, width = frame.image.shape[:2]
            self._size_px = width, height
            self._note = view.fault or (self._hold(frame.image, view) if live else "") or _READY
            if self._itself and self._note == _READY:
                try:
                    self._note = f"taken: {self._keep(frame, view)}"
                except (BadRequest, InputError) as error:
                    self._note, self._itself = str(error), False

    def _hold(self, image: Image, view: View) -> str:
        """Why an image of a live camera isn't taken yet; empty if it can be taken."""
        if not view.still:
            return "hold still"
        if self._last_taken is None:
            return ""
        away_px = moved(self._last_taken, to_bytes(to_grey(image)))
        return "move the camera: this view is taken" if away_px is not None and away_px < MOVED_PX else ""

    def _keep(self, frame: Frame, view: View) -> str:
        """Write the image.  The lock is held."""
        names = self.images()
        if len(names) >= MOST_IMAGES:
            raise BadRequest(f"{MOST_IMAGES} images are enough")
        assert frame.image is not None
        ending = ".tif" if frame.image.dtype.kind == "f" else ".png"
        data = cv2.imencode(ending, frame.image)[1].tobytes()
        if any((self.folder / n).stat().st_size == len(data) and (self.folder / n).read_bytes() == data for n in names):
            return "there already"  # the same folder again
        number = 1 + max((int(Path(n).stem) for n in names if Path(n).stem.isdecimal()), default=-1)
        name = f"{number:03d}{ending}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_atomically(self.folder / name, data)
            if frame.jaw_opening_m is not None:
                self._write_rows(self._rows() | {name: TableRow(max(frame.stamp_ns, 0), frame.jaw_opening_m)})
        except OSError as error:
            raise BadRequest(f"{self.folder / name}: can't be written ({error.strerror or error})") from None
        self._last_taken = to_bytes(to_grey(frame.image))
        if isinstance(view.sighting, Sighting):
            self._seen[name] = view.sighting
        return name

    def _rows(self) -> dict[str, TableRow]:
        """Rows of the table beside the images."""
        with contextlib.suppress(InputError):
            return read_table(self.folder / TIMESTAMPS_NAME)
        return {}

    def _write_rows(self, rows: dict[str, TableRow]) -> None:
        write_atomically(self.folder / TIMESTAMPS_NAME, table_of(rows))
