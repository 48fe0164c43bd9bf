"""A running monitor: ``gripmon run`` and ``send``."""

from __future__ import annotations

import logging
import sys
from typing import TYPE_CHECKING

from gripmon.cli.common import (
    NETWORK_OPTIONS,
    REQUIRED,
    VIEW,
    VIEW_OPTION,
    Arguments,
    Command,
    make_directory,
    positive_number,
)
from gripmon.cli.fleet_table import local_time, printable
from gripmon.model.errors import InputError, NoResultError, input_errors
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED, signals_exit

if TYPE_CHECKING:
    from gripmon.model.records import CommandReply, MonitorState, ReferenceRecord

_RUN_OPTIONS = f"""
CONFIG         configuration file (YAML)
--duration S   stop after this time (s); default: never
--out DIR      folder for the recording and estimates.jsonl (one JSON line per frame);
               created if missing; existing files are kept (estimates-1.jsonl …) within daemon.estimates_budget_bytes
--fresh-state  start from the configured reference; a kept state is set aside as <file>.replaced-<n>
--take-over    start even if another monitor of this robot and camera is on the network; nothing is usable until
               one of the two is stopped
{VIEW_OPTION.strip()}
--verbose      log more on stderr
--log-json     one JSON object per line on stderr: time, level, logger, text (for log collectors)
"""

_RUN_EXAMPLES = """\
  gripmon run configs/live_camera.yaml
  gripmon run configs/demo.yaml --duration 60 --out results

  gripmon run configs/live_camera.yaml --fresh-state     start again; the kept state is set aside
  gripmon send undo --robot arm1                         back to the previous reference
  gripmon run configs/live_camera.yaml --view web        show it live in a browser, on this machine


Messages are on the Zenoh keys gripmon/<robot>/<camera>/{transform,state,alert,reference}.
exit codes: 0 the source ended, the time was over, or SIGTERM; 2 wrong usage or configuration; 3 no
usable frame, or an internal error that persisted; 4 another
monitor of this robot and camera is on the network; 130 Ctrl-C"""


@Command(
    _RUN_OPTIONS, _RUN_EXAMPLES, duration=positive_number, view=VIEW,
)  # fmt: skip
def run(arguments: Arguments) -> int:
    """Monitor a camera: correct cam_T_grip in every frame, publish it over Zenoh and record it, until
    interrupted (Ctrl-C or SIGTERM).  If the camera is missing or disappears, the monitor retries forever
    and reports it in the state.

    The references, a proposal and open alerts survive a restart, also kill -9 and a power cut, in the file
    that state.file names: for a live camera in ~/.local/state/gripmon.  After a restart the monitor
    continues from the last reference, checks that the image fits it, and reports this (alert restarted).

    """
    with signals_exit() as stop:
        from gripmon.daemon.starting import RunOptions, run_file

        options = RunOptions(
            out=arguments.out, stop=stop, duration_s=arguments.duration, fresh_state=arguments.fresh_state,
            view=arguments.view, take_over=arguments.take_over,
        )  # fmt: skip
        return run_file(arguments.config, options, verbose=arguments.verbose, log_json=arguments.log_json)


_NAMES = ("recalibrate", "accept", "reject", "undo", "reset", "acknowledge", "state", "snapshot")
_WITH_ARGUMENT = ("accept", "reject", "undo", "acknowledge")

_SEND_OPTIONS = f"""
NAME               {", ".join(_NAMES)}
[ID]               id of the reference, proposal or alert
--robot NAME       the robot's name in the configuration
--camera NAME      the camera's name; needed if the robot has several
--monitor ID       id of the monitor, as printed, if two have the same name
{NETWORK_OPTIONS.format("the monitor's").strip()}
--timeout S        how long to wait (s); default: 5
--out DIR          folder for a snapshot; created if missing
--request REQUEST  id of an earlier request that got no reply
--json             print the whole reply as one line of JSON
"""

_SEND_EXAMPLES = """\
  gripmon send state --robot arm1
  gripmon send undo --robot arm1
  gripmon send undo recalibration-3-1f0c9a2b --robot arm1 --camera wrist
  gripmon send snapshot --robot arm1 --out now        now/snapshot-1.png, -1.json, timestamps.csv

exit codes: 0 done; 2 wrong usage; 3 refused, or no reply; 130 Ctrl-C"""


@Command(
    _SEND_OPTIONS, _SEND_EXAMPLES,
    name={"choices": _NAMES, "metavar": "COMMAND"}, id={"default": ""}, robot=REQUIRED, monitor={"default": ""},
    timeout={"type": positive_number, "default": 5.0},
)  # fmt: skip
def send(arguments: Arguments) -> int:
    """Send a command to a running monitor, and print its reply.

      recalibrate       measure a new reference from the camera's images
      accept [ID]       accept the proposed reference
      reject [ID]       discard the proposed reference
      undo [ID]         restore the previous reference, or the one named: a new revision with that
                        transform
      reset             restore the configured reference, likewise
      acknowledge [ID]  acknowledge an open alert, or all
      state             print the references, a proposal and the open alerts
      snapshot          write the newest frame's image and record to --out, numbered, with a row in
                        timestamps.csv: ready for replay and teach

    An impossible command is refused with a reason, and changes nothing.  Every request has an id: if no
    reply came, --request with that id repeats the request, which is not carried out twice.
    """
    from gripmon.cli import snapshots

    if wrong := _misuse(arguments):
        raise InputError(f"send: {wrong}")
    arguments.network()
    out = None if arguments.out is None else make_directory(arguments.out)
    if out is not None:
        snapshots.check_table(out)
    reply, image = _ask(arguments)
    written = snapshots.write(reply, image, out) if out is not None and reply.done else []
    if arguments.json:
        from gripmon.model.records import to_json

        print(to_json(reply).decode())
    elif not reply.done:
        print(f"refused: {printable(reply.text)}", file=sys.stderr)
    else:
        print("\n".join([printable(reply.text), *map(str, written)]))
        if reply.monitor is not None and reply.snapshot is None:
            print("\n".join(map(printable, _table(reply.monitor))))
    return EXIT_DONE if reply.done else EXIT_FAILED


def _misuse(arguments: Arguments) -> str:
    """Options that exclude each other, and what would be right; empty if none."""
    name = arguments.name
    if arguments.id and name not in _WITH_ARGUMENT:
        return f"{name} takes no ID, but {arguments.id} is given; leave it out"
    if name == "snapshot" and arguments.out is None:
        return "snapshot needs a folder; --out DIR"
    if name != "snapshot" and arguments.out is not None:
        return f"{name} writes nothing; leave --out out"
    if name in ("state", "snapshot") and arguments.request is not None:
        return f"{name} changes nothing and is answered again each time; leave --request out"
    return ""


def _ask(arguments: Arguments) -> tuple[CommandReply, bytes | None]:
    """The reply, and the image of a snapshot."""
    from gripmon.client import Ambiguous, NotCarriedOut, TransformClient
    from gripmon.model.records import CommandFault, CommandName

    logging.getLogger("gripmon.io.wire").setLevel(logging.ERROR)  # the error says what connection is missing
    timeout_s, monitor_id = arguments.timeout, arguments.monitor
    try:
        with input_errors("send"):
            with arguments.network_errors():
                client = TransformClient(arguments.robot, arguments.camera, **arguments.network())
            with client:
                if arguments.out is not None:
                    return client.snapshot(timeout_s, monitor_id=monitor_id)
                name, request = CommandName(arguments.name), arguments.request
                return client.send(name, arguments.id, timeout_s, request_id=request, monitor_id=monitor_id), None
    except Ambiguous as error:
        option = {"camera": "--camera", "monitor_id": "--monitor ID"}[error.argument]
        raise InputError(f"send: {error} ({option})") from None
    except NotCarriedOut as error:
        again = f" (--request {error.request_id})" if error.fault is CommandFault.TIMEOUT else ""
        raise NoResultError(f"send: {printable(str(error))}{again}") from None


def _table(state: MonitorState) -> list[str]:
    """References, the newest last, a proposal, and the open alerts, a line each."""
    lines = ["references, the last one in force:", *(f"  {_line(reference)}" for reference in state.references)]
    lines += ["proposed:", f"  {_line(state.proposal)}"] if state.proposal is not None else []
    lines += ["open alerts:"] if state.alerts else []
    for kept in state.alerts:
        taken = ", acknowledged" if kept.alert.acknowledged else ""
        lines.append(f"  {kept.alert.alert_id}  {kept.alert.severity.value}{taken}: {kept.alert.text}")
    return lines


def _line(reference: ReferenceRecord) -> str:
    when = local_time(reference.stamp_ns)
    said = "at no time" if when is None else when.isoformat(" ", "seconds")
    origin = f"restores {reference.restores}" if reference.restores else f"by {reference.accepted_by}"
    step = ""
    if reference.inputs is not None:
        step = f", moved by {1e3 * reference.inputs.step_m:.3f} mm, cause {reference.cause.value}"
    return f"{reference.revision:5d}  {reference.reference_id}  {said if reference.stamp_ns else '-'}  {origin}{step}"
