"""``--recording FILE``: one whole file, or what was there before."""

from __future__ import annotations

from typing import Any


def keep(*parts: Any, **how: Any) -> None:
    """See :func:`gripmon.record.write.repair.keep_whole`."""
    from gripmon.record.write.repair import keep_whole

    keep_whole(*parts, **how)
