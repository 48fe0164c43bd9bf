"""Files of recorded episodes, on this machine or in an object store: shared by the sources and the search for them."""

from __future__ import annotations

import importlib
import posixpath
from collections.abc import Generator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gripmon.io.sources.base import SourceError
from gripmon.model.errors import one_line
from gripmon.model.jaw import opening_between
from gripmon.model.records import Array, Image

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

EXTRA = "pip install -e '.[datasets]' in gripmon's checkout"


def file_system(path: str) -> tuple[AbstractFileSystem, str]:
    """The file system for a path or URL (``s3://bucket/…``), and the path in it.  Credentials are those that the
    store's own library finds.  Raises :class:`SourceError` without the libraries.
    """
    try:
        import fsspec

        system, inside = fsspec.core.url_to_fs(path)
    except ImportError as error:
        raise SourceError(f"path: {path} needs the package {error.name or error}; {EXTRA}") from None
    except ValueError as error:
        raise SourceError(f"path: {path}: {error}; a folder, or a URL such as s3://bucket/folder") from None
    return system, inside


def opened(path: str) -> IO[bytes]:
    """A file to read and to seek in.  Raises :class:`SourceError`."""
    try:
        if "://" not in path:
            if (local := Path(path)).exists() and not local.is_file():  # a pipe or a device might never end
                raise SourceError(f"path: {path} is not a regular file; one")
            return local.open("rb")
        system, inside = file_system(path)
        found: IO[bytes] = system.open(inside, "rb")
        return found
    except SourceError:
        raise
    except FileNotFoundError:
        raise SourceError(f"path: there is no file {path}") from None
    except Exception as error:  # noqa: BLE001  each store has its own
        raise SourceError(f"path: {path} can't be read ({one_line(error):.200})") from None


def there(path: str) -> bool:
    """Whether a file or folder exists; False also if that can't be determined."""
    if "://" not in path:
        return Path(path).exists()
    try:
        system, inside = file_system(path)
        return bool(system.exists(inside))
    except Exception:  # noqa: BLE001  each store has its own; opening it reports why
        return False


def joined(root: str, *parts: str) -> str:
    """A path below a path or URL."""
    return posixpath.join(root, *parts)


def needed(package: str) -> Any:
    """A package of the extra ``datasets``.  Raises :class:`SourceError` where it isn't installed."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise SourceError(f"path: needs the package {error.name}; {EXTRA}") from None


def openings_at(stamps_ns: NDArray[np.int64], openings_m: Array, wanted_ns: int) -> float:
    """The opening (m) at a time, from reports (n,) in order of time: :func:`opening_between` two; before the first
    and after the last report their value holds.
    """
    after = int(np.searchsorted(stamps_ns, wanted_ns))
    if after in (0, len(stamps_ns)):
        return float(openings_m[min(after, len(stamps_ns) - 1)])
    first, last = ((int(stamps_ns[n]), float(openings_m[n])) for n in (after - 1, after))
    return opening_between(first, last, wanted_ns)


class VideoDecoder:
    """Pictures from packets of an elementary stream, in grey levels; in one thread, so that nothing else waits."""

    CODECS: ClassVar = {"h264": "h264", "h265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "av1"}
    NAMES = ", ".join(CODECS)

    @classmethod
    def knows(cls, format_name: object) -> bool:
        """Whether that is a format of videos."""
        return str(format_name).lower() in cls.CODECS

    def __init__(self, format_name: str) -> None:
        """``format_name``: as foxglove.CompressedVideo has it.  Raises ValueError for another one."""
        if not self.knows(format_name):
            raise ValueError(f"a video of format {format_name!r}; one of {self.NAMES}")
        codec = self.CODECS[format_name.lower()]
        av = needed("av")
        self._context, self._packet, self._error = av.CodecContext.create(codec, "r"), av.Packet, av.error.FFmpegError
        self._context.thread_count = 1

    def decode(self, data: bytes) -> tuple[Image | None, str | None]:
        """The picture of one packet, or why there is none."""
        try:
            frames = self._context.decode(self._packet(data))
        except self._error as error:
            return None, f"the video frame can't be decoded ({one_line(error):.200})"
        if not frames:
            return None, "the video frame can't be decoded (none before the first key frame)"
        return frames[-1].to_ndarray(format="gray"), None


def video_frames(path: str, begin_s: float) -> Generator[tuple[float, Any]]:
    """Frames of a video with their times (s), from ``begin_s``.  Raises :class:`SourceError` where it is damaged."""
    av = needed("av")
    with opened(path) as file:
        try:
            with av.open(file) as container:
                stream = container.streams.video[0]
                stream.codec_context.thread_count = 1
                container.seek(max(int(begin_s / stream.time_base), 0), stream=stream)
                for frame in container.decode(stream):
                    if frame.time is not None and frame.time >= begin_s:
                        yield frame.time, frame
        except (av.error.FFmpegError, OSError, IndexError) as error:
            raise SourceError(f"{path} can't be decoded ({one_line(error):.200}); is it truncated?") from None
