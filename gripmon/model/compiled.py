"""Machine code, by numba, for the per-frame arithmetic.

Numba keeps compiled code beside the sources, in the user's cache or in ``NUMBA_CACHE_DIR``, and notices changes in a
function's own file.  What else is compiled into it, the constants and functions that it names, belongs to the key here,
so that a changed constant of another file is noticed.  Several processes may compile and load at once.

Assigning an array to a slice is avoided: for its error message numba compiles the joining of texts, which takes longer
than the function (3 of 54 s of processor time for the first one).
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar, cast

import numba
import numpy as np
from numba.core.caching import FunctionCache, NullCache

_F = TypeVar("_F", bound=Callable[..., Any])

FUNCTIONS: list[Any] = []
"""Every compiled function of the modules that were imported."""

_INDEX_PATIENCE_S = 5.0  # its holder writes a few kB; one that was stopped meanwhile holds up nobody for good


class Watcher(Protocol):
    """Is told what happens to the functions, by name."""

    def missing(self, name: str) -> bool:
        """Nothing is kept, so it would be compiled next; whether to look first once more."""

    def ready(self, name: str) -> None:
        """It was loaded, or compiled."""


class Watched:
    """A cache of numba whose hits and misses are told to a watcher."""

    watcher: ClassVar[Watcher | None] = None
    _py_func: FunctionType

    if TYPE_CHECKING:
        cache_path: str | None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        watcher, name = Watched.watcher, _name_of(self._py_func)
        found = self._load(sig, target_context)
        if found is None and watcher is not None and watcher.missing(name):
            found = self._load(sig, target_context)
        if found is not None and watcher is not None:
            watcher.ready(name)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            self._save(sig, data)
        finally:  # what can't be kept is compiled all the same
            if Watched.watcher is not None:
                Watched.watcher.ready(_name_of(self._py_func))

    def _load(self, _sig: Any, _target_context: Any) -> Any:
        return None

    def _save(self, _sig: Any, _data: Any) -> None:
        """Nothing is kept."""


class Unkept(Watched, NullCache):  # type: ignore[misc]
    """Where there is no folder for the cache."""

    def __init__(self, py_func: FunctionType) -> None:
        self._py_func = py_func


class Kept(Watched, FunctionCache):  # type: ignore[misc]
    """Numba's cache with constants in its key, in which index and code of a function change together.

    Numba writes the index first: two processes would give one file's name to two sets of argument types, and one that
    reads meanwhile would take older code for the new.
    """

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return *super()._index_key(sig, codegen), fingerprint(self._py_func)

    def _load(self, sig: Any, target_context: Any) -> Any:
        with self._index(fcntl.LOCK_SH):
            return FunctionCache.load_overload(self, sig, target_context)

    def _save(self, sig: Any, data: Any) -> None:
        with self._index(fcntl.LOCK_EX):
            FunctionCache.save_overload(self, sig, data)

    def _index(self, how: int) -> contextlib.AbstractContextManager[bool]:
        return locked(Path(self._cache_path) / "gripmon-index.lock", how, _INDEX_PATIENCE_S)


def compiled(function: _F) -> _F:
    """Compile ``function`` at its first call for each set of argument types.

    Arithmetic is done as written, neither fused nor reordered, so that a replay on another machine decides the same;
    division by zero behaves as in NumPy.  The GIL is held: reacquiring it takes longer than a kernel runs.
    """
    made: Any = numba.njit(error_model="numpy")(function)
    try:
        made._cache = Kept(function)
    except (RuntimeError, OSError):  # no folder for the cache: every start compiles
        made._cache = Unkept(function)
    FUNCTIONS.append(made)
    return cast("_F", made)


def _name_of(function: FunctionType) -> str:
    """``integrity.kernel.follow``"""
    return f"{'.'.join(function.__module__.split('.')[-2:])}.{function.__qualname__}"


def fingerprint(function: FunctionType) -> str:
    """Digest of the constants that a function names, and of the functions that it calls, each with theirs."""
    digest = hashlib.sha256()
    for part in _parts_of(function, {function}):
        digest.update(part)
        digest.update(b"\0")
    return digest.hexdigest()


def _parts_of(function: FunctionType, seen: set[FunctionType]) -> Iterator[bytes]:
    for name, value in sorted(_named(function.__code__, function.__globals__), key=lambda item: item[0]):
        callee = getattr(value, "py_func", value)
        if isinstance(value, bool | int | float | complex | str | tuple):
            yield f"{name}={value!r}".encode()
        elif isinstance(value, np.ndarray):
            yield name.encode() + value.tobytes()
        elif isinstance(callee, FunctionType) and callee not in seen:
            seen.add(callee)
            yield name.encode() + callee.__code__.co_code + repr(_literals(callee.__code__)).encode()
            yield from _parts_of(callee, seen)


def _named(code: CodeType, within: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """The global values that code names, also of this package's modules."""
    for name in code.co_names:
        value = within.get(name)
        if isinstance(value, ModuleType) and value.__name__.partition(".")[0] == __name__.partition(".")[0]:
            yield from ((f"{name}.{of}", vars(value)[of]) for of in code.co_names if of in vars(value))
        elif value is not None:
            yield name, value
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _named(inner, within)


def _literals(code: CodeType) -> tuple[Any, ...]:
    return tuple((c.co_code, _literals(c)) if isinstance(c, CodeType) else c for c in code.co_consts)


@contextlib.contextmanager
def locked(path: Path, how: int, patience_s: float, waits: Callable[[], None] = lambda: None) -> Iterator[bool]:
    """Hold a lock among processes, ``how`` of ``fcntl.LOCK_EX`` and ``LOCK_SH``; False without it: where no file can be
    made, which then isn't written either, or after ``patience_s``.  It ends with its process.  ``waits`` is called
    again and again meanwhile.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        yield False
        return
    try:
        yield _lock(descriptor, how, patience_s, waits)
    finally:
        os.close(descriptor)


def _lock(descriptor: int, how: int, patience_s: float, waits: Callable[[], None]) -> bool:
    end_s, pause_s = time.monotonic() + patience_s, 0.001
    while True:
        try:
            fcntl.flock(descriptor, how | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= end_s:
                return False
        except OSError:  # a file system without locks
            return False
        else:
            return True
        waits()
        time.sleep(pause_s)
        pause_s = min(2.0 * pause_s, 0.1)
