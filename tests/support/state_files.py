"""A state with everything in it, its bytes, and shorthands around a file."""

from __future__ import annotations

from pathlib import Path

from test_references import book_of, configured, propose

from gripmon.judge.statefile import (
    Calibration,
    Owner,
    StateFile,
    pack,
)
from gripmon.model.records import (
    Alert,
    AlertKind,
    Cause,
    CauseWeight,
    MonitorState,
    OpenAlert,
    Severity,
    Transform,
)

OWNER = Owner("arm", "wrist", Calibration("c", "g", "r"))


def state_of(*steps: str, probability: float = 0.75) -> MonitorState:
    """Everything that a state can have."""
    book = book_of(*steps)
    propose(book, 9)
    alert = Alert(
        AlertKind.DRIFT, Cause.CAMERA_MOUNT, Severity.WARNING, "moved „3 µm“", alert_id="drift-2", since_ns=5,
        causes=(CauseWeight(Cause.CAMERA_MOUNT, probability),), tcp_shift_m=(1e-5, -2e-5, 1 / 3),
    )  # fmt: skip
    last = Transform((0.1, 0.2, 0.3), (0.0, 0.6, 0.0, 0.8))
    error = (1e-5, -2e-5, 1e-4, 1e-3, 0.0, -1e-3)
    return MonitorState(book.history, book.proposal, (OpenAlert("drift", alert),), 2, last, error)


STATE = state_of("a", "a", "u")
DATA = pack(OWNER, STATE)


def opened(path: Path, owner: Owner = OWNER, *, fresh: bool = False) -> StateFile:
    return StateFile(path, owner, configured(), fresh=fresh)


def write(path: Path, data: bytes) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)


def beside(path: Path) -> list[str]:
    """All files in the folder but the lock."""
    return sorted(other.name for other in path.parent.iterdir() if other.name != path.name + ".lock")


def read_once(path: Path, owner: Owner = OWNER) -> StateFile:
    file = opened(path, owner)
    file.close()
    return file
