"""Machine code, by numba, for the per-frame arithmetic.

Numba caches compiled code beside the sources, in the user's cache or in ``NUMBA_CACHE_DIR``, and checks only a
function's own file for changes.  Compiled functions that call one another must therefore share a file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., Any])


def compiled(function: _F) -> _F:
    """Compile ``function`` at its first call for each set of argument types.

    Arithmetic is done as written, neither fused nor reordered, so that a replay on another machine decides the same;
    division by zero behaves as in NumPy.  The GIL is held: reacquiring it takes longer than a kernel runs.
    """
    try:
        made: Any = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # no folder for the cache: every start compiles
        made = numba.njit(error_model="numpy")(function)
    return cast("_F", made)
