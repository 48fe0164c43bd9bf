"""rerun's viewer as a process of its own that never outlives the one that started it, unless it is a window."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import time
import urllib.parse
from collections.abc import Sequence
from pathlib import Path

from gripmon.record.write.view import LOOPBACK

_START_S = 20.0
_STOP_S = 5.0
# The kernel ends the viewer with its parent, however that ends; parent gone before: not even started.
_TIED = (
    "import ctypes, os, signal, sys; ctypes.CDLL(None).prctl(1, signal.SIGKILL); "
    "os.getppid() == int(sys.argv[1]) or sys.exit(1); os.execv(sys.argv[2], sys.argv[2:])"
)


class ViewerError(RuntimeError):
    """No viewer can be started; the text says why, and what would help."""


def has_display() -> bool:
    """Whether there is a screen to open a window on."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def is_free(port: int) -> bool:
    """Whether one may listen there, on loopback."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return False
        return True


def free_port(preferred: int) -> int:
    """The preferred port of loopback, or any other if a program has that one."""
    if is_free(preferred):
        return preferred
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def page_url(web_port: int, sources: Sequence[str]) -> str:
    """The page that shows these sources."""
    wanted = "&".join(f"url={urllib.parse.quote(source, safe='')}" for source in sources)
    return f"http://{LOOPBACK}:{web_port}/?{wanted}"


class WebPage:
    """Serves the page with rerun's web viewer on loopback, until :meth:`close` or the end of this process."""

    def __init__(self, web_port: int, sources: Sequence[str]) -> None:
        """Returns when the page can be loaded.  Raises :class:`ViewerError`."""
        if not is_free(web_port):
            raise ViewerError(f"port {web_port} of {LOOPBACK} is in use; another one")
        self.url = page_url(web_port, sources)
        # With a source to show, it serves the page alone and no data.
        command = ["--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(web_port), sources[0]]
        self._process = _start(command, tied=True)
        self._await(web_port)

    def close(self) -> None:
        """End it."""
        _end(self._process)

    def _await(self, web_port: int) -> None:
        end_s = time.monotonic() + _START_S
        while time.monotonic() < end_s and self._process.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex((LOOPBACK, web_port)) == 0:
                    return
            time.sleep(0.02)
        _end(self._process)
        raise ViewerError("rerun's web viewer doesn't start; `rerun --serve-web` may say why")


class NativeViewer:
    """rerun's window, on files or on a stream."""

    def __init__(self, sources: Sequence[str], *, tied: bool) -> None:
        """``tied``: it ends with this process; else it stays open until it is closed.  Raises :class:`ViewerError`."""
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
    # Not the command `rerun`: that one leaves a child behind when it is ended.
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
        start_new_session=True,  # a Ctrl-C is for us, who end it
        env={**os.environ, "BROWSER": "true"},
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
