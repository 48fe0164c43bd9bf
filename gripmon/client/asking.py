"""Commands to a monitor, and the one answer that counts: for a client of one monitor, and for one of all."""

from __future__ import annotations

import time

import msgspec
import zenoh

from gripmon.client.network import MonitorName, Start, monitor_name, start_of
from gripmon.io.wire import Keys
from gripmon.model.records import (
    CommandError,
    CommandFault,
    CommandName,
    CommandReply,
    CommandRequest,
    MessageRefused,
    from_json,
    to_json,
)


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


class Asker:
    """Asks on a session that someone else opens and closes.  Any thread may."""

    def __init__(self, session: zenoh.Session, where: str) -> None:
        """``where``: whom the session connects to, for a person."""
        self._session, self._where = session, where

    def ask(
        self, keys: Keys, request: CommandRequest, name: CommandName, timeout_s: float
    ) -> tuple[CommandReply, bytes | None]:
        """The answer of the one monitor that is meant, and what is attached to it.

        Raises :class:`NotCarriedOut`, :class:`Ambiguous`, and ValueError for a request that can't be one.
        """
        from_json(to_json(request), CommandRequest)  # what the monitor would refuse
        monitor = self._only_one(keys, timeout_s)
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

    def alive(self, keys: Keys, timeout_s: float = 1.0) -> tuple[MonitorName, ...]:
        """The monitors of these names that run now, in order."""
        return tuple(sorted(map(monitor_name, self._tokens(keys["alive"], timeout_s))))

    def _only_one(self, keys: Keys, timeout_s: float) -> MonitorName:
        """The one monitor that is meant, as soon as it is seen."""
        end_s = time.monotonic() + timeout_s
        while not (alive := self.alive(keys)):
            if time.monotonic() >= end_s:
                raise NotCarriedOut(f"no monitor {keys.robot}/{keys.camera} is seen; {self._in_its_place()}")
            time.sleep(0.02)
        if len(alive) > 1:
            names = ", ".join(map(str, alive))
            raise Ambiguous(f"{keys.robot}/{keys.camera} is more than one monitor: {names}; name the camera", "camera")
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
