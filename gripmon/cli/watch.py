"""``gripmon watch``: the state and the alerts of every monitor on the network."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from gripmon.cli import fleet_table
from gripmon.cli.common import (
    NETWORK_OPTIONS,
    PAGE_PORT,
    PORT_OPTIONS,
    Arguments,
    Command,
    announcer,
    check_file,
    positive_number,
)
from gripmon.model.errors import InputError, NoResultError, input_errors

if TYPE_CHECKING:
    from rich.console import RenderableType

    from gripmon.cli.alert_log import AlertLog
    from gripmon.client import Fleet, MonitorStatus

_OPTIONS = f"""
{NETWORK_OPTIONS.format("a monitor's").strip()}
--alerts      print the alerts instead of the table
--out FILE    with --alerts: append them to this file, JSON lines
--mount       how one camera must be moved to stand as at its reference
--robot NAME  with --mount: the robot; needed if there are several
--camera NAME  with --mount: its camera; needed if it has several
--transforms  subscribe to all transforms for rate and age
--once        print the table once, after --seconds, and end
--json        JSON lines instead of text
--period S    time between two tables (s); default: 1, with --mount 0.3
--seconds S   end after this time (s); with --once 3 by default
"""

_PAGE = f"""
--web              show a page in the browser: pictures, alerts, proposals, and buttons for them
--address ADDRESS  address of this machine at which others reach the page; default: this machine only
{PORT_OPTIONS.strip()}
"""

_EXAMPLES = """\
  gripmon watch
  gripmon watch --once --connect tcp/10.0.0.5:7447
  gripmon watch --alerts --out fleet-alerts.jsonl
  gripmon watch --mount --robot arm1
  gripmon watch --web --zenoh-config operator.json5

exit codes: 0 done (--once, --seconds); 2 wrong usage; 3 with --once: no monitor is on the network, with
--mount: it doesn't know how its camera stands; 130 Ctrl-C"""

_ALERT_PERIOD_S = 0.2


@Command(
    _OPTIONS, _EXAMPLES, {"the page": (None, _PAGE)},
    period=positive_number, seconds=positive_number, port=PAGE_PORT,
)  # fmt: skip
def watch(arguments: Arguments) -> None:
    """A live table of all monitors on the network, the worst first: those that are gone, silent or have no
    transform, then the suspect ones, then by the severest open alert and by drift. A monitor that
    vanished stays listed.

    The last column begins with the command to type if a new reference waits for an operator, then lists
    the open alerts: !! is for errors, ! for warnings, i for notes, each with their number, so that
    "!!1 !1" is one error and one warning; after them the text of the worst one.

    On a terminal the table is redrawn every period. Otherwise one line is printed whenever a monitor's
    state, verdict, reference or alerts change; with --json one line of JSON every period.

    With --alerts every alert of every monitor is printed as it comes, including the last earlier ones, and
    when a monitor appears or vanishes; --out appends them to a file as JSON lines, each once.  An alert has
    the time of its frame: for recorded or simulated frames, the recording's own clock.

    With --mount it shows for one camera, again and again, how its mount must be turned and shifted to stand
    as at the reference: six numbers with bars in the camera's own directions, green within the alert limit,
    and what to do first. The reference is the newest one that a person let in, not one that the monitor made
    itself after a knock.

    With --web the same is a page, with each monitor's image.  Its buttons send the commands of gripmon
    send: if a router has rules, they need an operator's certificate (--zenoh-config).
    """
    joined = arguments.network()
    logging.getLogger("gripmon.io.wire").setLevel(logging.ERROR)  # the table or page shows a missing connection
    if arguments.web:
        _serve(arguments, joined)
        return
    if arguments.mount:
        _mount(arguments, joined)
        return
    arguments.refuse(("robot", "camera"), "applies only to one mount; add --mount")
    arguments.refuse(("address", "no_browser"), "applies only to the page; add --web")
    if arguments.out and not arguments.alerts:
        raise InputError("watch: --out is for alerts; add --alerts, or redirect the output of --json")
    if arguments.alerts and (arguments.once or arguments.transforms):
        raise InputError("watch: --alerts prints only alerts; leave out --once and --transforms")
    from gripmon.client import Fleet

    log = _open_log(arguments) if arguments.alerts else None
    heard: dict[str, Any] = {} if log is None else {"on_alert": log.alert, "on_presence": log.presence}
    with arguments.network_errors():
        opened = Fleet(**joined, transforms=arguments.transforms, **heard)
    period_s = arguments.period or 1.0
    with opened as fleet:
        seconds = 3.0 if arguments.once and arguments.seconds is None else arguments.seconds
        end_s = None if seconds is None else time.monotonic() + seconds
        if log is not None:
            _repeat(lambda: _print_alerts(log, arguments), _ALERT_PERIOD_S, end_s)
        elif arguments.once:
            time.sleep(seconds or 0.0)
            _show_once(fleet, arguments)
        elif arguments.json:
            _repeat(lambda: _print_json(fleet), period_s, end_s)
        elif sys.stdout.isatty():
            _live(lambda *size: fleet_table.table(_sorted(fleet), _fault(fleet), *size), period_s, end_s)
        else:
            _repeat(_Changes(fleet).show, period_s, end_s)


def _mount(arguments: Arguments, joined: dict[str, Any]) -> None:
    arguments.refuse(("alerts", "out", "transforms"), "has no effect beside --mount; leave it out")
    arguments.refuse(("address", "no_browser"), "applies only to the page; add --web")
    from gripmon.cli.mount_view import PERIOD_S, MountView, only_monitor, plain
    from gripmon.client import TransformClient

    with arguments.network_errors(), input_errors("watch"):
        name = only_monitor(joined, arguments.robot, arguments.camera)
        opened = TransformClient(*name, **joined)
    with opened as client:
        view = MountView(client, name)

        def tell() -> None:
            view.look()
            if arguments.json:
                _print_line(view.as_data())
            elif view.changed():
                print(f"{fleet_table.clock(time.time_ns())}  {view.line()}", flush=True)

        if arguments.once:
            end_s = time.monotonic() + (arguments.seconds or 3.0)
            while not view.look().measured and time.monotonic() < end_s:
                time.sleep(PERIOD_S)
            if not view.measured:
                raise NoResultError(f"watch: {view.line()}")
            if arguments.json:
                _print_line(view.as_data())
            else:
                print(plain(view.rows()))
            return
        until_s = None if arguments.seconds is None else time.monotonic() + arguments.seconds
        if not arguments.json and sys.stdout.isatty():
            _live(lambda _height, _width: _lines(view.look().rows()), arguments.period or PERIOD_S, until_s)
        else:
            _repeat(tell, arguments.period or PERIOD_S, until_s)


def _lines(rows: list[tuple[str, str]]) -> RenderableType:
    from rich.console import Group
    from rich.text import Text

    return Group(*(Text(text, style=style) for text, style in rows))  # text, not markup: it comes from the network


def _serve(arguments: Arguments, joined: dict[str, Any]) -> None:
    of_the_terminal = ("once", "json", "alerts", "out", "transforms", "seconds", "mount", "robot", "camera")
    arguments.refuse(of_the_terminal, "has no effect beside --web; leave it out")
    from gripmon.client import Fleet
    from gripmon.daemon.fleet_page import FleetSite
    from gripmon.teach.page_server import ADDRESS, serve

    address = arguments.address or ADDRESS
    if address in ("0.0.0.0", "::"):
        raise InputError(f"--address {address}: isn't a machine's address; the one at which others reach this machine")
    with arguments.network_errors():
        opened = Fleet(**joined)
    with opened as fleet:
        serve(
            FleetSite(fleet), arguments.port, announcer("watch"), open_browser=not arguments.no_browser, address=address
        )


def _open_log(arguments: Arguments) -> AlertLog:
    from gripmon.cli.alert_log import AlertLog

    path = arguments.out
    if path is not None:
        check_file(path)
    try:
        return AlertLog(path)
    except OSError as error:
        raise InputError(f"--out {path}: can't be read ({error.strerror}); a file of your own") from None


def _print_alerts(log: AlertLog, arguments: Arguments) -> None:
    events, failure = log.write()
    for event in events:
        print(event.line.decode() if arguments.json else fleet_table.event_line(event), flush=True)
    if failure:
        print(f"watch: --out {arguments.out}: {failure}; trying again", file=sys.stderr, flush=True)


def _repeat(act: Callable[[], None], period_s: float, end_s: float | None) -> None:
    """Act now, after every period, and at the end."""
    while True:
        act()
        now_s = time.monotonic()
        if end_s is not None and now_s >= end_s:
            return
        time.sleep(period_s if end_s is None else min(period_s, end_s - now_s))


def _sorted(fleet: Fleet) -> list[MonitorStatus]:
    from gripmon.client import trouble

    return sorted(fleet.monitors(), key=trouble)


def _fault(fleet: Fleet) -> str:
    unreadable = f"{fleet.unreadable} messages can't be read" if fleet.unreadable else ""
    return "; ".join(filter(None, (fleet.fault(), unreadable)))


def _show_once(fleet: Fleet, arguments: Arguments) -> None:
    statuses = _sorted(fleet)
    if arguments.json:
        _print_json(fleet)
    elif statuses:
        print(fleet_table.plain(statuses, _fault(fleet)))
    if not statuses:
        doubt = "is --connect right?"
        if arguments.zenoh_config:  # a router silently drops what its rules forbid
            doubt = f"is {arguments.zenoh_config} for the right router, and may its certificate read there?"
        raise NoResultError(f"watch: no monitor is on the network; {fleet.fault() or doubt}")


def _print_json(fleet: Fleet) -> None:
    values = {
        "stamp_ns": time.time_ns(),
        "fault": fleet.fault(),
        "unreadable": fleet.unreadable,
        "monitors": [fleet_table.as_data(status) for status in _sorted(fleet)],
    }
    _print_line(values)


def _print_line(values: dict[str, Any]) -> None:
    import msgspec

    print(msgspec.json.encode(values).decode(), flush=True)


def _live(picture: Callable[[int, int], RenderableType], period_s: float, end_s: float | None) -> None:
    """Redraw what ``picture`` makes for a terminal of that height and width."""
    from rich.console import Console
    from rich.live import Live

    console = Console()

    def draw() -> None:
        live.update(picture(console.size.height, console.size.width), refresh=True)

    with Live(console=console, auto_refresh=False, screen=True) as live:
        _repeat(draw, period_s, end_s)


class _Changes:
    """Prints one line for each monitor that has changed since it was last printed."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._printed: dict[object, object] = {}
        self._fault = ""

    def show(self) -> None:
        """Print the changes."""
        if (fault := self._fleet.fault()) != self._fault:
            self._fault = fault
            print(f"{fleet_table.clock(time.time_ns())}  {fleet_table.printable(fault) or 'connected'}", flush=True)
        for status in _sorted(self._fleet):
            state = status.state
            what = (
                status.condition,
                state and (state.state, state.verdict, state.revision, state.message, state.proposal_id),
                tuple((alert.alert_id, alert.severity, alert.acknowledged) for alert in status.alerts),
            )
            who = (status.name, status.monitor_id if status.several else "")
            if self._printed.get(who) != what:
                self._printed[who] = what
                print(f"{fleet_table.clock(time.time_ns())}  {fleet_table.line(status)}", flush=True)
