"""What an operator may tell a running monitor, and what it answers."""

from __future__ import annotations

import enum

import msgspec

from gripmon.records.references import MonitorState


class CommandName(enum.StrEnum):
    """What an operator may tell a running monitor."""

    RECALIBRATE = "recalibrate"
    ACCEPT = "accept"
    REJECT = "reject"
    UNDO = "undo"
    RESET = "reset"
    ACKNOWLEDGE = "acknowledge"
    STATE = "state"


class Command(msgspec.Struct, frozen=True):
    """``argument``: for ``undo`` the reference to go back to (empty: the one before), for ``accept`` and ``reject`` the
    proposal that is meant (empty: the one there is), for ``acknowledge`` the alert (empty: all that are open).
    """

    name: CommandName
    argument: str = ""


class CommandReply(msgspec.Struct, frozen=True):
    """``done`` or refused, and why, in ``text``; then nothing has changed.  The reference in force afterwards.

    ``monitor`` answers ``state``: all references and proposals that other commands may name, and the open alerts.
    """

    name: CommandName
    done: bool
    text: str
    reference_id: str
    revision: int
    monitor: MonitorState | None = None


class CommandFault(enum.StrEnum):
    """Why a command did not reach the monitor, or nothing is known of what became of it."""

    UNKNOWN = "unknown_command"
    MALFORMED = "malformed"
    SEVERAL = "several_monitors"
    BUSY = "busy"
    TIMEOUT = "timeout"
    STOPPING = "stopping"
    INTERNAL = "internal_error"


class CommandError(msgspec.Struct, frozen=True):
    """The answer in place of a :class:`CommandReply` to a command that was not carried out, or perhaps was: see
    ``text``.
    """

    error: CommandFault
    text: str
