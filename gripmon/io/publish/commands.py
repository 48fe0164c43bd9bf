"""Commands from the network: Zenoh's thread receives them, the monitor's loop executes them between two frames."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future

import msgspec
import zenoh

from gripmon.io.publish.presence import Answers, Presence, in_words, send_now
from gripmon.io.wire import Keys, Link, in_zenohs_thread
from gripmon.io.wire.malformed import Malformed
from gripmon.model.records import (
    Command,
    CommandError,
    CommandFault,
    CommandName,
    CommandReply,
    CommandRequest,
    MessageRefused,
    from_json,
    largest_bytes,
    to_json,
)

_log = logging.getLogger(__name__)

TIMEOUT_S = 2.0
"""Time that the loop has for a command, s; after it the sender gets an error reply."""

WAITING_MOST = 16
_REMEMBERED_MOST = 256
_QUESTIONS = (CommandName.STATE, CommandName.SNAPSHOT)
"""Commands that change nothing and have large answers: repeated requests are executed again, not cached."""

_STOPPING = CommandError(CommandFault.STOPPING, "the monitor stops; the command is not carried out")


Tell = Callable[[CommandReply | CommandError, bytes | None], None]
"""Takes an answer and its attachment to who asked, once."""


class PendingCommand:
    """A command, and those that wait for its answer; several may, of one sender that repeats it under the same id.

    It is executed at most once.  Each of them is told once: the answer, or an error after ``timeout_s``.
    """

    def __init__(self, command: Command, timeout_s: float) -> None:
        self.command, self._timeout_s = command, timeout_s
        self._answered: Future[tuple[CommandReply | CommandError, bytes | None]] = Future()
        self._lock = threading.Lock()  # guards the number against the end of the last one's time
        self.askers = 0

    def wait(self, tell: Tell) -> bool:
        """Have the answer told; False if the command was given up without execution."""
        told = threading.Lock()  # by the first who takes it

        def answered(future: Future[tuple[CommandReply | CommandError, bytes | None]]) -> None:
            if not future.cancelled() and told.acquire(blocking=False):
                timer.cancel()
                with self._lock:
                    self.askers -= 1
                tell(*future.result())

        def time_is_over() -> None:
            if told.acquire(blocking=False):
                with self._lock:
                    self.askers -= 1
                    given_up = self.askers == 0 and self._answered.cancel()
                became = "it is not carried out" if given_up else "it may still be carried out, ask for the state"
                text = f"the monitor has not answered within {self._timeout_s:g} s; {became}"
                tell(CommandError(CommandFault.TIMEOUT, text), None)

        with self._lock:
            if self._answered.cancelled():
                return False
            self.askers += 1
        timer = threading.Timer(self._timeout_s, time_is_over)
        timer.daemon = True
        timer.start()
        self._answered.add_done_callback(answered)
        return True

    def take(self) -> bool:
        """Claim the command for execution by the loop; False if nobody waits for it any more."""
        return self._answered.set_running_or_notify_cancel()

    def answer(self, answer: CommandReply | CommandError, attachment: bytes | None = None) -> None:
        """Tell those who wait, and later repeats; immediate, but with an attachment it may take seconds."""
        self._answered.set_result((answer, attachment))


class CommandQueue:
    """Commands that wait for the loop, at most :data:`WAITING_MOST`."""

    def __init__(self) -> None:
        self._waiting: deque[PendingCommand] = deque()
        self._lock = threading.Lock()  # one that comes while it is being closed is refused, or answered
        self._closed = False

    def put(self, pending: PendingCommand, tell: Tell) -> CommandError | None:
        """Add a command whose answer is told, or return why not."""
        with self._lock:
            if self._closed:
                return _STOPPING
            if len(self._waiting) >= WAITING_MOST:
                return CommandError(CommandFault.BUSY, f"{WAITING_MOST} commands wait already; try again later")
            pending.wait(tell)
            self._waiting.append(pending)
        return None

    def poll(self) -> PendingCommand | None:
        """The next command to execute and answer, without waiting; None if there is none."""
        while self._waiting:
            pending = self._waiting.popleft()
            if pending.take():
                return pending
        return None

    def close(self) -> None:
        """Tell all who wait, and all who come, that the monitor is stopping."""
        with self._lock:
            self._closed = True
        while (pending := self.poll()) is not None:
            pending.answer(_STOPPING)


class ZenohCommands:
    """The queryable ``gripmon/<robot>/<camera>/cmd/<name>``; its payload is a :class:`CommandRequest` or empty.

    It replies with a :class:`~gripmon.model.records.CommandReply` as JSON, or with a
    :class:`~gripmon.model.records.CommandError` as an error.
    A command is executed only once per id: the last 256 answers are kept.
    """

    def __init__(
        self, link: Link, keys: Keys, presence: Presence | None = None, *, timeout_s: float = TIMEOUT_S
    ) -> None:
        self._keys, self._presence = keys, presence
        self._malformed = Malformed("command", keys["cmd"])
        self._timeout_s = timeout_s
        self._queue = CommandQueue()
        self.poll = self._queue.poll
        self._lock = threading.Lock()  # guards the commands by id
        self._known: OrderedDict[str, PendingCommand] = OrderedDict()
        self._queryable: zenoh.Queryable[None] | None = None
        flooded = CommandError(CommandFault.BUSY, "too many requests wait already; try again later")
        self._answers = Answers("commands", _reply("", flooded, self._monitor_id))
        link.attach(self._attach, self.close)

    @property
    def malformed(self) -> int:
        """Number of requests so far with a malformed payload."""
        return self._malformed.count

    def close(self) -> None:
        """Tell the waiting queries that the monitor is stopping."""
        self._queue.close()
        self._answers.close()

    def _attach(self, session: zenoh.Session) -> None:
        answer = in_zenohs_thread(self._receive)
        self._queryable = session.declare_queryable(self._keys["cmd/*"], answer, complete=True)

    def _receive(self, query: zenoh.Query) -> None:
        # Zenoh swallows an exception here and the client would get an empty result: always send an error reply.
        key = str(query.key_expr)
        try:
            error = self._ask(query, key)
        except Exception as fault:  # noqa: BLE001  see above
            _log.debug("command on %s", key, exc_info=fault)
            error = CommandError(CommandFault.INTERNAL, f"{type(fault).__name__}: {fault}")
        if error is not None:
            self._answers.send(query, _reply(key, error, self._monitor_id))

    def _ask(self, query: zenoh.Query, key: str) -> CommandError | None:
        """Queue the command for the loop; returns an error if it can't be queued."""
        name = _name(self._keys, key)
        if isinstance(name, CommandError):
            return name
        request = _request(query.payload)
        if isinstance(request, CommandError):
            self._malformed.add(request.text)
            return request
        if wrong := self._meant_for_another(request):
            return wrong

        def tell(answer: CommandReply | CommandError, attachment: bytes | None) -> None:
            reply = _reply(key, answer, self._monitor_id, attachment)
            if attachment is None:
                self._answers.send(query, reply)
            else:  # large: its producer has a thread for sending, and makes no other answer meanwhile
                send_now(query, reply)

        command = Command(name, request.argument)
        with self._lock:
            known = self._known.get(request.id)
            if known is not None and known.command != command:
                text = f"the id {request.id} was that of another command, {known.command.name}; a new id for a new one"
                return CommandError(CommandFault.ID_REUSED, text)
            if known is not None and known.askers >= WAITING_MOST:  # each occupies a thread until its timeout
                return CommandError(CommandFault.BUSY, f"{WAITING_MOST} wait for this answer already; try again later")
            if known is not None and known.wait(tell):
                return None
            pending = PendingCommand(command, self._timeout_s)
            error = self._queue.put(pending, tell)
            if error is None:
                self._remember(request.id, pending)
            return error

    @property
    def _monitor_id(self) -> str:
        return "" if self._presence is None else self._presence.monitor_id

    def _meant_for_another(self, request: CommandRequest) -> CommandError | None:
        """An error unless the command names our id, or names none and no other monitor has our name."""
        if request.monitor_id and request.monitor_id != self._monitor_id:
            text = f"this is the monitor {self._monitor_id or 'without id'}, and {request.monitor_id} is meant"
            return CommandError(CommandFault.ANOTHER, text)
        others = () if self._presence is None or request.monitor_id else self._presence.others()
        if not others:
            return None
        text = f"{in_words(others)} beside {self._monitor_id}; name the one that is meant in monitor_id"
        return CommandError(CommandFault.SEVERAL, text)

    def _remember(self, request_id: str, pending: PendingCommand) -> None:
        if request_id and pending.command.name not in _QUESTIONS:
            self._known[request_id] = pending
            self._known.move_to_end(request_id)
            if len(self._known) > _REMEMBERED_MOST:
                self._known.popitem(last=False)


def _name(keys: Keys, key: str) -> CommandName | CommandError:
    """The command that a key names, or what is wrong with the key."""
    name = key.rpartition("/")[2]
    if "*" in key or key != keys[f"cmd/{name}"]:
        # A command that changes a calibration must name its monitor: a pattern may match more monitors than intended.
        text = f"{key} is a pattern; name the monitor: {keys['cmd/<name>']}"
        return CommandError(CommandFault.SEVERAL, text)
    try:
        return CommandName(name)
    except ValueError:
        text = f"there is no command {name}; one of {', '.join(CommandName)}"
        return CommandError(CommandFault.UNKNOWN, text)


def _request(payload: zenoh.ZBytes | None) -> CommandRequest | CommandError:
    """The decoded payload, or what is wrong with it."""
    try:
        if payload is None or not len(payload):
            return CommandRequest()
        if len(payload) > (most := largest_bytes(CommandRequest)):  # checked before copying it
            raise MessageRefused(f"{len(payload)} bytes; at most {most}")
        return from_json(payload.to_bytes(), CommandRequest)
    except MessageRefused as error:
        text = f'{error}; a payload is {{"id": "…", "argument": "…"}}, both may be left out'
        return CommandError(CommandFault.MALFORMED, text)


def _reply(
    key: str, answer: CommandReply | CommandError, monitor_id: str, attachment: bytes | None = None
) -> Callable[[zenoh.Query], None]:
    """A function that sends an answer to a query, with the id of the answering monitor."""

    def send(query: zenoh.Query) -> None:
        payload = to_json(msgspec.structs.replace(answer, monitor_id=monitor_id))
        if isinstance(answer, CommandReply):
            query.reply(key, payload, encoding=zenoh.Encoding.APPLICATION_JSON, attachment=attachment)
        else:
            query.reply_err(payload, encoding=zenoh.Encoding.APPLICATION_JSON)

    return send
