"""What gripmon uses of rerun-sdk 0.41 that rerun doesn't call public, all in this file: a later version may lack it."""

from __future__ import annotations

from typing import Any

RIGHT = "gripmon needs rerun-sdk>=0.41,<0.42 (pip install 'rerun-sdk>=0.41,<0.42')"


class RerunChangedError(RuntimeError):
    """The installed rerun lacks what is needed; says what, and which version would be right."""


def chunk_index(store: Any) -> Any:
    """The record batch of a file's footer, a row for each chunk, of a :class:`rerun.chunk.LazyStore`.

    The public ``summary`` has neither the bytes nor the frames of a chunk, without which every file is read whole.
    """
    return _known(store, "_chunk_index", "LazyStore")().to_arrow()


def free_closed_streams() -> None:
    """Let go of streams that were disconnected: rerun would keep each with its threads until the process ends."""
    import rerun as rr

    _known(getattr(rr, "bindings", None), "flush_and_cleanup_orphaned_recordings", "rerun.bindings")()


def _known(owner: Any, name: str, where: str) -> Any:
    found = getattr(owner, name, None)
    if found is None:
        import rerun as rr

        raise RerunChangedError(f"rerun-sdk {rr.__version__} has no {where}.{name}; {RIGHT}")
    return found
