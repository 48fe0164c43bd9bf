"""rerun's viewer as a separate process, which ends with its parent unless it is a window; and finished recordings on
its web page, served unchanged from disk.
"""

from __future__ import annotations

import functools
import http.server
import importlib.util
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from gripmon.record.recorder import LOOPBACK

_START_S = 20.0
_STOP_S = 5.0
# The kernel kills the viewer when its parent ends, however that ends; if the parent is gone already, it isn't started.
_TIED = (
    "import ctypes, os, signal, sys; ctypes.CDLL(None).prctl(1, signal.SIGKILL); "
    "os.getppid() == int(sys.argv[1]) or sys.exit(1); os.execv(sys.argv[2], sys.argv[2:])"
)


class ViewerError(RuntimeError):
    """No viewer can be started; the text says why and what to do."""


def has_display() -> bool:
    """Whether there is a screen to open a window on."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def is_free(port: int) -> bool:
    """Whether a program can listen on this loopback port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return False
        return True


def free_port(preferred: int) -> int:
    """The preferred loopback port, or any free one if that is in use."""
    if is_free(preferred):
        return preferred
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


class WebPage:
    """Serves the page ``url`` with rerun's web viewer on loopback, until :meth:`close` or the end of this process."""

    def __init__(self, web_port: int, sources: Sequence[str]) -> None:
        """Returns when the page, which shows these sources, can be loaded.  Raises :class:`ViewerError`."""
        if not is_free(web_port):
            raise ViewerError(f"port {web_port} of {LOOPBACK} is in use; another one")
        wanted = "&".join(f"url={urllib.parse.quote(source, safe='')}" for source in sources)
        self.url = f"http://{LOOPBACK}:{web_port}/?{wanted}"
        # With a source to show, it serves the page only, no data.
        command = ["--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(web_port), sources[0]]
        self._process = _start(command, tied=True)
        end_s = time.monotonic() + _START_S
        while time.monotonic() < end_s and self._process.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex((LOOPBACK, web_port)) == 0:
                    return
            time.sleep(0.02)
        self.close()
        raise ViewerError("rerun's web viewer doesn't start; `rerun --serve-web` may say why")

    def close(self) -> None:
        """End it."""
        _end(self._process)


class NativeViewer:
    """rerun's window, on files or on a stream."""

    def __init__(self, sources: Sequence[str], *, tied: bool) -> None:
        """``tied``: the window ends with this process, else when it is closed.  Raises :class:`ViewerError`."""
        if not has_display():
            raise ViewerError("there is no display for a window; the web viewer needs none")
        self._process = _start(["--bind", LOOPBACK, "--port", "auto", *sources], tied=tied)

    def wait(self) -> int:
        """Until the window is closed; its exit code."""
        return self._process.wait()

    def close(self) -> None:
        """Close the window."""
        _end(self._process)


def _start(arguments: Sequence[str], *, tied: bool) -> subprocess.Popen[bytes]:
    # Not the command `rerun`, which leaves a child process behind when it is killed.
    found = importlib.util.find_spec("rerun_cli")
    executable = None if found is None or found.origin is None else Path(found.origin).parent / "rerun"
    if executable is None or not executable.is_file():
        raise ViewerError("rerun's viewer isn't installed; pip install rerun-sdk")
    command = [str(executable), *arguments]
    if tied:
        command = [sys.executable, "-I", "-c", _TIED, str(os.getpid()), *command]
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is handled here, which ends it
        env={**os.environ, "BROWSER": "true"},
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextmanager
def serve_files(files: Sequence[Path], web_port: int) -> Iterator[WebPage]:
    """Serve the page and, from this process, the files that it shows, on loopback until the context ends.

    The standard library's server is enough: the page needs GET and HEAD of a few named files, and only these are
    served.  Raises :class:`ViewerError`.
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


class _Files(http.server.SimpleHTTPRequestHandler):
    """Serves these files, and no others, to the page that was opened for them."""

    def __init__(self, named: dict[str, Path], origin: str, *details: Any) -> None:
        self._named, self._origin = named, origin
        super().__init__(*details)

    def translate_path(self, path: str) -> str:
        """The file; for any other path an empty string, which is not found."""
        return str(self._named.get(path, ""))

    def end_headers(self) -> None:
        """Add the header that lets the page read the file."""
        self.send_header("Access-Control-Allow-Origin", self._origin)
        super().end_headers()

    def copyfile(self, source: Any, outputfile: Any) -> None:
        """Stop quietly if the page is closed."""
        with suppress(BrokenPipeError, ConnectionResetError):
            super().copyfile(source, outputfile)

    def log_message(self, format: str, *values: Any) -> None:
        """Log nothing."""
