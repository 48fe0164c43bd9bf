"""The HTTP server that Prometheus asks."""

from __future__ import annotations

import errno
import importlib.util
import logging
import socket
import threading
from socketserver import ThreadingMixIn
from typing import cast
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from gripmon.io.metrics.settings import MetricsSettings
from gripmon.io.metrics.tally import Tally
from gripmon.model.errors import InputError

_POLL_S = 0.1  # how long a stop waits for the server at most

_log = logging.getLogger(__name__)


class MetricsError(InputError):
    """Metrics can't be served as configured: ``key: what is wrong; what would be right``."""


def package_fault(settings: MetricsSettings) -> tuple[str, str, str] | None:
    """Key, what is wrong and what would be right, where the package is missing that the settings ask for."""
    if not settings.enabled or importlib.util.find_spec("prometheus_client") is not None:
        return None
    right = "pip install -e '.[metrics]' in gripmon's checkout, or enabled: false"
    return "metrics.enabled", "is true, but the package prometheus-client is missing", right


class MetricsServer(Tally):
    """Counts what it is given as a publisher, and tells whoever asks at ``/metrics``."""

    def __init__(self, settings: MetricsSettings, robot: str, camera: str) -> None:
        """Listens at once, in a thread of its own.  Raises :class:`MetricsError`."""
        super().__init__()
        if (fault := package_fault(settings)) is not None:
            raise MetricsError("{}: {}; {}".format(*fault))
        from prometheus_client import CollectorRegistry, ProcessCollector, make_wsgi_app

        from gripmon.io.metrics.families import Families

        registry = CollectorRegistry(auto_describe=False)
        registry.register(Families(self, robot, camera))
        ProcessCollector(registry=registry)
        try:
            self._server = _listen(settings.address, settings.port)
        except (OSError, UnicodeError) as error:  # UnicodeError: a host name that can't be one
            where = f"{settings.address}:{settings.port}"
            key, right = _remedy(error)
            reason = getattr(error, "strerror", None) or error
            raise MetricsError(f"metrics.{key}: can't listen at {where} ({reason}); {right}") from None
        self._server.set_app(make_wsgi_app(registry))
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_POLL_S,), name="gripmon-metrics", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop listening.  Calling it twice does nothing more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingMixIn, WSGIServer):
    """A thread for each question: who asks and doesn't listen holds up nobody."""

    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        _log.debug("metrics for %s", client_address, exc_info=True)  # they hung up; a traceback on stderr otherwise


class _Handler(WSGIRequestHandler):
    timeout = 10.0  # s, for somebody who connects and asks nothing

    def log_message(self, format: str, *values: object) -> None:
        """Not a line for each question."""

    def address_string(self) -> str:
        return str(self.client_address[0])


def _listen(address: str, port: int) -> _Server:
    """OSError, or UnicodeError for what can't be a name, where that isn't possible."""
    family, *_, where = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    bound = type("_Bound", (_Server,), {"address_family": family})
    return cast(_Server, bound(where[:2], _Handler))


def _remedy(error: Exception) -> tuple[str, str]:
    if getattr(error, "errno", None) == errno.EADDRINUSE:
        return "port", "a port that no other program has, one for each monitor"
    if getattr(error, "errno", None) == errno.EACCES:
        return "port", "a port from 1024 on"
    return "address", "an address of this machine, 127.0.0.1 for itself alone"
