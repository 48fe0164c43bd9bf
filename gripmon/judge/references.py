"""The chain of references: which calibration is in force, what it came from, and the way back to an earlier one.

No clock and no files: whoever creates a book may have the chain stored before a reference gets into force
(:data:`Keep`).  The revision grows by one with every change, also with an undo, and never names two different
references: two transforms with the same reference and revision may be compared.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from gripmon.model.geometry import to_record
from gripmon.model.records import Array, Cause, MonitorState, ReferenceInputs, ReferenceRecord, Transform, to_json

KEPT_REFERENCES = 1000
"""References that are kept: the configured one and the newest.  One takes 1 to 2 kB; undo can't go back further."""

_TOLERANCE = 1e-6  # of a quaternion's length, and of a normalised covariance's symmetry: files hold rounded numbers
_ROUNDING = 1e-9  # of a normalised covariance's eigenvalues


Keep = Callable[[tuple["ReferenceRecord", ...]], str]
"""Stores a chain of references so that it survives a restart; returns why it can't, or an empty text on success."""


class CommandRefused(ValueError):
    """What an operator asked for can't be done, and nothing has changed; the text gives the reason."""


class ReferenceBook:
    """References from the configured one to the one in force, and a proposed one that waits for an operator.

    Undo and reset make a new revision that names the earlier reference in ``restores``; that is always the original,
    never itself an undo.  A proposal belongs to the reference in force when it was made: any change of reference
    withdraws it.
    """

    def __init__(self, configured: ReferenceRecord, keep: Keep = lambda _: ""):
        """Begin with the configured reference.  A reference that ``keep`` can't store doesn't get into force."""
        self._keep = keep
        self._references: tuple[ReferenceRecord, ...] = (configured,)
        self._proposal: ReferenceRecord | None = None
        self._changes = 0

    @classmethod
    def restored(
        cls, references: Sequence[ReferenceRecord], proposal: ReferenceRecord | None = None, keep: Keep = lambda _: ""
    ) -> ReferenceBook:
        """Continue a stored chain.  Raises ValueError with what is wrong if the chain is inconsistent."""
        fault = chain_fault(references, proposal)
        if fault:
            raise ValueError(fault)
        book = cls(references[0], keep)
        book._references, book._proposal = tuple(references), proposal
        return book

    @property
    def current(self) -> ReferenceRecord:
        """The reference in force."""
        return self._references[-1]

    @property
    def in_force(self) -> ReferenceRecord:
        """The reference in force, or the earlier one that it restores."""
        return self._original(self.current)

    @property
    def configured(self) -> ReferenceRecord:
        """The reference that the configuration gave."""
        return self._references[0]

    @property
    def history(self) -> tuple[ReferenceRecord, ...]:
        """From the configured reference to the one in force; a gap follows the first where some are no longer kept."""
        return self._references

    @property
    def proposal(self) -> ReferenceRecord | None:
        """The reference that waits for an operator."""
        return self._proposal

    @property
    def changes(self) -> int:
        """How often the references or the proposal have changed since this object was made."""
        return self._changes

    @property
    def chosen_by_operator(self) -> bool:
        """Whether an operator went back to the reference in force: a monitor shouldn't overrule that on its own."""
        return self.current.origin in ("undo", "reset")

    def draft(
        self,
        cam_T_grip: Array,
        covariance: Array,
        stamp_ns: int,
        *,
        origin: str = "recalibration",
        cause: Cause = Cause.UNKNOWN,
        inputs: ReferenceInputs | None = None,
    ) -> ReferenceRecord:
        """The next reference, numbered and named, not yet in force: for :meth:`adopt` or :meth:`propose`.

        ``cam_T_grip`` (4, 4), m; ``covariance`` (6, 6), m² and rad²; ``stamp_ns`` of the newest frame behind it.
        """
        flat = tuple(np.asarray(covariance, dtype=float).ravel().tolist())
        return self._next(to_record(cam_T_grip), flat, stamp_ns, origin, "monitor", cause=cause, inputs=inputs)

    def adopt(self, draft: ReferenceRecord) -> ReferenceRecord:
        """Put a draft in force on the monitor's own decision.  Raises ValueError for a draft made for another revision,
        or whose numbers aren't a pose with a covariance; :class:`CommandRefused` for one that can't be stored.
        """
        self._check(draft)
        return self._append(draft)

    def propose(self, draft: ReferenceRecord) -> None:
        """Keep a draft, in place of an earlier one, until an operator accepts or rejects it.  ValueError as above."""
        self._check(draft)
        self._proposal = draft
        self._changes += 1

    def accept(self, proposal_id: str = "") -> ReferenceRecord:
        """The proposal becomes the reference.  Raises :class:`CommandRefused`."""
        return self._append(msgspec.structs.replace(self._meant(proposal_id), accepted_by="operator"))

    def reject(self, proposal_id: str = "") -> ReferenceRecord:
        """Drop the proposal and return it.  Raises :class:`CommandRefused`."""
        rejected = self._meant(proposal_id)
        self._proposal = None
        self._changes += 1
        return rejected

    def undo(self, stamp_ns: int, reference_id: str = "") -> ReferenceRecord:
        """Go back to an earlier reference; without an id to the one before, and with each further undo one more back.
        Raises :class:`CommandRefused`.
        """
        in_force = self.in_force
        if reference_id:
            earlier = self._find(reference_id)
            if earlier is None:
                raise CommandRefused(f"there is no reference {reference_id} among the {len(self._references)} known")
        elif in_force.parent is None:
            raise CommandRefused(f"{in_force.reference_id} is the first reference; there is none before it")
        else:
            earlier = self._find(in_force.parent)
            if earlier is None:
                raise CommandRefused(
                    f"{in_force.parent} is too long ago and no longer kept; reset goes back to the configured reference"
                )
        return self._restore(self._original(earlier), "undo", stamp_ns)

    def reset(self, stamp_ns: int) -> ReferenceRecord:
        """Go back to the configured reference.  Raises :class:`CommandRefused`."""
        return self._restore(self.configured, "reset", stamp_ns)

    def _restore(self, earlier: ReferenceRecord, origin: str, stamp_ns: int) -> ReferenceRecord:
        if self.in_force.reference_id == earlier.reference_id:
            raise CommandRefused(f"{earlier.reference_id} is in force already, as revision {self.current.revision}")
        again = self._next(
            earlier.cam_T_grip, earlier.covariance, stamp_ns, origin, "operator", restores=earlier.reference_id
        )
        return self._append(msgspec.structs.replace(again, with_gripper=earlier.with_gripper))

    def _next(
        self,
        cam_T_grip: Transform,
        covariance: tuple[float, ...],
        stamp_ns: int,
        origin: str,
        accepted_by: str,
        *,
        restores: str | None = None,
        cause: Cause = Cause.UNKNOWN,
        inputs: ReferenceInputs | None = None,
    ) -> ReferenceRecord:
        revision = self.current.revision + 1
        digest = hashlib.sha256(to_json(cam_T_grip)).hexdigest()[:8]
        return ReferenceRecord(
            reference_id=f"{origin}-{revision}-{digest}",
            revision=revision,
            stamp_ns=stamp_ns,
            origin=origin,
            cam_T_grip=cam_T_grip,
            covariance=covariance,
            parent=self.current.reference_id,
            restores=restores,
            cause=cause,
            accepted_by=accepted_by,
            inputs=inputs,
        )

    def _append(self, reference: ReferenceRecord) -> ReferenceRecord:
        """Put a reference in force, stored first: a crash must not lose one in use, nor reuse its revision."""
        references = (*self._references, reference)
        if len(references) > KEPT_REFERENCES:
            references = (references[0], *references[2:])
        if fault := self._keep(references):
            raise CommandRefused(f"{reference.reference_id} is not put in force, as a restart would lose it: {fault}")
        self._references, self._proposal = references, None
        self._changes += 1
        return reference

    def _check(self, draft: ReferenceRecord) -> None:
        fault = chain_fault((self.current,), draft, numbers_of=(draft,))
        if fault:
            raise ValueError(fault)

    def _meant(self, proposal_id: str) -> ReferenceRecord:
        if self._proposal is None:
            raise CommandRefused("no new reference is proposed")
        if proposal_id not in ("", self._proposal.reference_id):
            raise CommandRefused(f"{proposal_id} is not proposed; {self._proposal.reference_id} is")
        return self._proposal

    def _find(self, reference_id: str) -> ReferenceRecord | None:
        return next((r for r in reversed(self._references) if r.reference_id == reference_id), None)

    def _original(self, reference: ReferenceRecord) -> ReferenceRecord:
        """The reference that an undo restored; the argument itself if it isn't an undo or that is no longer kept."""
        return (self._find(reference.restores) if reference.restores else None) or reference


def state_fault(state: MonitorState) -> str:
    """What is inconsistent in a stored state; empty if nothing is."""
    fault = chain_fault(state.references, state.proposal)
    if fault:
        return fault
    if state.cam_T_grip is not None and not _is_pose(state.cam_T_grip):
        return "the last transform is not a pose"
    for numbers, what in (
        (state.reference_error, "the error of the configured reference"),
        (state.unexplained, "what the first frames differed by"),
    ):
        if isinstance(numbers, tuple) and not (len(numbers) == 6 and np.isfinite(numbers).all()):
            return f"{what} is not six finite numbers"
    if len({alert.topic for alert in state.alerts}) != len(state.alerts):
        return "two open alerts on one topic"
    if state.alerts_raised < len(state.alerts):
        return f"{len(state.alerts)} open alerts of {state.alerts_raised} that were raised"
    return ""


def chain_fault(
    references: Sequence[ReferenceRecord],
    proposal: ReferenceRecord | None = None,
    *,
    numbers_of: Sequence[ReferenceRecord] | None = None,
) -> str:
    """Why these references, oldest first, can't be one chain from the configured one to the one in force; empty if they
    can.  ``numbers_of``: those whose poses and covariances are checked; all if left out.
    """
    if not references:
        return "no reference at all"
    every = (*references, proposal) if proposal is not None else tuple(references)
    if every[0].revision < 0:
        return f"revision {every[0].revision}"
    if len({r.reference_id for r in every}) != len(every):
        return "two references of one name"
    # The oldest references but the configured one are dropped in time: that leaves a gap after the first.
    has_gap = len(references) > 1 and references[1].revision > references[0].revision + 1
    known: dict[str, ReferenceRecord] = {}
    for i, (before, after) in enumerate(itertools.pairwise(every)):
        known[before.reference_id] = before
        gap = has_gap and i == 0
        if after.revision != before.revision + 1 and not gap:
            return f"revision {after.revision} follows revision {before.revision}"
        if after.parent != before.reference_id and not (gap and after.parent):
            return f"{after.reference_id} follows {before.reference_id}, but has the parent {after.parent}"
        if after.restores is not None:
            restored = known.get(after.restores)
            if (restored is None and not has_gap) or (restored is not None and restored.restores):
                return f"{after.reference_id} restores {after.restores}, which is not an earlier reference"
    return _numbers_fault(every if numbers_of is None else numbers_of)


def _numbers_fault(references: Sequence[ReferenceRecord]) -> str:
    for reference in references:
        if not _is_pose(reference.cam_T_grip):
            return f"{reference.reference_id}: no pose"
        if len(reference.covariance) != 36:
            return f"{reference.reference_id}: a covariance of {len(reference.covariance)} numbers"
    covariances = np.array([reference.covariance for reference in references]).reshape(-1, 6, 6)
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    # Normalised by their own deviations: metres and radians can't be compared.
    with np.errstate(all="ignore"):
        scale = np.sqrt(variances)
        normalised = covariances / (scale[:, :, None] * scale[:, None, :])
        finite = np.isfinite(normalised).all(axis=(1, 2))
        normalised[~finite] = np.eye(6)
        skewed = np.abs(normalised - np.swapaxes(normalised, 1, 2)).max(axis=(1, 2)) > _TOLERANCE
        indefinite = np.linalg.eigvalsh(normalised)[:, 0] < -_ROUNDING
    bad = np.flatnonzero(~finite | skewed | indefinite)
    return f"{references[bad[0]].reference_id}: no covariance" if len(bad) else ""


def _is_pose(transform: Transform) -> bool:
    numbers = np.array([*transform.translation_m, *transform.rotation_xyzw])
    return bool(np.isfinite(numbers).all()) and abs(float(np.linalg.norm(numbers[3:])) - 1.0) < _TOLERANCE
