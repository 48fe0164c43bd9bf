"""JPEGs over HTTP as bytes: from servers of several kinds, on loopback."""

from __future__ import annotations

import base64
import hashlib
import re
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest

from gripmon.io.sources import LiveCamera, LiveSettings
from gripmon.io.sources.http_jpegs import HttpJpegs
from gripmon.model.records import Frame

MULTIPART = "multipart/x-mixed-replace; boundary=frame"


def jpeg(grey: int, noise: float = 0.0) -> bytes:
    image = np.random.default_rng(grey).normal(grey, noise, (96, 128, 3)).clip(0, 255).astype(np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def part(data: bytes, *, length: int | None = -1, boundary: bytes = b"--frame") -> bytes:
    """``length``: -1 for the true one, None for none."""
    said = b"" if length is None else b"Content-Length: %d\r\n" % (len(data) if length == -1 else length)
    return boundary + b"\r\nContent-Type: image/jpeg\r\n" + said + b"\r\n" + data + b"\r\n"


Serve = Callable[..., str]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """A server of one answer; its URL.  ``allowed`` says of an Authorization header whether it will do."""
    running: list[ThreadingHTTPServer] = []

    def start(
        kind: str, body: bytes, allowed: Callable[[str], bool] = lambda _: True, challenge: str = "", user: str = ""
    ) -> str:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path == "/moved":
                    self.send_response(302)
                    self.send_header("Location", "/video")
                    self.end_headers()
                    return
                if not allowed(self.headers.get("Authorization", "")):
                    self.send_response(401)
                    self.send_header("WWW-Authenticate", challenge)
                    self.end_headers()
                    return
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        server.daemon_threads = True
        running.append(server)
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        return f"http://{user}127.0.0.1:{server.server_address[1]}/video"

    yield start
    for server in running:
        server.shutdown()
        server.server_close()


def greys(url: str) -> list[int | str]:
    """What comes: an image's mean grey level, or why there is none."""
    stream = HttpJpegs.open(url, 5.0, 5.0)
    assert stream is not None
    out: list[int | str] = []
    while stream.grab():
        image, fault = stream.image()
        out.append(round(float(image.mean())) if image is not None else str(fault))
    stream.release()
    return out


FAULT = "damaged JPEG file (truncated or damaged: a JPEG without its end); a whole one"


def test_a_truncated_jpeg_is_refused_and_the_next_one_is_good(serve: Serve):
    """Whether its length is stated rightly, or that of the whole, or not at all."""
    good, cut = jpeg(100), jpeg(50, noise=20.0)
    cut = cut[: len(cut) // 3]
    body = part(good) + part(cut) + part(good) + part(cut, length=None) + part(good)
    assert greys(serve(MULTIPART, body)) == [100, FAULT, 100, FAULT, 100]
    swallowed = greys(serve(MULTIPART, part(cut, length=len(cut) + 100) + part(good) + part(good)))
    assert swallowed[0] == FAULT and swallowed[-1] == 100


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        (MULTIPART, part(jpeg(90)) + part(jpeg(110))),
        (MULTIPART, part(jpeg(90), length=None) + part(jpeg(110), length=None)),
        ('multipart/x-mixed-replace; boundary="--frame"', part(jpeg(90)) + part(jpeg(110))),
        ('multipart/x-mixed-replace; boundary="--frame"', part(jpeg(90), boundary=b"----frame") + part(jpeg(110))),
        ("multipart/x-mixed-replace", part(jpeg(90)) + part(jpeg(110))),
        (
            "multipart/x-mixed-replace; boundary=----frame",
            part(jpeg(90), boundary=b"------frame") + part(jpeg(110), boundary=b"------frame"),
        ),
        (MULTIPART, b"preamble\r\n" + part(jpeg(90)).replace(b"\r\n", b"\n", 4) + part(jpeg(110)) + b"--frame--"),
        ("image/jpeg", jpeg(90) + jpeg(110)),
        ("video/x-motion-jpeg", b"junk" + jpeg(90) + b"padding" + jpeg(110)),
    ],
)
def test_streams_of_several_kinds(serve: Serve, kind: str, body: bytes):
    assert greys(serve(kind, body)) == [90, 110]


def test_of_jpegs_without_parts_a_truncated_one_ends_where_the_next_begins(serve: Serve):
    cut = jpeg(50, noise=20.0)
    assert greys(serve("image/jpeg", jpeg(90) + cut[: len(cut) // 2] + jpeg(110))) == [90, FAULT, 110]


@pytest.mark.parametrize("junk", [b"", b"\x89PNG\r\n\x1a\n", b"<html>"])
def test_what_is_no_jpeg_is_named(serve: Serve, junk: bytes):
    first, second = greys(serve(MULTIPART, part(junk) + part(jpeg(100))))
    assert "no JPEG file" in str(first) and second == 100


def test_another_kind_of_stream_is_left_to_the_video_library(serve: Serve):
    assert HttpJpegs.open(serve("video/mp2t", b"G" * 188), 5.0, 5.0) is None


def test_redirections_are_followed(serve: Serve):
    assert greys(serve(MULTIPART, part(jpeg(100))).replace("/video", "/moved")) == [100]


def test_user_and_password_in_the_url_are_used(serve: Serve):
    token = "Basic " + base64.b64encode(b"operator:s/E@t").decode()
    url = serve(MULTIPART, part(jpeg(100)), token.__eq__, 'Basic realm="camera"', "operator:s%2FE%40t@")
    assert greys(url) == [100]
    with pytest.raises(OSError, match="401"):
        HttpJpegs.open(url.replace("operator", "stranger"), 5.0, 5.0)


def test_a_password_may_be_asked_for_by_digest(serve: Serve):
    def md5(text: str) -> str:
        return hashlib.md5(text.encode()).hexdigest()

    def allowed(header: str) -> bool:
        """RFC 2617, without qop."""
        said = dict(re.findall(r'(\w+)="([^"]*)"', header))
        secret = md5("operator:camera:secret")
        return header.startswith("Digest ") and said["response"] == md5(f"{secret}:n1:{md5('GET:/video')}")

    url = serve(MULTIPART, part(jpeg(100)), allowed, 'Digest realm="camera", nonce="n1"', "operator:secret@")
    assert greys(url) == [100]


def test_a_bad_jpeg_is_a_frame_with_its_reason(serve: Serve):
    cut = jpeg(50, noise=20.0)
    camera = LiveCamera(LiveSettings(device=serve(MULTIPART, part(cut[: len(cut) // 2])), retry_first_s=0.05))
    try:
        while not isinstance(frame := camera.read(), Frame):
            assert frame is not None
        assert frame.image is None and frame.fault == FAULT and "127.0.0.1" in str(frame.name)
    finally:
        camera.close()
