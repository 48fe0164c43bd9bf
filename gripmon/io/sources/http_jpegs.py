"""A camera's JPEGs over HTTP, as bytes: a video library hides that one is truncated, and fills it with old pixels."""

from __future__ import annotations

import http.client
import re
import ssl
import urllib.error
import urllib.parse
import urllib.request
from typing import Any

from gripmon.io.sources.payload import PayloadError, jpeg_in_colour
from gripmon.model.images import JPEG
from gripmon.model.jpeg import jpeg_end
from gripmon.model.records import Image

LARGEST_BYTES = 64 << 20
"""Of one JPEG."""

_LONGEST_LINE = 1 << 16
_MOST_HEADERS = 100
_CHUNK_BYTES = 1 << 16
_JPEG_TYPES = ("image/jpeg", "image/jpg", "video/x-motion-jpeg", "video/x-mjpeg", "video/mjpeg", "video/x-jpeg")
_UNREADABLE = (OSError, http.client.HTTPException, ValueError, urllib.error.URLError)


class HttpJpegs:
    """An open stream.  Parts of a ``multipart`` answer (RFC 2046) are as long as their ``Content-Length`` says, or end
    with their JPEG, or at the next boundary; any other answer is one JPEG after the other.
    """

    def __init__(self, answer: http.client.HTTPResponse) -> None:
        self._answer = answer
        self._multipart = answer.headers.get_content_maintype() == "multipart"
        boundary = str(answer.headers.get_param("boundary", "")).encode("latin-1", "replace")
        # Some cameras state the dashes that come before a boundary as part of it.
        self._boundary = (b"--" + boundary, boundary) if boundary.startswith(b"--") else (b"--" + boundary,)
        self._at_headers = False
        self._rest = b""
        self._data = b""

    @classmethod
    def open(cls, url: str, open_timeout_s: float, read_timeout_s: float) -> HttpJpegs | None:
        """Connect, with the URL's user and password (basic or digest).  None for a stream of another kind.

        Raises OSError where nobody answers, or not with a stream.
        """
        parts = urllib.parse.urlsplit(url)
        plain = parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()
        passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
        if parts.username is not None:
            user, password = (urllib.parse.unquote(text or "") for text in (parts.username, parts.password))
            passwords.add_password(None, plain, user, password)
        opener = urllib.request.build_opener(
            _Handler(read_timeout_s),
            urllib.request.HTTPDigestAuthHandler(passwords),
            urllib.request.HTTPBasicAuthHandler(passwords),
        )
        try:
            answer = opener.open(plain, timeout=open_timeout_s)
        except _UNREADABLE as error:
            raise OSError(str(error)) from None
        if answer.headers.get_content_maintype() == "multipart" or answer.headers.get_content_type() in _JPEG_TYPES:
            return cls(answer)
        answer.close()
        return None

    def grab(self) -> bool:
        """Wait for the next JPEG.  False at the stream's end, and where nothing comes in time."""
        try:
            data = self._part() if self._multipart else self._next_of_many()
        except _UNREADABLE:
            return False
        if data is None:
            return False
        self._data = data
        return True

    def image(self) -> tuple[Image | None, str | None]:
        """The grabbed JPEG's pixels, H x W x 3 (BGR); or None and why there are none."""
        try:
            return jpeg_in_colour(self._data), None
        except PayloadError as error:
            return None, str(error)

    def release(self) -> None:
        self._answer.close()

    def _line(self) -> bytes:
        """The next line, or a piece of a long one.  Raises OSError at the stream's end."""
        line = self._answer.readline(_LONGEST_LINE)
        if not line:
            raise ConnectionError("the stream has ended")
        return line

    def _part(self) -> bytes | None:
        while not self._at_headers:
            self._at_headers = self._line().startswith(self._boundary)
        self._at_headers = False
        length = None
        for _ in range(_MOST_HEADERS):
            name, _, value = self._line().partition(b":")
            if not name.strip():
                break
            if name.strip().lower() == b"content-length":
                length = int(value)
        if length is None:
            return self._up_to_its_end()
        if not 0 <= length <= LARGEST_BYTES:
            raise ValueError(f"a part of {length} bytes")
        data = self._answer.read(length)
        return data if len(data) == length else None

    def _up_to_its_end(self) -> bytes:
        data = bytearray()
        while len(data) <= LARGEST_BYTES:
            line = self._line()
            if line.startswith(self._boundary) and (not data or data.endswith(b"\n")):
                self._at_headers = True
                return bytes(re.sub(rb"\r?\n\Z", b"", data))
            data += line
            # Else it would wait here until the next one comes.
            if b"\xff\xd9" in data[-len(line) - 1 :]:
                end, whole = jpeg_end(data)
                if whole:
                    return bytes(data[:end])
        raise ValueError(f"a part of more than {LARGEST_BYTES} bytes")

    def _next_of_many(self) -> bytes | None:
        """From one beginning to its end; or to the next beginning, if it breaks off before."""
        data = self._rest
        while len(data) <= LARGEST_BYTES:
            start = data.find(JPEG)
            if start >= 0:
                end, whole = jpeg_end(data, start)
                end = end if whole else data.find(JPEG, end)
                if end >= 0:
                    self._rest = data[end:]
                    return data[start:end]
            more = self._answer.read1(_CHUNK_BYTES)
            if not more:
                return None
            data += more
        raise ValueError(f"a JPEG of more than {LARGEST_BYTES} bytes")


class _Handler(urllib.request.HTTPHandler, urllib.request.HTTPSHandler):
    """Connections that may wait longer, or less long, for data than for being made."""

    def __init__(self, read_timeout_s: float) -> None:
        # Cameras have certificates of their own making, which no video library checks either.
        self._unverified = ssl._create_unverified_context()
        super().__init__(context=self._unverified)
        self._read_timeout_s = read_timeout_s

    def http_open(self, request: urllib.request.Request) -> Any:
        return self.do_open(_waiting(http.client.HTTPConnection, self._read_timeout_s), request)

    def https_open(self, request: urllib.request.Request) -> Any:
        secure = _waiting(http.client.HTTPSConnection, self._read_timeout_s)
        return self.do_open(secure, request, context=self._unverified)


def _waiting(base: Any, read_timeout_s: float) -> Any:
    class Connection(base):  # type: ignore[misc]
        def connect(self) -> None:
            super().connect()
            self.sock.settimeout(read_timeout_s)

    return Connection
