"""Commands to a monitor and the selection of its reply, for :class:`TransformClient` and :class:`Fleet`."""

from __future__ import annotations

import time

import msgspec
import zenoh

from gripmon.client.network import Joined, MonitorName, NotCarriedOut, Start, monitor_name, start_of
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


class Ambiguous(LookupError):
    """Several monitors match; ``argument`` is the parameter that would select one."""

    def __init__(self, text: str, argument: str) -> None:
        super().__init__(text)
        self.argument = argument


def ask(
    client: Joined, keys: Keys, request: CommandRequest, name: CommandName, timeout_s: float
) -> tuple[CommandReply, bytes | None]:
    """The reply of the one matching monitor, and its attachment.

    Raises :class:`NotCarriedOut`, :class:`Ambiguous`, and ValueError for an invalid request.
    """
    from_json(to_json(request), CommandRequest)  # raises for what the monitor would refuse
    end_s = time.monotonic() + timeout_s
    session = client.session(timeout_s)
    monitor = _only_one(session, keys, end_s, client.where)
    start = _only_start(session, monitor, request.monitor_id)
    # From now on only this start is addressed, even if another one appears.
    payload = to_json(msgspec.structs.replace(request, monitor_id=start.monitor_id))
    another: zenoh.Reply | None = None
    for reply in session.get(
        Keys(*monitor)[f"cmd/{name.value}"], payload=payload, timeout=timeout_s, target=zenoh.QueryTarget.ALL
    ):
        if not _is_of_another(reply):
            return _answer(reply, monitor, request.id)
        another = reply
    if another is not None:
        return _answer(another, monitor, request.id)
    # A router's access rules silently drop what they don't allow.
    raise NotCarriedOut(
        f"{monitor} doesn't answer; it may be configured to take no commands (publish.commands), or the router's "
        "rules may not allow you to send any",
        None,
        request.id,
    )


def alive(session: zenoh.Session, keys: Keys, timeout_s: float = 1.0) -> tuple[MonitorName, ...]:
    """The running monitors of these names, sorted."""
    return tuple(sorted(map(monitor_name, _tokens(session, keys["alive"], timeout_s))))


def _only_one(session: zenoh.Session, keys: Keys, end_s: float, where: str) -> MonitorName:
    """The one matching monitor, as soon as it is seen."""
    while not (found := alive(session, keys)):
        if time.monotonic() >= end_s:
            raise NotCarriedOut(f"no monitor {keys.robot}/{keys.camera} is seen; {_in_its_place(session, where)}")
        time.sleep(0.02)
    if len(found) > 1:
        names = ", ".join(map(str, found))
        raise Ambiguous(f"{keys.robot}/{keys.camera} is more than one monitor: {names}; name the camera", "camera")
    return found[0]


def _only_start(session: zenoh.Session, monitor: MonitorName, monitor_id: str) -> Start:
    """Its one matching start; one without an id if no start shows any."""
    starts = sorted(map(start_of, _tokens(session, Keys(*monitor)["alive/*"])))
    names = ", ".join(start.monitor_id for start in starts)
    if monitor_id:
        if starts and Start(monitor, monitor_id) not in starts:
            raise NotCarriedOut(f"{monitor} is not {monitor_id}, but {names}")
        return Start(monitor, monitor_id)
    if len(starts) > 1:
        raise Ambiguous(f"{len(starts)} monitors are {monitor}: {names}; stop all but one, or name one", "monitor_id")
    return starts[0] if starts else Start(monitor, "")


def _in_its_place(session: zenoh.Session, where: str) -> str:
    """Which monitors are there instead, in words."""
    if not any(True for _ in session.info.links()):
        return f"there is no connection to {where}"
    names = ", ".join(map(str, alive(session, Keys("*", "*"))))
    return f"there are {names}" if names else f"none at all at {where}"


def _tokens(session: zenoh.Session, key: str, timeout_s: float = 1.0) -> set[str]:
    """The liveliness tokens that exist."""
    replies = session.liveliness().get(key, timeout=timeout_s)
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


def _is_of_another(reply: zenoh.Reply) -> bool:
    """Whether a monitor replied that it isn't the one addressed."""
    if reply.err is None or reply.err.encoding != zenoh.Encoding.APPLICATION_JSON:
        return False
    try:
        return from_json(reply.err.payload.to_bytes(), CommandError).error is CommandFault.ANOTHER
    except MessageRefused:
        return False


def _answer(reply: zenoh.Reply, who: MonitorName, request_id: str) -> tuple[CommandReply, bytes | None]:
    """A monitor's reply and its attachment.  Raises :class:`NotCarriedOut` for anything else."""
    try:
        if reply.ok is not None:
            attached = reply.ok.attachment
            answer = from_json(reply.ok.payload.to_bytes(), CommandReply)
            return answer, None if attached is None else attached.to_bytes()
        assert reply.err is not None
        if reply.err.encoding != zenoh.Encoding.APPLICATION_JSON:  # from Zenoh itself
            raise NotCarriedOut(f"{who} has not answered in time; it may still do it", CommandFault.TIMEOUT, request_id)
        error = from_json(reply.err.payload.to_bytes(), CommandError)
    except MessageRefused as refused:
        text = f"{who} has answered, but that can't be read: {refused}"
        raise NotCarriedOut(text, None, request_id) from None
    raise NotCarriedOut(f"{who}: {error.text}", error.error, request_id)
