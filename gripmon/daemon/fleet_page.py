"""All monitors on the network as a web page: condition and view of each, and commands for an operator."""

from __future__ import annotations

import threading
import time
import urllib.parse
from collections import Counter
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gripmon.client import Ambiguous, Condition, Fleet, MonitorName, MonitorStatus, NotCarriedOut, trouble
from gripmon.daemon.mount import MountView, view_of
from gripmon.daemon.overlay import picture_of
from gripmon.model.records import CommandName, CommandReply, StandingAlert
from gripmon.teach.messages import BadRequest, Request
from gripmon.teach.page_server import Action, Served, web_files

CARDS_MOST = 60
"""Monitors shown at a time, the worst ones: as many as a person can look through.  *Find* shows others."""
PICTURE_PX = 640
"""Columns of a picture: as wide as a card on a large screen."""
# A picture is reused: the page asks every 10 s, or twice a second while somebody moves the camera, and several pages
# must not load a monitor more than one.
_KEPT_S, _KEPT_MOVING_S = 8.0, 0.4
_PICTURES_KEPT = 4 * CARDS_MOST
_AT_ONCE = 4  # concurrent snapshots, a PNG of some megabytes each
_ANSWER_S = 5.0
_LONGEST_TEXT = 300  # characters of a monitor's text, which may be up to a megabyte from the network
_ALERTS_SHOWN = 8

Text = Annotated[str, Meta(max_length=1000)]


class Order(Request, frozen=True):
    """An operator's command for the monitor as shown on the page: for this start and this revision."""

    robot: Text
    camera: Text
    monitor_id: Text
    name: Literal["accept", "reject", "undo", "acknowledge"]
    argument: Text = ""
    revision: int = -1


class CommandOutcome(msgspec.Struct, frozen=True):
    """The monitor's own reply; ``done`` is false if it refused and changed nothing."""

    done: bool
    text: str


class Card(msgspec.Struct, frozen=True, kw_only=True):
    """One monitor: lengths in metres, times in seconds; None: unknown.  ``more_alerts``: how many are not listed."""

    robot: str
    camera: str
    monitor_id: str
    condition: Condition
    gone_since_ns: int | None
    heard_s: float
    state: str = ""
    message: str = ""
    drift_m: float | None = None
    sigma_m: float | None = None
    protection_m: float | None = None
    alert_limit_m: float | None = None
    frames_per_s: float | None = None
    reference_id: str = ""
    revision: int = -1
    proposal_id: str = ""
    alerts: tuple[StandingAlert, ...] = ()
    more_alerts: int = 0


class FleetView(msgspec.Struct, frozen=True, kw_only=True):
    """The page: ``fault`` of the network, number of monitors per condition, and the worst ones; ``hidden``: how many
    more match.
    """

    stamp_ns: int
    fault: str
    counts: dict[Condition, int]
    cards: tuple[Card, ...]
    hidden: int


class Picture(msgspec.Struct, frozen=True):
    """JPEG with the overlay, capture time of its frame, verdict of its transform, and how the camera stands."""

    jpeg: bytes
    stamp_ns: int
    verdict: str
    mount: MountView | None = None


class FleetSite:
    """Thread-safe.  Commands go through the fleet's own session, so that the router's access rules apply here, too."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._files = web_files("fleet.html")
        self._pictures: dict[tuple[MonitorName, str, bool], tuple[float, Picture | str]] = {}
        self._under_way: dict[tuple[MonitorName, str, bool], threading.Lock] = {}
        self._lock = threading.Lock()  # guards both
        self._slots = threading.BoundedSemaphore(_AT_ONCE)

    def get(self, path: str) -> Served | None:
        """The page's files, ``fleet?find=…``, ``picture?robot=…&camera=…&id=…``, for the mount ``&mount=1``."""
        path, _, query = path.partition("?")
        if path in self._files:
            return self._files[path]
        asked = {name: values[-1] for name, values in urllib.parse.parse_qs(query, errors="replace").items()}
        if path == "fleet":
            return msgspec.json.encode(self.shown(asked.get("find", ""))), "application/json"
        if path == "picture":
            name = MonitorName(asked.get("robot", ""), asked.get("camera", ""))
            picture = self.picture(name, asked.get("id", ""), mount="mount" in asked)
            return msgspec.json.encode(picture), "application/json"
        return None

    def post(self, path: str) -> Action | None:
        """The action of a command."""
        return (Order, self.carry_out) if path == "order" else None

    def shown(self, find: str = "") -> FleetView:
        """Monitors whose name contains ``find``, the worst first."""
        monitors = self._fleet.monitors()
        found = sorted((each for each in monitors if find.lower() in str(each.name).lower()), key=trouble)
        fault = [f"{self._fleet.unreadable} messages can't be read"] if self._fleet.unreadable else []
        return FleetView(
            stamp_ns=time.time_ns(),
            fault="; ".join(filter(None, [self._fleet.fault(), *fault])),
            counts=dict(Counter(each.condition for each in monitors)),
            cards=tuple(map(_card, found[:CARDS_MOST])),
            hidden=max(0, len(found) - CARDS_MOST),
        )

    def carry_out(self, order: Order) -> CommandOutcome:
        """Send the command.  Raises :class:`BadRequest` if the result is unknown or the monitor isn't there."""
        name = self._known(MonitorName(order.robot, order.camera), order.monitor_id).name
        if order.name != "undo" and not order.argument:
            raise BadRequest(f"{order.name} has no argument; the one that the page showed")
        if order.name == "undo":
            # Undo without an argument goes back by one: only from the revision shown, unless someone else was faster.
            now = self._ask(name, CommandName.STATE, "", order.monitor_id)[0]
            if now.revision != order.revision:
                text = f"revision {now.revision} is in force by now, not {order.revision}; look at it first"
                return CommandOutcome(False, text)
        reply, _ = self._ask(name, CommandName(order.name), order.argument, order.monitor_id)
        return CommandOutcome(reply.done, _short(reply.text))

    def picture(self, name: MonitorName, monitor_id: str, *, mount: bool = False) -> Picture:
        """Its picture, at most 8 s old; for ``mount`` at most 0.4 s, and with the outline at the reference.  Raises
        :class:`BadRequest`, which says why there is none.
        """
        self._known(name, monitor_id)
        key = name, monitor_id, mount
        with self._lock:
            if key not in self._under_way and len(self._under_way) >= _PICTURES_KEPT:
                self._under_way.clear()
                self._pictures.clear()
            one_at_a_time = self._under_way.setdefault(key, threading.Lock())
        with one_at_a_time:
            made_s, found = self._pictures.get(key, (0.0, ""))
            if not found or time.monotonic() - made_s > (_KEPT_MOVING_S if mount else _KEPT_S):
                try:
                    with self._slots:
                        found = self._made(name, monitor_id, mount=mount)
                except BadRequest as error:
                    found = str(error)
                self._pictures[key] = time.monotonic(), found
        if isinstance(found, str):
            raise BadRequest(found)
        return found

    def _made(self, name: MonitorName, monitor_id: str, *, mount: bool) -> Picture:
        reply, data = self._ask(name, CommandName.SNAPSHOT, "", monitor_id)
        snapshot = reply.snapshot
        if not reply.done or snapshot is None:
            raise BadRequest(_short(reply.text))
        try:
            jpeg = picture_of(snapshot, data, PICTURE_PX, snapshot.reference_px if mount else None)
        except ValueError as error:
            raise BadRequest(_short(str(error))) from None
        record, view = snapshot.record, view_of(reply, *name) if mount else None
        return Picture(jpeg, record.stamp_ns, record.verdict.value, view)

    def _known(self, name: MonitorName, monitor_id: str) -> MonitorStatus:
        """The status of a known monitor; names invented by a request are refused."""
        for each in self._fleet.monitors():
            if each.name == name and each.monitor_id == monitor_id:
                if each.gone_since_ns is not None:
                    raise BadRequest(f"{name} is gone")
                return each
        raise BadRequest(f"{_short(str(name))} {_short(monitor_id)} isn't there any more; it may have restarted")

    def _ask(
        self, name: MonitorName, command: CommandName, argument: str, monitor_id: str
    ) -> tuple[CommandReply, bytes | None]:
        try:
            return self._fleet.send(name, command, argument, _ANSWER_S, monitor_id=monitor_id)
        except (NotCarriedOut, Ambiguous, ValueError) as error:
            raise BadRequest(_short(str(error))) from None


def _card(status: MonitorStatus) -> Card:
    card = Card(
        robot=status.name.robot,
        camera=status.name.camera,
        monitor_id=status.monitor_id,
        condition=status.condition,
        gone_since_ns=status.gone_since_ns,
        heard_s=status.state_age_s,
    )
    state, alerts = status.state, status.alerts
    if state is None:
        return card
    return msgspec.structs.replace(
        card,
        state=_short(state.state),
        message=_short(state.message),
        drift_m=status.drift_m,
        sigma_m=state.sigma_m,
        protection_m=state.protection_m,
        alert_limit_m=state.alert_limit_m,
        frames_per_s=state.frames_per_s,
        reference_id=_short(state.reference_id),
        revision=state.revision,
        proposal_id=state.proposal_id if len(state.proposal_id) <= _LONGEST_TEXT else "",
        alerts=tuple(msgspec.structs.replace(each, text=_short(each.text)) for each in alerts[:_ALERTS_SHOWN]),
        more_alerts=max(0, len(alerts) - _ALERTS_SHOWN),
    )


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]} …"
