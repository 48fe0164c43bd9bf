"""Machine code for the frames' arithmetic, loaded or compiled before the first frame."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from gripmon.judge import drift, repeats, smoothing, stream
from gripmon.model import poses
from gripmon.track import edges, integrity, look

_log = logging.getLogger(__name__)

LOADED_WITHIN_S = 2.0
"""A longer warm-up has compiled something, not only loaded it."""

MOST_UNKEPT = 1000
"""Bound on retries for functions that can't be kept on the disk: more than there are functions."""


def warm_up() -> str:
    """Load the machine code that frames need, or compile it, which takes a minute, once on a machine; return a message
    for the user, or an empty string.
    """
    begin_s = time.perf_counter()
    unkept = ""
    patience = threading.Timer(LOADED_WITHIN_S, _log.info, ["compiling what every frame needs: about a minute, once"])
    patience.daemon = True
    patience.start()
    for part in (edges, integrity, look, drift, smoothing, stream, repeats, poses):
        unkept = _warm(part.warm_up) or unkept
    patience.cancel()
    took_s = time.perf_counter() - begin_s
    _log.debug("the arithmetic of frames was ready after %.1f s", took_s)
    if took_s < LOADED_WITHIN_S:
        return ""
    text = f"what every frame needs was compiled, in {took_s:.0f} s"
    if unkept:
        return f"{text}; it can't be kept ({unkept}), so that every start takes as long: set NUMBA_CACHE_DIR"
    return f"{text}; the next start loads it"


def _warm(part: Callable[[], object]) -> str:
    """Run one part's warm-up; return why its code could not be kept on the disk, or an empty string."""
    unkept = ""
    for _ in range(MOST_UNKEPT):
        try:
            part()
        except OSError as error:  # raised after a function was compiled: it works from then on
            unkept = error.strerror or str(error)
        else:
            break
    return unkept
