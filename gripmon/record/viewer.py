"""rerun's viewer as a separate process, which ends with its parent unless it is a window."""

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

from gripmon.record.recorder import LOOPBACK

_START_S = 20.0
_STOP_S = 5.0
_SERVED_MEMORY = "50%"  # of the machine's, for files that are served: of larger ones the end is shown
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


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((LOOPBACK, port)) == 0


def free_port(preferred: int = 0) -> int:
    """The preferred loopback port, or any free one if that is in use, or 0."""
    if preferred and is_free(preferred):
        return preferred
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


class WebPage:
    """Serves the page ``url`` with rerun's web viewer on loopback, until :meth:`close` or the end of this process."""

    def __init__(self, web_port: int, sources: Sequence[str]) -> None:
        """``sources``: the address of a stream, or paths of files, which the viewer's process then serves, too.

        Returns when the page can be loaded.  Raises :class:`ViewerError`.
        """
        if not is_free(web_port):
            raise ViewerError(f"port {web_port} of {LOOPBACK} is in use; another one")
        ports, shown = [web_port], sources[0]
        command = ["--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(web_port), *sources]
        if "://" not in shown:
            ports.append(free_port())
            shown = f"rerun+http://{LOOPBACK}:{ports[1]}/proxy"
            command += ["--port", str(ports[1]), "--server-memory-limit", _SERVED_MEMORY]
        self.url = f"http://{LOOPBACK}:{web_port}/?url={urllib.parse.quote(shown, safe='')}"
        self._process = _start(command, tied=True)
        end_s = time.monotonic() + _START_S
        while time.monotonic() < end_s and self._process.poll() is None:
            if all(_listens(port) for port in ports):
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
