"""What survives a restart, in a file: written whole or not at all, read whole or not at all.

A file holds one :class:`gripmon.model.records.MonitorState` with the robot, the camera and the calibration that it
belongs to, under a checksum.  A damaged file, or one of another calibration, is renamed and never used; a file of
another robot, or one that another process uses, is left alone.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import stat
from pathlib import Path
from typing import Annotated

import msgspec

from gripmon.judge.references import state_fault
from gripmon.model.atomic import remove_leftovers, write_atomically
from gripmon.model.camera import LensSettings
from gripmon.model.errors import InputError
from gripmon.model.gripper import GripperModel, contents_of
from gripmon.model.records import MonitorState, ReferenceRecord, StripsRecord

_log = logging.getLogger(__name__)

_UNREADABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)
"""What decoding raises for a file of another kind; RecursionError for brackets nested by the thousand."""

FORMAT = 1
LARGEST_BYTES = 64 << 20
"""A larger file is not a state file: a thousand references take less than 3 MB."""

AUTO = "auto"

_MOST_DIGITS = 18  # of a number in the lock file: a longer one is not a revision


class StateSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where ``gripmon run`` keeps what survives a restart."""

    file: (
        Annotated[
            str,
            msgspec.Meta(
                min_length=1,
                description="file for references and open alerts, relative to this file; auto: for a live camera "
                "$XDG_STATE_HOME/gripmon/<robot>-<camera>.json (~/.local/state/…), else none; null: none",
            ),
        ]
        | None
    ) = AUTO


class StateFileError(InputError):
    """The monitor can't start with this file: "file: what is wrong; what would be right"."""


class Calibration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Digests of what a state belongs to: references of another camera, gripper or start can't be used here."""

    camera: str
    gripper: str
    reference: str


class Owner(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Whose state it is: robot, camera, calibration."""

    robot: str
    camera: str
    calibration: Calibration


class Kept(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of a file."""

    format: int
    owner: Owner
    state: MonitorState


class _Look(msgspec.Struct, frozen=True):
    """The gripper's learned look, which was kept up to commit ab09892a: only the strips still are."""

    strips: StripsRecord | msgspec.UnsetType = msgspec.UNSET


class _State(MonitorState, frozen=True, forbid_unknown_fields=True):
    """A state as read from a file: an unknown field is an error, because the next write would lose it."""

    look: _Look | None = None


class _Read(Kept, frozen=True, forbid_unknown_fields=True):
    state: _State


class _Envelope(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    sha256: str
    content: msgspec.Raw


class _Format(msgspec.Struct, frozen=True):
    format: int


def default_path(robot: str, camera: str) -> Path:
    """Where the state of a live camera is kept unless the configuration says otherwise.

    Raises :class:`StateFileError` for a user without a home.
    """
    base = os.environ.get("XDG_STATE_HOME", "")
    try:
        # The XDG standard has relative paths ignored.
        folder = Path(base) if Path(base).is_absolute() else Path("~/.local/state").expanduser()
    except RuntimeError:
        raise StateFileError("auto, but this user has no home folder; the path of a file, or null") from None
    return folder / "gripmon" / f"{robot}-{camera}.json"


def calibration_of(lens: LensSettings, gripper: GripperModel, reference: ReferenceRecord) -> Calibration:
    """Digests of the values, not of the files: a changed comment changes nothing."""
    start = msgspec.structs.replace(reference, revision=0, stamp_ns=0)
    values = (
        lens,
        contents_of(gripper),
        msgspec.structs.asdict(start),
    )  # the reference without its message type
    return Calibration(*(hashlib.sha256(msgspec.json.encode(part)).hexdigest()[:16] for part in values))


def pack(owner: Owner, state: MonitorState) -> bytes:
    """The bytes of a file."""
    content = msgspec.json.encode(Kept(FORMAT, owner, state))
    return b'{"sha256":"%s","content":%s}\n' % (hashlib.sha256(content).hexdigest().encode(), content)


def unpack(data: bytes) -> Kept:
    """The content of a file.  Raises ValueError with what is wrong if the file is damaged or inconsistent."""
    try:
        envelope = msgspec.json.decode(data, type=_Envelope)
    except _UNREADABLE:
        raise ValueError("it is cut off, or no state file at all") from None
    content = bytes(envelope.content)
    if hashlib.sha256(content).hexdigest() != envelope.sha256:
        raise ValueError("its checksum is wrong")
    try:
        version = msgspec.json.decode(content, type=_Format).format
        if version != FORMAT:
            raise ValueError(f"it has format {version}, and this version of gripmon reads format {FORMAT}")
        read = msgspec.json.decode(content, type=_Read)
    except _UNREADABLE as error:
        raise ValueError(f"its content is not a state: {error}") from None
    values = msgspec.structs.asdict(read.state)
    look = values.pop("look")
    if look is not None and read.state.strips is msgspec.UNSET:
        values["strips"] = look.strips
    kept = Kept(read.format, read.owner, MonitorState(**values))
    if fault := state_fault(kept.state):
        raise ValueError(f"its content contradicts itself: {fault}")
    return kept


class StateFile:
    """One monitor's file, which no other process may use while this object is open.

    ``state`` is what to continue from, None for a new start; ``configured`` is the reference of a new start: its
    revision follows those of a file that was set aside, where they are known.  ``notices`` tell people what was found.
    ``failure`` is why nothing can be stored now, empty while all is well.
    """

    def __init__(self, path: Path, owner: Owner, configured: ReferenceRecord, *, fresh: bool = False) -> None:
        """Lock the file and read it.  ``fresh``: set a state aside even if it could be used.

        Raises :class:`StateFileError` if the file is another robot's, in use, or not a regular file.  Any other fault,
        such as a folder without write permission, is reported in ``failure`` and stops nothing.
        """
        self.state: MonitorState | None = None
        self.configured = configured
        self.notices: tuple[str, ...] = ()
        self.failure = ""
        # Resolve links: renaming would replace the link itself.
        self._path, self._owner = path.resolve(), owner
        self._usable = True
        self._newest_revision: int | None = None  # ever stored here, where it is known
        self._lock = self._take_lock()
        try:
            self._read(fresh)
        except BaseException:
            self.close()
            raise

    def write(self, state: MonitorState) -> bool:
        """Store a state in place of the last one; False, with ``failure`` set, if that can't be done."""
        if not self._usable:
            return False
        try:
            self._lock_again_if_gone()
            data = pack(self._owner, state)
            # A state that can't be read back must not replace one that can: NaN, for example, is null in JSON.
            if unpack(data).state != state:
                raise ValueError("it is not what comes back")
            write_atomically(self._path, data)
        except StateFileError as error:
            self._usable = False
            self._fail(str(error))
            return False
        except OSError as error:
            self._fail(f"{self._path} can't be written: {error.strerror or error}")
            return False
        except Exception as error:  # noqa: BLE001  reported; the monitor goes on
            self._fail(f"internal error in the state, the last sound one is kept: {error}")
            return False
        if self.failure:
            _log.info("%s is written again", self._path)
        self.failure = ""
        if self._lock is not None and self._newest_revision != (newest := state.references[-1].revision):
            self._newest_revision = newest
            self._note(self._lock)
        return True

    def close(self) -> None:
        """Let other processes use the file."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _take_lock(self) -> int | None:
        """A descriptor that holds the lock, None, with ``failure`` set, if there can't be one."""
        try:
            descriptor = self._locked()
        except OSError as error:
            self._give_up(f"{self._path}.lock can't be locked: {error.strerror or error}")
            return None
        _, self._newest_revision = _noted(descriptor)
        self._note(descriptor)
        return descriptor

    def _locked(self) -> int:
        """A descriptor that holds the lock: of a file of its own, since each write replaces the state's file.  Raises
        OSError, and :class:`StateFileError` if another process holds it.
        """
        self._path.parent.mkdir(parents=True, exist_ok=True)
        path = self._path.with_name(self._path.name + ".lock")
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder, _ = _noted(descriptor)
            os.close(descriptor)
            by = "another process" if holder is None else f"process {holder}"
            right = "stop that one, or give this monitor a file of its own"
            raise StateFileError(f"{self._path} is in use by {by}; {right}") from None
        except OSError:
            os.close(descriptor)
            raise
        return descriptor

    def _lock_again_if_gone(self) -> None:
        """Make the lock file again where somebody has deleted it: a second process would get its lock."""
        held = self._lock
        if held is None or os.fstat(held).st_nlink > 0:
            return
        self._lock = self._locked()  # an OSError is told as one of the write, which is tried again
        self._note(self._lock)
        os.close(held)

    def _note(self, descriptor: int) -> None:
        """Write the process and the newest revision into the lock file: a damaged state can't tell the revision."""
        revision = b"" if self._newest_revision is None else b" %d" % self._newest_revision
        note = b"%d%s\n" % (os.getpid(), revision)
        with contextlib.suppress(OSError):  # a full disk: the lock still holds, only its owner can't be named
            os.pwrite(descriptor, note, 0)
            os.ftruncate(descriptor, len(note))

    def _read(self, fresh: bool) -> None:
        if self._usable:
            with contextlib.suppress(OSError):  # leftovers do no harm
                remove_leftovers(self._path)
        try:
            data = self._bytes()
        except FileNotFoundError:
            return
        except OSError as error:
            self._give_up(f"{self._path} can't be read: {error.strerror or error}")
            self._notice(f"{self.failure}; started from the configured reference")
            return
        try:
            kept = unpack(data)
        except ValueError as error:
            aside = self._set_aside("damaged")
            count = "revisions count from the start again"
            if self._newest_revision is not None:
                self.configured = msgspec.structs.replace(self.configured, revision=1 + self._newest_revision)
                count = f"as revision {self.configured.revision}"
            self._notice(
                f"the state file {self._path} is damaged: {error}; {aside}; started from the configured reference, "
                f"{count}"
            )
            return
        if (kept.owner.robot, kept.owner.camera) != (self._owner.robot, self._owner.camera):
            raise StateFileError(
                f"{self._path} is the state of {kept.owner.robot}/{kept.owner.camera}, not of {self._owner.robot}/"
                f"{self._owner.camera}; a file of its own for each monitor"
            )
        changed = self._what_changed(kept.owner.calibration)
        if not changed and not fresh:
            self.state = kept.state
            return
        why = f"of another calibration ({changed} changed since)" if changed else "not wanted"
        aside = self._set_aside("replaced", until_written=True)
        revision = 1 + kept.state.references[-1].revision
        self.configured = msgspec.structs.replace(self.configured, revision=revision)
        self._notice(
            f"the state file {self._path} is {why}; {aside}; started from the configured reference as revision "
            f"{revision}"
        )

    def _bytes(self) -> bytes:
        """The file's content.  A pipe or a folder is not a state file, and reading a pipe would block."""
        mode = self._path.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a folder" if stat.S_ISDIR(mode) else "no regular file"
            raise StateFileError(f"{self._path} is {kind}; a file")
        with self._path.open("rb") as file:
            return file.read(LARGEST_BYTES)

    def _what_changed(self, kept: Calibration) -> str:
        now = self._owner.calibration
        parts = (
            ("the camera model", kept.camera == now.camera),
            ("the gripper file", kept.gripper == now.gripper),
            ("the configured reference", kept.reference == now.reference),
        )
        return ", ".join(name for name, same in parts if not same)

    def _set_aside(self, why: str, *, until_written: bool = False) -> str:
        """Rename the file in its folder; returns what happened to it.

        ``until_written``: the file also keeps its own name until it is overwritten: only it holds the revisions.
        """
        if not self._usable:
            return "not used"
        number = 1
        while (target := self._path.with_name(f"{self._path.name}.{why}-{number}")).exists() or target.is_symlink():
            number += 1
        try:
            if not (until_written and _linked(self._path, target)):
                self._path.rename(target)
        except OSError as error:
            self._give_up(f"{self._path} can't be set aside: {error.strerror or error}")
            return "not used"
        return f"set aside as {target.name}"

    def _notice(self, text: str) -> None:
        self.notices = (*self.notices, text)

    def _give_up(self, failure: str) -> None:
        self._usable = False
        self._fail(failure)

    def _fail(self, failure: str) -> None:
        failure = f"state not kept: {failure}"
        if failure != self.failure:
            self.failure = failure
            _log.error("%s", failure)


def _noted(descriptor: int) -> tuple[int | None, int | None]:
    """Process and newest revision in a lock file; None each where it isn't a number."""
    words = os.pread(descriptor, 64, 0).split()
    numbers = [int(word) if word.isdigit() and len(word) <= _MOST_DIGITS else None for word in words]
    holder, revision, *_ = (*numbers, None, None)
    return holder, revision


def _linked(path: Path, other: Path) -> bool:
    """Hard-link the file to the other name; False where the file system can't."""
    try:
        other.hardlink_to(path)
    except OSError:
        return False
    return True
