"""Recordings on rerun's web viewer: a page, and the files that it fetches, each served as it is on the disk.

By the standard library's server: the page needs GET and HEAD of a few named files, and nothing else may be had.
"""

from __future__ import annotations

import functools
import http.server
import logging
import threading
import urllib.parse
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from gripmon.record.write.view import LOOPBACK
from gripmon.record.write.viewer import ViewerError, WebPage

_log = logging.getLogger(__name__)
_PIECE_BYTES = 1 << 20


@contextmanager
def serve_files(files: Sequence[Path], web_port: int) -> Iterator[WebPage]:
    """The page and, from this process, the files that it shows; all of it on loopback, until the context ends.

    Raises :class:`gripmon.record.write.viewer.ViewerError`.
    """
    named = {f"/{number}/{urllib.parse.quote(path.name)}": path for number, path in enumerate(files)}
    handler = functools.partial(_Files, named, f"http://{LOOPBACK}:{web_port}")
    try:
        server = http.server.ThreadingHTTPServer((LOOPBACK, 0), handler)
    except OSError as error:
        raise ViewerError(f"no port is free on {LOOPBACK} ({error.strerror})") from None
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, name="files", daemon=True).start()
    with ExitStack() as opened:
        opened.callback(server.server_close)
        opened.callback(server.shutdown)
        page = WebPage(web_port, [f"http://{LOOPBACK}:{server.server_port}{name}" for name in named])
        opened.callback(page.close)
        yield page


class _Files(http.server.BaseHTTPRequestHandler):
    """These files and nothing else, to the page that was opened for them."""

    def __init__(self, named: dict[str, Path], origin: str, *details: Any) -> None:
        self._named, self._origin = named, origin
        super().__init__(*details)

    def do_GET(self) -> None:
        """A file as it is on the disk now."""
        path = self._named.get(self.path)
        if path is None:
            self.send_error(404)
            return
        try:
            with path.open("rb") as file:
                left = path.stat().st_size
                self._begin(left)
                while left > 0 and (piece := file.read(min(_PIECE_BYTES, left))):
                    self.wfile.write(piece)
                    left -= len(piece)
        except (BrokenPipeError, ConnectionResetError):
            pass  # the page was closed
        except OSError as error:
            _log.warning("view: %s: can't be read (%s)", path, error.strerror)

    def do_HEAD(self) -> None:
        """How long a file is."""
        path = self._named.get(self.path)
        if path is None or not path.exists():
            self.send_error(404)
            return
        self._begin(path.stat().st_size)

    def _begin(self, size: int) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Content-Length", str(size))
        self.send_header("Access-Control-Allow-Origin", self._origin)
        self.end_headers()

    def log_message(self, format: str, *values: Any) -> None:
        """Say nothing."""
