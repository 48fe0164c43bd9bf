"""What ``--view`` opens beside a running monitor."""

from __future__ import annotations

import sys
import threading
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from gripmon.model.errors import InputError, NoResultError

if TYPE_CHECKING:
    from gripmon.record.write import ViewSettings

KINDS = ("auto", "web", "native", "server")
_SERVER_STARTS_S = 60.0
_LOOK_EVERY_S = 0.1


def add_option(parser: Any) -> None:
    """Add ``--view``."""
    parser.add_argument(
        "--view",
        nargs="?",
        const="auto",
        choices=KINDS,
        help="watch it live in rerun's viewer, on this machine: native (a window), web (a page whose address is said), "
        "auto (native where there is a display), or server (only the stream that viewers connect to)",
    )


class LiveView:
    """A viewer on the stream that the recording serves."""

    def __init__(self, settings: ViewSettings, kind: str, said_by: str) -> None:
        """Ends the command, before anything runs, where it can't be shown.  ``said_by`` names the configuration."""
        from gripmon.record.viewer import has_display, is_free

        self.settings = settings
        self._native = kind == "native" or (kind == "auto" and has_display())
        self._web = kind == "web" or (kind == "auto" and not has_display())
        if kind == "native" and not has_display():
            raise InputError("--view native: there is no display; --view web")
        ports = [("port", settings.port)] + [("web_port", settings.web_port)] * self._web
        for key, port in ports:
            if not is_free(port):
                raise InputError(f"{said_by}: view.{key}: {port} is in use on 127.0.0.1; another port")

    def open(self, opened: ExitStack) -> None:
        """Start the viewer, which shows the stream as soon as there is one; a page ends with ``opened``."""
        from gripmon.record.viewer import ViewerError, WebPage

        url = self.settings.stream_url
        if self._web:
            try:
                page = WebPage(self.settings.web_port, [url])
            except ViewerError as error:
                raise NoResultError(f"--view web: {error}") from None
            opened.callback(page.close)
            print(f"live view: {page.url}", file=sys.stderr)
        print(f"live view: rerun viewers connect to {url}", file=sys.stderr)
        if self._native:
            threading.Thread(target=self._open_window, name="viewer", daemon=True).start()

    def _open_window(self) -> None:
        """A viewer that finds no server gives up: it is started when there is one.  The window is the user's: it stays
        until it is closed.
        """
        from gripmon.record.viewer import NativeViewer, ViewerError, is_free

        end_s = time.monotonic() + _SERVER_STARTS_S
        while is_free(self.settings.port):
            if time.monotonic() > end_s:
                return
            time.sleep(_LOOK_EVERY_S)
        try:
            NativeViewer([self.settings.stream_url], tied=False)
        except ViewerError as error:
            print(f"--view native: {error}", file=sys.stderr)
