"""Commands from the network: Zenoh's thread takes them in, the monitor's loop carries them out between two frames."""

from __future__ import annotations

import logging
import threading
from collections import deque

import zenoh

from gripmon.records import (
    Command,
    CommandError,
    CommandFault,
    CommandName,
    CommandReply,
    CommandRequest,
    MessageRefused,
    from_json,
    to_json,
)
from gripmon.wire import Keys, Link

_log = logging.getLogger(__name__)

_WAITING_MOST = 16
TIMEOUT_S = 2.0
"""So long the loop has for a command; then the asker is told that it has not answered."""


class PendingCommand:
    """A command whose asker waits.  It is answered once: by the loop, or when its time is over."""

    def __init__(self, command: Command, query: zenoh.Query, key: str, timeout_s: float) -> None:
        self.command = command
        self._query: zenoh.Query | None = query  # None once it is answered: Zenoh then ends the asker's waiting
        self._key = key
        self._timeout_s = timeout_s
        self._taken = False
        self._lock = threading.Lock()
        self._timer = threading.Timer(timeout_s, self._time_is_over)
        self._timer.daemon = True
        self._timer.start()

    def take(self) -> bool:
        """The loop is about to carry it out; False if its asker was told that it won't be."""
        with self._lock:
            self._taken = self._query is not None
            return self._taken

    def answer(self, answer: CommandReply | CommandError) -> None:
        """Tell the asker; nothing happens if it was told something already."""
        self._timer.cancel()
        with self._lock:
            query, self._query = self._query, None
        if query is not None:
            _reply(query, self._key, answer)

    def _time_is_over(self) -> None:
        with self._lock:
            became = "it may still be carried out, ask for the state" if self._taken else "it is not carried out"
            query, self._query = self._query, None
        if query is not None:
            text = f"the monitor has not answered within {self._timeout_s:g} s; {became}"
            _reply(query, self._key, CommandError(CommandFault.TIMEOUT, text))


class ZenohCommands:
    """The queryable ``gripmon/<robot>/<camera>/cmd/<name>``: payload ``{"argument": "…"}`` or none.

    It replies a :class:`gripmon.records.CommandReply` as JSON, or as an error a :class:`gripmon.records.CommandError`.
    """

    def __init__(self, link: Link, keys: Keys, *, timeout_s: float = TIMEOUT_S) -> None:
        self._keys = keys
        self._timeout_s = timeout_s
        self._waiting: deque[PendingCommand] = deque()
        self._queryable: zenoh.Queryable[None] | None = None
        self._closed = False
        link.attach(self._attach, self.close)

    def poll(self) -> PendingCommand | None:
        """The next command to carry out and answer, at once; None if there is none."""
        while self._waiting:
            pending = self._waiting.popleft()
            if pending.take():
                return pending
        return None

    def close(self) -> None:
        """Tell those who still wait that the monitor stops."""
        self._closed = True
        while (pending := self.poll()) is not None:
            pending.answer(CommandError(CommandFault.STOPPING, "the monitor stops; the command is not carried out"))

    def _attach(self, session: zenoh.Session) -> None:
        # In Zenoh's own thread: one of Python's would keep a process that forgot close() from ending.
        answer = zenoh.handlers.Callback(self._receive, indirect=False)
        self._queryable = session.declare_queryable(self._keys["cmd/*"], answer, complete=True)

    def _receive(self, query: zenoh.Query) -> None:
        # Zenoh swallows an exception here and the asker would see an empty result: always answer in words.
        key = str(query.key_expr)
        try:
            self._queue(query, key)
        except Exception as error:  # noqa: BLE001  as just said
            _log.debug("command on %s", key, exc_info=error)
            _reply(query, key, CommandError(CommandFault.INTERNAL, f"{type(error).__name__}: {error}"))

    def _queue(self, query: zenoh.Query, key: str) -> None:
        asked = _command(self._keys, key, query.payload)
        if isinstance(asked, Command):
            if self._closed:
                asked = CommandError(CommandFault.STOPPING, "the monitor stops; the command is not carried out")
            elif len(self._waiting) >= _WAITING_MOST:
                asked = CommandError(CommandFault.BUSY, f"{_WAITING_MOST} commands wait already; try again later")
            else:
                self._waiting.append(PendingCommand(asked, query, key, self._timeout_s))
                return
        _reply(query, key, asked)


def _command(keys: Keys, key: str, payload: zenoh.ZBytes | None) -> Command | CommandError:
    """What is asked for, or what is wrong with it."""
    name = key.rpartition("/")[2]
    if "*" in key or key != keys[f"cmd/{name}"]:
        # What changes a calibration must name it: a pattern may reach more monitors than was thought of.
        text = f"{key} is a pattern; name the monitor: {keys['cmd/<name>']}"
        return CommandError(CommandFault.SEVERAL, text)
    try:
        known = CommandName(name)
    except ValueError:
        text = f"there is no command {name}; one of {', '.join(CommandName)}"
        return CommandError(CommandFault.UNKNOWN, text)
    data = b"" if payload is None else payload.to_bytes()
    try:
        request = from_json(data, CommandRequest) if data else CommandRequest()
    except MessageRefused as error:
        return CommandError(CommandFault.MALFORMED, f'{error}; a payload is {{"argument": "…"}}, or none')
    return Command(known, request.argument)


def _reply(query: zenoh.Query, key: str, answer: CommandReply | CommandError) -> None:
    try:
        if isinstance(answer, CommandReply):
            query.reply(key, to_json(answer), encoding=zenoh.Encoding.APPLICATION_JSON)
        else:
            query.reply_err(to_json(answer), encoding=zenoh.Encoding.APPLICATION_JSON)
    except zenoh.ZError as error:  # the asker, or the session, is gone
        _log.debug("no answer on %s: %s", key, error)
    finally:
        query.drop()
