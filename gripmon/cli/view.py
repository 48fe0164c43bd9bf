"""``gripmon view``: recordings in rerun's viewer."""

from __future__ import annotations

import argparse
import functools
import http.server
import sys
import threading
import urllib.parse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common
from gripmon.cli.recorded_run import recording_files

if TYPE_CHECKING:
    from gripmon.record.write.viewer import WebPage

_DESCRIPTION = """\
Show recordings in rerun's viewer: in a window where there is a display, else as a page for a browser
on this machine, whose address is printed.  The files of one run appear as one recording.  It ends
with Ctrl-C, or when the window is closed, and leaves nothing running."""

_EXAMPLES = """\
  gripmon view recordings/
  gripmon view arm1-wrist-20260101T060000Z-000*.rrd --web
  gripmon view shift.rrd --web --port 9091

A page for another machine: ssh -L, for the page's port and the one of the files, which its address
names.

exit codes: 0 the window was closed; 2 wrong usage or no such recording; 3 no viewer could be started;
130 Ctrl-C"""

_PORT = 9090
_PIECE_BYTES = 1 << 20
_MAGIC = b"RRF2"


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "view", run, "recordings in rerun's viewer, native or in a browser", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help=".rrd files, or folders of them with all below"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--web", action="store_true", help="as a page; the default where there is no display")
    where.add_argument("--native", action="store_true", help="in a window; the default where there is a display")
    parser.add_argument(
        "--port", type=_port, metavar="N", help=f"TCP port of the page (default {_PORT}, or another if that is in use)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon view``."""
    from gripmon.model.stopping import signals_exit
    from gripmon.record.write.viewer import NativeViewer, ViewerError, has_display

    files = recording_files([Path(name) for name in arguments.recordings])
    for path in files:
        _check(path)
    try:
        with signals_exit(), ExitStack() as opened:
            if arguments.native or (has_display() and not arguments.web):
                viewer = NativeViewer([str(path) for path in files], tied=True)
                opened.callback(viewer.close)
                return common.EXIT_FAILED if viewer.wait() else common.EXIT_DONE
            page = opened.enter_context(_served(files, arguments.port))
            print(f"{page.url}\n(Ctrl-C ends it)", flush=True)
            threading.Event().wait()
    except ViewerError as error:
        raise common.CommandFailedError(f"view: {error}") from None
    return common.EXIT_DONE


@contextmanager
def _served(files: list[Path], port: int | None) -> Iterator[WebPage]:
    """The page and, from this process, the files that it shows; all of it on loopback."""
    from gripmon.record.write.view import LOOPBACK
    from gripmon.record.write.viewer import ViewerError, WebPage, free_port, is_free

    if port is not None and not is_free(port):
        raise common.CommandFailedError(
            f"--port {port}: is in use on {LOOPBACK}; another port, or none for any", common.EXIT_USAGE
        )
    web_port = free_port(_PORT) if port is None else port
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
            print(f"view: {path}: can't be read ({error.strerror})", file=sys.stderr)

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


def _check(path: Path) -> None:
    """End the command for a file that is no recording."""
    try:
        with path.open("rb") as file:
            start = file.read(4)
    except OSError as error:
        raise common.CommandFailedError(f"{path}: can't be read ({error.strerror})", common.EXIT_USAGE) from None
    if start != _MAGIC:
        raise common.CommandFailedError(f"{path}: is no recording; an .rrd file of gripmon's", common.EXIT_USAGE)


def _port(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 65535:
        raise argparse.ArgumentTypeError(f"'{text}' is no TCP port; 1 to 65535")
    return int(text)
