"""The calibration that drift is measured against, where it came from, and what of it all survives a restart."""

from __future__ import annotations

import msgspec

from gripmon.records.alerts import Cause, OpenAlert
from gripmon.records.values import Transform


class ReferenceInputs(msgspec.Struct, frozen=True):
    """What a reference was made of: the frames ``first_seq`` to ``last_seq``, their number, the corners' names, the
    weighted rms of their residuals (1 if their covariances hold), and by how much it moved the reference before it.
    """

    first_seq: int
    last_seq: int
    frames: int
    corners: tuple[str, ...]
    weighted_rms: float
    step_m: float
    step_rad: float


class ReferenceRecord(msgspec.Struct, frozen=True):
    """The calibration that drift is measured against; the ``reference`` message.

    ``revision`` grows by one with every change and is never used twice.  ``parent`` is the reference that was in force
    before; ``restores`` the earlier one whose transform an undo brought back; ``cause`` what made it necessary;
    ``accepted_by`` who let it in: ``configuration``, ``monitor`` or ``operator``.
    """

    reference_id: str
    revision: int
    stamp_ns: int
    origin: str
    cam_T_grip: Transform
    covariance: tuple[float, ...]
    parent: str | None = None
    restores: str | None = None
    cause: Cause = Cause.UNKNOWN
    accepted_by: str = "configuration"
    inputs: ReferenceInputs | None = None


class MonitorState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What survives a restart.

    ``references`` from the configured one to the one in force, ``proposal`` a new one that waits for an operator,
    ``alerts`` those that are open, ``alerts_raised`` how many there were: it numbers the next one.  ``cam_T_grip`` is
    the last transform that was measured, None if none was; ``reference_error`` (6) what of a
    shift against the configured reference was there from the start, None if that isn't known.
    """

    references: tuple[ReferenceRecord, ...]
    proposal: ReferenceRecord | None = None
    alerts: tuple[OpenAlert, ...] = ()
    alerts_raised: int = 0
    cam_T_grip: Transform | None = None
    reference_error: tuple[float, ...] | None = None
