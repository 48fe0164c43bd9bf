"""A network link that carries only so much: a relay on loopback, with the buffers that any machine on the way has."""

from __future__ import annotations

import contextlib
import socket
import threading
import time

_CHUNK_BYTES = 4096


class SlowLink:
    """What connects to ``endpoint`` is connected to another one; bytes towards it come no faster than
    ``bytes_per_s`` (None: at once).
    """

    def __init__(self, target: str) -> None:
        self.bytes_per_s: float | None = None
        self._target = _address(target)
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        self._open: list[socket.socket] = [self._server]
        self._start(self._accept)

    def close(self) -> None:
        """Cut everything."""
        for each in self._open:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                near, _ = self._server.accept()
                far = socket.create_connection(self._target)
                self._open += [near, far]
                self._start(self._pump, near, far, False)
                self._start(self._pump, far, near, True)

    def _pump(self, source: socket.socket, sink: socket.socket, slow: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(_CHUNK_BYTES):
                sink.sendall(data)
                if slow and (rate := self.bytes_per_s) is not None:
                    time.sleep(len(data) / rate)
        for each in (source, sink):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def _start(self, work: object, *arguments: object) -> None:
        threading.Thread(target=work, args=arguments, daemon=True).start()  # type: ignore[arg-type]


def _address(endpoint: str) -> tuple[str, int]:
    host, _, port = endpoint.rpartition("/")[2].rpartition(":")
    return host, int(port)
