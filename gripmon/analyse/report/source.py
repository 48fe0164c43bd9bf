"""What a report is made from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from gripmon.model.records import RecordedConfiguration
from gripmon.record.read import RecordedRun

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from gripmon.record.read import Picture


class Source(RecordedRun, Protocol):
    """One run of one monitor, as :class:`gripmon.record.read.Recording` is."""

    @property
    def files(self) -> Sequence[Path]: ...
    @property
    def configuration(self) -> RecordedConfiguration | None: ...
    @property
    def faults(self) -> Sequence[str]: ...
    @property
    def gaps(self) -> Sequence[str]:
        """Those of the faults that tell of frames whose numbers are missing."""

    @property
    def image_seqs(self) -> NDArray[np.int64]: ...
    def picture(self, seq: int) -> Picture | None:
        """The image of a frame with its overlay; None if it isn't recorded."""


def main_text(source: Source) -> str | None:
    """The text of the recorded configuration's main file; None if there is none."""
    configuration = source.configuration
    file = None if configuration is None else configuration.files.get(configuration.main)
    if file is None:
        return None
    try:
        return file.data.decode("utf-8", "replace")
    except ValueError:
        return None
