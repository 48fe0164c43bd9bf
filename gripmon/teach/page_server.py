"""The page's web server: reachable only from this machine unless another address is given, and only with the token.

A page of another site in the same browser can also send requests here, or have its name resolve to 127.0.0.1 (DNS
rebinding).  So every request must name this host, carry the token in its path, and come from this page if the browser
names an origin; no header gives other sites access.

It uses the standard library: with starlette and uvicorn these checks, most of this file, would be the same, and five
more packages would be installed.
"""

from __future__ import annotations

import contextlib
import errno
import importlib.resources
import logging
import os
import secrets
import sys
import threading
import webbrowser
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import TCPServer
from typing import Any, Protocol, TypeVar

import msgspec
import numpy as np

from gripmon.model.decoding import decoder_of
from gripmon.model.errors import InputError, in_short
from gripmon.teach.messages import BadRequest, EmptyRequest, Failure

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

ADDRESS = "127.0.0.1"
LONGEST_REQUEST = 1_000_000
_SILENT_S = 30.0
_TOKEN_BYTES = 24
_LOOK_S = 0.2
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


_ALONE = {
    "Content-Security-Policy": "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src "
    "'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "unsafe-none",  # browsers refuse a sandbox with another one
}


class Sandboxed(bytes):
    """A page with scripts of its own, from a file: it runs them without this site's origin, and the token in its
    address opens such pages alone.
    """


Served = tuple[bytes, str]
"""The content of an answer, and its media type."""
Action = tuple[type[Any], Callable[[Any], object]]
"""The type of a request's body, and the function that answers it; its :class:`BadRequest` and
:class:`gripmon.model.errors.InputError` are sent as one line."""


class Site(Protocol):
    """The content of a server.  Paths are those below the token; both methods may be called from any thread."""

    def get(self, path: str) -> Served | None:
        """None: there is nothing at this address."""
        ...

    def post(self, path: str) -> Action | None:
        """None: there is nothing at this address."""
        ...


def _as_list(value: np.ndarray | np.generic) -> Any:
    """NumPy's arrays and numbers as JSON has them."""
    return value.tolist()


def web_files(page: str) -> dict[str, Served]:
    """The folder ``web`` by the path at which its files are served: ``page`` at the root, and what pages consist of."""
    folder = importlib.resources.files("gripmon.teach") / "web"
    known = [file for file in folder.iterdir() if Path(file.name).suffix in _KINDS]
    files = {file.name: (file.read_bytes(), _KINDS[Path(file.name).suffix]) for file in known}
    return {"": files[page]} | {name: file for name, file in files.items() if not name.endswith(".html")}


class PageServer:
    """Serves one site until it is done.  The constructor raises OSError if the port is taken, or if ``address`` isn't
    this machine's.
    """

    def __init__(self, site: Site, port: int = 0, address: str = ADDRESS):
        self._http = _Http(site, port, address)
        self.done, self.port, self.url = self._http.done, self._http.server_port, self._http.url
        self._thread = threading.Thread(target=self._http.serve_forever, args=(0.1,), name="gripmon-page")
        self._thread.start()

    def close(self) -> None:
        """Stop taking requests; may be called twice."""
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()


def serve(
    site: Site,
    port: int,
    announce: Callable[[str], object],
    *,
    open_browser: bool,
    look: Callable[[], object] = lambda: None,
    address: str = ADDRESS,
) -> None:
    """Serve a site until the person is done.  ``announce`` gets its address; ``look`` is called regularly.

    Raises :class:`~gripmon.model.errors.InputError` for a port that is taken, or an ``address`` that isn't this
    machine's.
    """
    try:
        server = PageServer(site, port, address)
    except OSError as error:
        if error.errno != errno.EADDRINUSE and address != ADDRESS:
            text = f"{address}: can't be listened on ({error.strerror}); an IPv4 address of this machine"
            raise InputError(text, "address") from None
        raise InputError(f"{port}: can't be listened on ({error.strerror}); another one, or none", "port") from None
    try:
        announce(server.url)
        displayed = sys.platform in ("darwin", "win32") or any(os.environ.get(name) for name in _DISPLAYS)
        if open_browser and displayed:
            webbrowser.open(server.url)
        while not server.done.wait(_LOOK_S):  # returns regularly, to notice an interrupt caught by another thread
            look()
    finally:
        server.close()


class _Http(ThreadingHTTPServer):
    """A server with what its handlers share."""

    daemon_threads = True
    request_queue_size = 32

    def __init__(self, site: Site, port: int, address: str):
        self.site, self.done = site, threading.Event()
        self.token, self.sandbox_token = (secrets.token_urlsafe(_TOKEN_BYTES) for _ in range(2))
        self.encode = msgspec.json.Encoder(enc_hook=_as_list).encode
        super().__init__((address, port), _Handler)
        names = {address, "localhost"} if address == ADDRESS else {address}
        self.hosts = frozenset(f"{name}:{self.server_port}" for name in names)
        self.url = f"http://{address}:{self.server_port}/{self.token}/"

    def server_bind(self) -> None:
        """Bind without the base class's look-up of the host's name, which may take seconds."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log only for debugging: a browser that disconnects early isn't an error."""
        _log.debug("request of %s failed", client_address, exc_info=True)


class _Refused(Exception):
    """``location``: where it is instead."""

    def __init__(self, status: HTTPStatus, text: str, location: str = ""):
        super().__init__(text)
        self.status, self.location = status, location


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "gripmon", ""
    timeout = _SILENT_S
    server: _Http
    _last = False
    _location = ""

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def _answer(self, act: Callable[[str], Served]) -> None:
        """Answer every request, errors with one line."""
        status, kind, self._location = HTTPStatus.OK, "application/json", ""
        try:
            data, kind = act(self._checked_path())
        except _Refused as refused:
            status, data, self._location = refused.status, self._failure(str(refused)), refused.location
        except (BadRequest, InputError) as refused:
            status, data = HTTPStatus.BAD_REQUEST, self._failure(str(refused))
        except (ConnectionError, TimeoutError):
            self.close_connection = True
            return
        except Exception as error:  # noqa: BLE001  whatever it is, report it to the page, and go on
            _log.debug("request failed", exc_info=True)
            status, data = HTTPStatus.INTERNAL_SERVER_ERROR, self._failure(in_short(error))
        if status is not HTTPStatus.OK:
            self.close_connection = True  # the rest of its body is not read
        with contextlib.suppress(ConnectionError, TimeoutError):
            self._send(status, data, kind)
        if self._last:
            self.server.done.set()

    def _send(self, status: HTTPStatus, data: bytes, kind: str) -> None:
        self.send_response(status)
        for name, value in (_HEADERS | (_ALONE if isinstance(data, Sandboxed) else {})).items():
            self.send_header(name, value)
        if self._location:
            self.send_header("Location", self._location)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(data)

    def _failure(self, text: str) -> bytes:
        return self.server.encode(Failure(error=" ".join(text.split())))

    def _checked_path(self) -> str:
        """The requested path below the token."""
        server = self.server
        hosts = self.headers.get_all("Host") or []
        if len(hosts) != 1 or hosts[0] not in server.hosts:
            raise _Refused(HTTPStatus.FORBIDDEN, "this is not the host that was asked for")
        origin = self.headers.get("Origin")
        if origin is not None and origin not in {f"http://{host}" for host in server.hosts}:
            raise _Refused(HTTPStatus.FORBIDDEN, "requested by another site")
        _, _, path = self.path.partition("/")
        token, slash, rest = path.partition("/")
        is_site, self._is_sandbox = (
            secrets.compare_digest(token.encode(), known.encode()) for known in (server.token, server.sandbox_token)
        )
        if not slash or not (is_site or self._is_sandbox):
            raise _Refused(HTTPStatus.FORBIDDEN, "the address lacks its token; the one that gripmon printed")
        return rest

    def _get(self, path: str) -> Served:
        found = self.server.site.get(path)
        if found is None or (self._is_sandbox and not isinstance(found[0], Sandboxed)):
            raise _Refused(HTTPStatus.NOT_FOUND, "there is nothing at this address")
        if isinstance(found[0], Sandboxed) and not self._is_sandbox:
            raise _Refused(HTTPStatus.SEE_OTHER, "it has an address of its own", f"/{self.server.sandbox_token}/{path}")
        return found

    def _post(self, path: str) -> Served:
        action = (EmptyRequest, self._end) if path == "done" else self.server.site.post(path)
        if action is None or self._is_sandbox:
            raise _Refused(HTTPStatus.NOT_FOUND, "there is nothing at this address")
        kind, act = action
        return self.server.encode(act(self._body(kind))), "application/json"

    def _end(self, _order: EmptyRequest) -> None:
        """End the process once this request has been answered."""
        self._last = self.close_connection = True

    def _body(self, kind: type[_T]) -> _T:
        if self.headers.get_content_type() != "application/json":
            raise _Refused(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "application/json is understood")
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal()):
            raise _Refused(HTTPStatus.LENGTH_REQUIRED, "a request states its length")
        if len(length) > 9 or int(length) > LONGEST_REQUEST:
            raise _Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {LONGEST_REQUEST} bytes")
        try:
            return decoder_of(kind).decode(self.rfile.read(int(length)))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise _Refused(HTTPStatus.BAD_REQUEST, f"not understood: {error}") from None

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: every address contains the token."""
