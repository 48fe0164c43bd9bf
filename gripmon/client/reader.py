"""A reader of everything that one monitor sends, which can also send it commands."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import msgspec
import zenoh

from gripmon.client.asking import Asker
from gripmon.client.network import Listener, MonitorName, monitor_name, named_as_arguments, reader_settings, where_of
from gripmon.io.wire import DEFAULT_ENDPOINT, Keys, open_session, zenoh_config
from gripmon.model.records import (
    CommandName,
    CommandReply,
    CommandRequest,
    FrameRecord,
    ReferenceRecord,
    StateRecord,
    from_json,
)

_T = TypeVar("_T", bound=msgspec.Struct)


class Client(Listener):
    """Reads one monitor's messages.  Not thread-safe, except for :meth:`close`.

    A slow reader never delays the monitor: the newest ``depth`` records are queued for it, older ones are dropped.
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
        """``camera`` may be omitted while the robot has only one; messages of a second one then raise LookupError.

        ``connect``: endpoints of the monitor or a router; ``zenoh_config_file``: a Zenoh configuration file instead.
        Raises ValueError for a name that can't be part of a key, and :class:`gripmon.io.wire.PublishError` for a bad
        configuration.
        """
        super().__init__()
        self.keys = Keys(robot, camera if camera is not None else "*")
        settings = reader_settings(connect, zenoh_config_file)
        with named_as_arguments():
            self._session = open_session(zenoh_config(settings), settings)
        self._depth = depth
        self._asker = Asker(self._session, where_of(settings))
        self._heard: MonitorName | None = None
        self._newest: FrameRecord | None = None
        self._samples = self._subscribe()

    def latest(self) -> FrameRecord | None:
        """The newest record, without waiting; the same one again until a newer one arrives; None before the first.

        It may be old: compare ``stamp_ns``, or call :meth:`alive`.  Raises
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
        """Call back with every record, in a separate thread, until the client is closed.

        An exception in the callback ends its thread and goes to ``threading.excepthook``.
        """
        self._call_back(callback, self._records(self._subscribe()))

    def state(self, timeout_s: float = 1.0) -> StateRecord | None:
        """The monitor's last state message; None if no monitor answers in time."""
        return self._get("state", StateRecord, timeout_s)

    def reference(self, timeout_s: float = 1.0) -> ReferenceRecord | None:
        """The reference from which drift is measured now; None if no monitor answers in time."""
        return self._get("reference", ReferenceRecord, timeout_s)

    def alive(self, timeout_s: float = 1.0) -> tuple[MonitorName, ...]:
        """The running monitors of this name, sorted; all on the network for ``Client("*")``."""
        return self._asker.alive(self.keys, timeout_s)

    def send(
        self,
        name: CommandName,
        argument: str = "",
        timeout_s: float = 5.0,
        *,
        request_id: str | None = None,
        monitor_id: str = "",
    ) -> CommandReply:
        """Send the monitor a command (:class:`gripmon.model.records.Command`) and wait for its reply.

        A refused command changes nothing.  ``request_id`` (at most 64 characters; by default a new one): that of an
        earlier attempt; if that was carried out, its reply is returned again.  ``monitor_id`` names one start of the
        monitor; without it only one may be running.  Raises :class:`gripmon.client.NotCarriedOut`;
        :class:`gripmon.client.Ambiguous` if several monitors have the name; ValueError for an invalid request.
        """
        new_id = uuid.uuid4().hex if request_id is None else request_id
        return self._asker.ask(self.keys, CommandRequest(argument, new_id, monitor_id), name, timeout_s)[0]

    def snapshot(self, timeout_s: float = 5.0, *, monitor_id: str = "") -> tuple[CommandReply, bytes | None]:
        """The monitor's state and newest frame, and its image as a file of the type ``reply.snapshot.image`` (None if
        there is none).  Raises as :meth:`send`.
        """
        request = CommandRequest("", uuid.uuid4().hex, monitor_id)
        return self._asker.ask(self.keys, request, CommandName.SNAPSHOT, timeout_s)

    def close(self) -> None:
        """Leave the network; iterators and callbacks end.

        It waits for a running callback, unless it is called from one.
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

    def _check_name(self, key: zenoh.KeyExpr) -> None:
        name = monitor_name(key)
        if self._heard is None:
            self._heard = name
        elif name != self._heard:
            raise LookupError(
                f"{self.keys.robot}/{self.keys.camera} is more than one monitor: {self._heard}, {name}; name the one"
            )
