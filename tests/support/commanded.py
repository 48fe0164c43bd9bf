"""A stand-in for the daemon's loop that takes commands, and a plain asker."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable

import zenoh

from gripmon.io.publish.commands import ZenohCommands
from gripmon.model.records import Command, CommandReply

CMD = "gripmon/arm/wrist/cmd"


def reply_to(command: Command) -> CommandReply:
    return CommandReply(command.name, command.argument != "no", f"heard {command.argument!r}", "plate-2", 7)


class Loop:
    """Takes commands as the daemon's loop does; ``None`` as answer: never answers."""

    def __init__(self, commands: ZenohCommands, answer: Callable[[Command], CommandReply | None]) -> None:
        self.commands, self._answer = commands, answer
        self.heard: list[Command] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.002):
            pending = self.commands.poll()
            if pending is not None:
                self.heard.append(pending.command)
                answer = self._answer(pending.command)
                if answer is not None:
                    pending.answer(answer)

    def end(self) -> None:
        self._stop.set()
        self._thread.join()


def answers(session: zenoh.Session, key: str, payload: bytes | None = None) -> list[tuple[bool, dict[str, object]]]:
    """All answers, each with whether it is a reply or an error."""
    got = []
    for reply in session.get(key, payload=payload, timeout=20.0, target=zenoh.QueryTarget.ALL):
        content = reply.ok if reply.ok is not None else reply.err
        assert content is not None
        if content.encoding == zenoh.Encoding.TEXT_PLAIN:  # another queryable that matches, without a value yet
            continue
        assert content.encoding == zenoh.Encoding.APPLICATION_JSON
        got.append((reply.ok is not None, json.loads(content.payload.to_bytes())))
    return got
