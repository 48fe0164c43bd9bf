"""``--recording FILE``: one whole file, or what was there before."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Sequence
from pathlib import Path

from gripmon.cli import common


def keep(written: Sequence[Path], path: Path, failure: str | None, *, whole: bool = True) -> None:
    """Give a finished recording its name.

    One that isn't ``whole``, lacks its footer, or went into several files because writing failed in between, is
    removed, and the command ends with one line and exit code 3.  ``failure`` is what the recorder says of it.
    """
    from gripmon.record.write.repair import is_complete

    reason = failure
    try:
        if whole and len(written) == 1 and is_complete(written[0]):
            written[0].replace(path)
            return
    except OSError as error:
        reason = error.strerror
    # rerun only says that its thread has ended: the room there is explains the rest.
    with contextlib.suppress(OSError):
        reason = f"{_cause(reason)}; its disk has {1e-6 * shutil.disk_usage(path.parent).free:.1f} MB free"
    for part in written:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    raise common.CommandFailedError(f"--recording {path}: writing failed ({_cause(reason)})")


def _cause(said: str | None) -> str:
    """The last part: before it stands a path that nobody has asked for."""
    return " ".join((said or "it was not finished").rpartition(": ")[2].split())
