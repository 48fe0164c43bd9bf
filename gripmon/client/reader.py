"""A reader of everything that one monitor sends, which also sends it commands."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import msgspec
import zenoh

from gripmon.client.network import (
    Listener,
    MonitorName,
    Start,
    monitor_name,
    named_as_arguments,
    reader_settings,
    start_of,
)
from gripmon.io.wire import DEFAULT_ENDPOINT, Keys, open_session, zenoh_config
from gripmon.model.records import (
    CommandError,
    CommandFault,
    CommandName,
    CommandReply,
    CommandRequest,
    FrameRecord,
    MessageRefused,
    ReferenceRecord,
    StateRecord,
    from_json,
    to_json,
)

_T = TypeVar("_T", bound=msgspec.Struct)


class NotCarriedOut(Exception):
    """A command got no answer of the monitor itself: none is there, or it had no time for it; ``fault`` says which.

    A refusal is not an exception but an answer: ``CommandReply.done`` is false.  Sent again with the same
    ``request_id`` it is not carried out twice.
    """

    def __init__(self, text: str, fault: CommandFault | None = None, request_id: str = "") -> None:
        super().__init__(text)
        self.fault, self.request_id = fault, request_id


class Ambiguous(LookupError):
    """More than one monitor could be meant; ``argument`` is the one that would say which."""

    def __init__(self, text: str, argument: str) -> None:
        super().__init__(text)
        self.argument = argument


class Client(Listener):
    """Reads one monitor's messages.  Not for several threads at once, except for :meth:`close`.

    A slow reader never holds up the monitor: the newest ``depth`` records wait for it, older ones are dropped.
    """

    def __init__(
        self,
        robot: str,
        camera: str | None = None,
        *,
        connect: str | Sequence[str] = (DEFAULT_ENDPOINT,),
        zenoh_config_file: str | None = None,
        depth: int = 16,
    ) -> None:
        """``camera`` may be left out while the robot has one; messages of a second one then raise LookupError.

        ``connect`` are the monitor's or a router's endpoints; ``zenoh_config_file`` is a file of Zenoh's instead.
        Raises ValueError for a name that can't be part of a key, and :class:`gripmon.io.wire.PublishError` for a bad
        configuration.
        """
        super().__init__()
        self.keys = Keys(robot, camera if camera is not None else "*")
        settings = reader_settings(connect, zenoh_config_file)
        with named_as_arguments():
            self._session = open_session(zenoh_config(settings), settings)
        self._depth = depth
        self._where = " or ".join(settings.connect) if zenoh_config_file is None else f"what {zenoh_config_file} names"
        self._heard: MonitorName | None = None
        self._newest: FrameRecord | None = None
        self._samples = self._subscribe()

    def latest(self) -> FrameRecord | None:
        """The newest record, at once; the same one again while no newer one came; None before the first.

        It may be old: compare ``stamp_ns``, or ask :meth:`alive`.  Raises
        :class:`gripmon.model.records.MessageRefused` for a message that is not a record or of an unknown version.
        """
        newest: zenoh.Sample | None = None
        while (sample := self._samples.try_recv()) is not None:
            newest = sample
        if newest is not None:
            self._newest = self._record(newest)
        return self._newest

    def __iter__(self) -> Iterator[FrameRecord]:
        """Every record as it comes, waiting for the next; ends when the client is closed."""
        return self._records(self._samples)

    def on_transform(self, callback: Callable[[FrameRecord], None]) -> None:
        """Call back with every record, in a thread of its own, until the client is closed.

        An exception in the callback ends its thread and goes to ``threading.excepthook``.
        """
        self._call_back(callback, self._records(self._subscribe()))

    def state(self, timeout_s: float = 1.0) -> StateRecord | None:
        """The monitor's last state message; None if no monitor answers in time."""
        return self._get("state", StateRecord, timeout_s)

    def reference(self, timeout_s: float = 1.0) -> ReferenceRecord | None:
        """The calibration that drift is measured against now; None if no monitor answers in time."""
        return self._get("reference", ReferenceRecord, timeout_s)

    def alive(self, timeout_s: float = 1.0) -> tuple[MonitorName, ...]:
        """The monitors of this name that run now, in order; all on the network for ``Client("*")``."""
        return tuple(sorted(map(monitor_name, self._tokens(self.keys["alive"], timeout_s))))

    def send(
        self,
        name: CommandName,
        argument: str = "",
        timeout_s: float = 5.0,
        *,
        request_id: str | None = None,
        monitor_id: str = "",
    ) -> CommandReply:
        """Tell the monitor something (:class:`gripmon.model.records.Command`) and wait for its answer.

        A refused command has changed nothing.  ``request_id`` (64 characters at most; by default a new one) is that of
        an earlier attempt: if it was carried out then, its answer comes again.  Raises :class:`NotCarriedOut`;
        :class:`Ambiguous` if the name is that of more than one monitor; ValueError for a request that can't be one.
        ``monitor_id`` names the start of the monitor that is meant; without it there must be one.
        """
        new_id = uuid.uuid4().hex if request_id is None else request_id
        return self._ask(CommandRequest(argument, new_id, monitor_id), name, timeout_s)[0]

    def snapshot(self, timeout_s: float = 5.0, *, monitor_id: str = "") -> tuple[CommandReply, bytes | None]:
        """The monitor's state and newest frame, and a file of its image, as ``reply.snapshot.image`` says; None if it
        has none.  Raises as :meth:`send`.
        """
        return self._ask(CommandRequest("", uuid.uuid4().hex, monitor_id), CommandName.SNAPSHOT, timeout_s)

    def close(self) -> None:
        """Leave the network; iterations and callbacks end.

        It waits for a callback that is at work, unless it is called in one.
        """
        self._session.close()
        super().close()

    def _subscribe(self) -> zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]:
        return self._session.declare_subscriber(self.keys["transform"], zenoh.handlers.RingChannel(self._depth))

    def _records(self, samples: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]) -> Iterator[FrameRecord]:
        for sample in samples:
            yield self._record(sample)

    def _record(self, sample: zenoh.Sample) -> FrameRecord:
        self._check_name(sample.key_expr)
        return from_json(sample.payload.to_bytes(), FrameRecord)

    def _get(self, leaf: str, record_type: type[_T], timeout_s: float) -> _T | None:
        answer: _T | None = None
        for reply in self._session.get(self.keys[leaf], timeout=timeout_s):
            if reply.ok is not None:
                self._check_name(reply.ok.key_expr)
                answer = from_json(reply.ok.payload.to_bytes(), record_type)
        return answer

    def _ask(self, request: CommandRequest, name: CommandName, timeout_s: float) -> tuple[CommandReply, bytes | None]:
        """The answer of the one monitor that is meant, and what is attached to it."""
        from_json(to_json(request), CommandRequest)  # what the monitor would refuse
        monitor = self._only_one(timeout_s)
        start = self._only_start(monitor, request.monitor_id)
        # From now on this start alone is meant, also where another one appears.
        payload = to_json(msgspec.structs.replace(request, monitor_id=start.monitor_id))
        another: zenoh.Reply | None = None
        for reply in self._session.get(
            Keys(*monitor)[f"cmd/{name.value}"], payload=payload, timeout=timeout_s, target=zenoh.QueryTarget.ALL
        ):
            if not _is_of_another(reply):
                return _answer(reply, monitor, request.id)
            another = reply
        if another is not None:
            return _answer(another, monitor, request.id)
        # A router's access rules drop without a word what they don't allow.
        raise NotCarriedOut(
            f"{monitor} doesn't answer; it may be told not to take commands (publish.commands), or the router's rules "
            "may not let you send any",
            None,
            request.id,
        )

    def _only_one(self, timeout_s: float) -> MonitorName:
        """The one monitor that is meant, as soon as it is seen."""
        end_s = time.monotonic() + timeout_s
        while not (alive := self.alive()):
            if time.monotonic() >= end_s:
                raise NotCarriedOut(f"no monitor {self.keys.robot}/{self.keys.camera} is seen; {self._in_its_place()}")
            time.sleep(0.02)
        if len(alive) > 1:
            names = ", ".join(map(str, alive))
            raise Ambiguous(
                f"{self.keys.robot}/{self.keys.camera} is more than one monitor: {names}; name the camera", "camera"
            )
        return alive[0]

    def _only_start(self, monitor: MonitorName, monitor_id: str) -> Start:
        """The one start of it that is meant; one without an id where none shows any."""
        starts = sorted(map(start_of, self._tokens(Keys(*monitor)["alive/*"])))
        names = ", ".join(start.monitor_id for start in starts)
        if monitor_id:
            if starts and Start(monitor, monitor_id) not in starts:
                raise NotCarriedOut(f"{monitor} is not {monitor_id}, but {names}")
            return Start(monitor, monitor_id)
        if len(starts) > 1:
            raise Ambiguous(
                f"{len(starts)} monitors are {monitor}: {names}; stop all but one, or name one", "monitor_id"
            )
        return starts[0] if starts else Start(monitor, "")

    def _in_its_place(self) -> str:
        """Who is there instead of the monitor that is meant."""
        if not any(True for _ in self._session.info.links()):
            return f"there is no connection to {self._where}"
        names = sorted(str(monitor_name(key)) for key in self._tokens(Keys("*", "*")["alive"]))
        return f"there are {', '.join(names)}" if names else f"none at all at {self._where}"

    def _tokens(self, key: str, timeout_s: float = 1.0) -> set[str]:
        """The liveliness tokens that are there."""
        replies = self._session.liveliness().get(key, timeout=timeout_s)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def _check_name(self, key: zenoh.KeyExpr) -> None:
        name = monitor_name(key)
        if self._heard is None:
            self._heard = name
        elif name != self._heard:
            raise LookupError(
                f"{self.keys.robot}/{self.keys.camera} is more than one monitor: {self._heard}, {name}; name the one"
            )


def _is_of_another(reply: zenoh.Reply) -> bool:
    """Is it a monitor's word that it isn't the one that is meant?"""
    if reply.err is None or reply.err.encoding != zenoh.Encoding.APPLICATION_JSON:
        return False
    try:
        return from_json(reply.err.payload.to_bytes(), CommandError).error is CommandFault.ANOTHER
    except MessageRefused:
        return False


def _answer(reply: zenoh.Reply, who: MonitorName, request_id: str) -> tuple[CommandReply, bytes | None]:
    """What a monitor replied, and what is attached to it.  Raises :class:`NotCarriedOut` for anything else."""
    try:
        if reply.ok is not None:
            attached = reply.ok.attachment
            answer = from_json(reply.ok.payload.to_bytes(), CommandReply)
            return answer, None if attached is None else attached.to_bytes()
        assert reply.err is not None
        if reply.err.encoding != zenoh.Encoding.APPLICATION_JSON:  # Zenoh's own word
            raise NotCarriedOut(f"{who} has not answered in time; it may still do it", CommandFault.TIMEOUT, request_id)
        error = from_json(reply.err.payload.to_bytes(), CommandError)
    except MessageRefused as refused:
        text = f"{who} has answered, but that can't be read: {refused}"
        raise NotCarriedOut(text, None, request_id) from None
    raise NotCarriedOut(f"{who}: {error.text}", error.error, request_id)
