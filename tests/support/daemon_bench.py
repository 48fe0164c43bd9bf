"""One daemon between stand-ins at its four seams."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from gripmon.daemon.running import run
from gripmon.daemon.watch import DaemonSettings
from gripmon.model.outputs import Output
from gripmon.model.records import (
    AlertKind,
    Cause,
    State,
)
from support.stand_ins import Listener, ScriptedMonitor, ScriptedSource

NEVER = 1000.0  # seconds that no test takes


class Bench:
    """One daemon between stand-ins."""

    def __init__(self, items: Iterable[object], monitor: ScriptedMonitor | None = None, **settings: object) -> None:
        self.source = ScriptedSource(items)
        self.monitor = monitor or ScriptedMonitor()
        self.network, self.recording = Listener("Zenoh"), Listener("recording")
        self.others: tuple[Output, ...] = ()
        self.settings = DaemonSettings(**{"state_period_s": NEVER, **settings})  # type: ignore[arg-type]

    def run(self, **more: object) -> int:
        return run(
            self.monitor, source=self.source, outputs=(self.network, *self.others), recorder=self.recording,
            settings=self.settings, robot="arm", camera="wrist", **more,  # type: ignore[arg-type]
        )  # fmt: skip

    @property
    def states(self) -> list[tuple[State, str]]:
        return [(state.state, state.message) for state in self.network.states]

    @property
    def alerts(self) -> list[tuple[AlertKind, Cause]]:
        return [(alert.kind, alert.cause) for alert in self.network.alerts]


def pause(seconds: float) -> Callable[[object], None]:
    return lambda _: time.sleep(seconds)
