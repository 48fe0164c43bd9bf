"""A session that may open later, with its waiting users; a router in this process; malformed messages."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Self, TypeVar

from gripmon.io.wire.session import (
    PublishSettings,
    ZenohFileError,
    endpoints,
    load_file,
    open_session,
    value_of,
    zenoh_config,
    zenohs_words,
)

if TYPE_CHECKING:
    import zenoh

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

_LOOK_EVERY_S = 1.0


class Link:
    """The process's session.

    It is open when the constructor returns, except for a client: its router may start later, so it is opened in a
    thread that retries with growing pauses.
    """

    def __init__(self, settings: PublishSettings, relative_to: Path = Path()) -> None:
        """``relative_to`` is the folder of the configuration file, to which a path in the settings is relative.

        Raises :class:`PublishError` for a configuration that can't work or an address that is already taken.
        """
        self.settings = settings
        self._lock = threading.RLock()  # guards what follows against the opening thread
        self._session: zenoh.Session | None = None
        self._declare: list[Callable[[zenoh.Session], None]] = []
        self._leave: list[Callable[[], None]] = []
        self._fault = ""
        self._closing = threading.Event()
        self._opener: threading.Thread | None = None
        self._next_look_s = 0.0
        config = zenoh_config(settings, relative_to)
        self._opening_s = 1e-3 * float(config.get_json("transport/unicast/open_timeout"))
        self._is_client = value_of(config, "mode") == "client"
        self._endpoints = endpoints(config, "connect")
        if self._is_client:
            self._fault = "no Zenoh session yet"
            self._opener = threading.Thread(
                target=self._open_until_it_works, args=(config,), name="zenoh-open", daemon=True
            )
            self._opener.start()
        else:
            self._session = open_session(config, settings)

    @property
    def connected(self) -> bool:
        """Whether there is a session; False only for a client that has not found its router yet."""
        return self._session is not None

    def fault(self) -> str:
        """Which connections are missing, in a few words for people; empty if none.

        It may be called at any rate: it checks once a second.  A client needs one connection, a peer one to each
        endpoint that it is to connect to.
        """
        session, now_s = self._session, time.monotonic()
        if session is not None and now_s >= self._next_look_s:
            self._next_look_s = now_s + _LOOK_EVERY_S
            self._look(session)
        return self._fault

    def unconnected(self) -> str:
        """The same, checked now: for the start, which waits for it."""
        self._next_look_s = 0.0
        return self.fault()

    def attach(self, declare: Callable[[zenoh.Session], None], leave: Callable[[], None] | None = None) -> None:
        """Call ``declare`` with the session: now, or in another thread when it opens; ``leave`` before it is closed.

        The first one attached is declared first and leaves last.
        """
        with self._lock:
            self._leave += [] if leave is None else [leave]
            if self._session is None:
                self._declare.append(declare)
            else:
                declare(self._session)

    def close(self) -> None:
        """Call all ``leave``, close the session and free its port.  Calling it twice does nothing more."""
        import zenoh

        self._closing.set()
        if self._opener is not None:
            # A process that ended with this thread inside Zenoh would be aborted by the interpreter.
            self._opener.join(timeout=self._opening_s + 1.0)
        with self._lock:
            session, self._session = self._session, None
            leave, self._leave = self._leave, []
            self._declare.clear()
        for last_word in reversed(leave):
            last_word()
        if session is not None:
            try:
                session.close()
            except zenoh.ZError as error:  # a stopped process blocks what is being sent
                _log.warning("the Zenoh session could not be closed in order: %s", zenohs_words(error))

    def _look(self, session: zenoh.Session) -> None:
        places = missing(session, self._endpoints, one_is_enough=self._is_client)
        fault = f"no connection to {places}, trying again" if places else ""
        if fault != self._fault:
            self._fault = fault
            _log.log(logging.WARNING if fault else logging.INFO, "Zenoh: %s", fault or "connected")

    def _adopt(self, session: zenoh.Session) -> bool:
        """Let all attached users declare; False if it came too late."""
        with self._lock:
            if self._closing.is_set():
                return False
            declare, self._declare = self._declare, []
            for each in declare:
                try:
                    each(session)
                except Exception as error:  # noqa: BLE001  one that can't be declared must not affect the others
                    _log.error("something could not be declared on the Zenoh session: %s", error)
            self._session, self._fault = session, ""
            self._next_look_s = time.monotonic() + _LOOK_EVERY_S
        return True

    def _open_until_it_works(self, config: zenoh.Config) -> None:
        import zenoh

        pause_s = self.settings.retry_first_s
        while not self._closing.is_set():
            try:
                session = zenoh.open(config)
            except zenoh.ZError as error:
                if (text := f"no Zenoh session yet, trying again: {zenohs_words(error)}") != self._fault:
                    _log.warning("%s", text)
                    self._fault = text
                self._closing.wait(pause_s)
                pause_s = min(2.0 * pause_s, self.settings.retry_longest_s)
                continue
            if self._adopt(session):
                _log.info("Zenoh session open")
            else:
                session.close()
            return


def in_zenohs_thread(take: Callable[[_T], None]) -> zenoh.handlers.Callback[_T]:
    """A callback in Zenoh's own threads: a Python thread would keep a process without ``close()`` from ending."""
    import zenoh

    return zenoh.handlers.Callback(take, indirect=False)


_LOCATOR = re.compile(r"(?P<protocol>[^/]+)/(?P<address>[^?#]*)")
_PORT = re.compile(r"(?P<host>.*):(?P<port>\d+)")
_NUMERIC = re.compile(r"[\d.]+|\[[0-9a-fA-F:.%]+\]")


def missing(session: zenoh.Session, endpoints: Iterable[str], *, one_is_enough: bool) -> str:
    """The endpoints to which the session has no link, in words; empty if none is missing.

    Takes some microseconds, without any network traffic.
    """
    far_ends = [link.dst for link in session.info.links()]
    if one_is_enough:
        return "" if far_ends else " or ".join(endpoints) or "a router"
    return ", ".join(endpoint for endpoint in endpoints if not any(is_at(far_end, endpoint) for far_end in far_ends))


def is_at(locator: str, endpoint: str) -> bool:
    """Whether a link's far end may be this endpoint.  A host's name isn't resolved: its port is enough."""
    far, named = _LOCATOR.match(locator), _LOCATOR.match(endpoint)
    if far is None or named is None or far["protocol"] != named["protocol"]:
        return False
    far_place, named_place = _PORT.fullmatch(far["address"]), _PORT.fullmatch(named["address"])
    if far_place is None or named_place is None:
        return far["address"] == named["address"]
    if far_place["port"] != named_place["port"]:
        return False
    return far_place["host"] == named_place["host"] or not _NUMERIC.fullmatch(named_place["host"])


class Router:
    """Routes from construction to :meth:`close`."""

    def __init__(self, path: Path) -> None:
        """``path``: a Zenoh configuration, json5 or yaml.  Raises :class:`ZenohFileError`."""
        import zenoh

        config = load_file(path, default_mode="router")
        if (mode := value_of(config, "mode")) != "router":
            raise ZenohFileError(f"{path}: mode: {mode} doesn't route; router")
        self.listens_on = endpoints(config, "listen")
        if not self.listens_on:
            raise ZenohFileError(f'{path}: listen.endpoints: there is none; e.g. ["tcp/127.0.0.1:7447"]')
        self._connects_to = endpoints(config, "connect")
        config.insert_json5("listen/exit_on_failure", "true")
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise ZenohFileError(f"{path}: can't route: {zenohs_words(error)}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def fault(self) -> str:
        """Which connections are missing, in a few words for people; empty if none."""
        places = missing(self._session, self._connects_to, one_is_enough=False)
        return f"no connection to {places}, trying again" if places else ""

    def close(self) -> None:
        """Leave the network and free the port."""
        self._session.close()


REMEMBERED_S = 60.0
"""Time after the last malformed payload during which it is reported; a later one is a new occasion (s)."""

CALM_S = 3.0
"""Time with only good payloads after which malformed ones are no longer reported (s)."""

_LONGEST_REASON = 200
_MOST_KINDS = 8  # of reasons; a sender may cause any number
_OTHERS = "any other"
FIGURES = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")


class Malformed:
    """Counts the payloads on a key that could not be used.

    An occasion ends when none has come for :data:`REMEMBERED_S`; :meth:`fault` is empty sooner, when only good ones
    have come for :data:`CALM_S`, and the count then starts again.  The log gets one line per occasion for each of the
    first few kinds of reasons, and the text of :meth:`fault`, with the most frequent reason, changes only when the
    count passes a power of ten, so that malformed payloads can't fill a log or load the network.  Thread-safe.
    """

    def __init__(self, what: str, key: str) -> None:
        """``what``: name of the payload, in the singular: ``frame``."""
        self._what, self._key = what, key
        self._lock = threading.Lock()
        self._count = self._here = 0
        self._reason = ""
        self._kinds: Counter[str] = Counter()  # reasons without figures, since the last calm
        self._examples: dict[str, str] = {}
        self._logged: set[str] = set()  # kinds logged on this occasion
        self._last_s = self._good_s = 0.0

    @property
    def count(self) -> int:
        """Number of malformed payloads so far."""
        return self._count

    def add(self, reason: str) -> None:
        """Count a malformed payload; ``reason`` may contain data from the sender."""
        now_s = time.monotonic()
        with self._lock:
            if now_s - self._last_s > REMEMBERED_S:
                self._logged.clear()
                self._examples.clear()
            if self._is_over(now_s):
                self._here, self._kinds = 0, Counter()
            kind = self._kind(reason)
            before = _roughly(self._here)
            self._count += 1
            self._here += 1
            self._kinds[kind] += 1
            self._last_s = now_s
            if _roughly(self._here) != before:
                self._reason = self._examples[self._kinds.most_common(1)[0][0]]
            is_new = kind not in self._logged
            self._logged.add(kind)
            message = f"malformed {self._what} on {self._key}: {_for_people(reason)}"
        if is_new:
            _log.warning("%s (logged once)", message)

    def _kind(self, reason: str) -> str:
        """The kind of a reason: its text without figures, or "any other" if there are too many kinds."""
        text = _for_people(reason)
        kind = FIGURES.sub("", text)
        if kind not in self._examples and len(self._examples) >= _MOST_KINDS:
            kind = _OTHERS
        self._examples.setdefault(kind, text)
        return kind

    def _is_over(self, now_s: float) -> bool:
        return now_s - self._last_s > REMEMBERED_S or self._good_s - self._last_s > CALM_S

    def good(self) -> None:
        """Note a good payload."""
        self._good_s = time.monotonic()

    def fault(self) -> str:
        """The rough number since the last calm, and the most frequent reason, for people; empty if it is over."""
        with self._lock:
            if self._here == 0 or self._is_over(time.monotonic()):
                return ""
            several = "s" * (self._here > 1)
            return f"{_roughly(self._here)} malformed {self._what}{several} on {self._key}: {self._reason}"


def _roughly(count: int) -> str:
    if count < 10:
        return "1" if count == 1 else "some"
    return f"over {10 ** (len(str(count)) - 1):,}"


def _for_people(reason: str) -> str:
    """One line of bounded length, without control characters for a terminal."""
    line = " ".join(reason[: 2 * _LONGEST_REASON].split())
    return "".join(c if c.isprintable() else "?" for c in line[:_LONGEST_REASON])
