"""Machine code for the arithmetic that every frame needs, by numba; without it NumPy does the same, more slowly.

Numba keeps what it has compiled beside the sources, in the user's cache or in ``NUMBA_CACHE_DIR``, and goes by the file
of a function alone to see whether it has changed: compiled functions that call one another stand in one file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

try:
    import numba
except ImportError:  # no build of it for this machine
    COMPILES = False
else:
    COMPILES = not getattr(numba.config, "DISABLE_JIT", False)

_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """``function``, compiled when it is first called with arguments of some types; as it is where nothing compiles.

    Arithmetic is as written, neither fused nor reordered, so that a replay on another machine decides alike; a division
    by zero gives what NumPy's does.  The interpreter stays locked meanwhile: to get it back takes longer than a kernel.
    """
    if not COMPILES:
        return function
    try:
        made: Any = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # no folder in which it could be kept: every start compiles
        made = numba.njit(error_model="numpy")(function)
    return cast("_F", made)
