"""Machine code, by numba, for the per-frame arithmetic.

Numba keeps compiled code beside the sources, in the user's cache or in ``NUMBA_CACHE_DIR``, and notices changes in a
function's own file.  What is kept beside the sources is loaded also where nothing may be written.  What else is
compiled into a function, the constants and functions that it names, belongs to the key here, so that a changed constant
of another file is noticed.  Several processes may compile and load at once.

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
from typing import Any, ClassVar, Protocol, TypeVar, cast

import numba
import numpy as np
from llvmlite import binding as llvm
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    NullCache,
    _CacheLocator,
    _SourceFileBackedLocatorMixin,
)
from numba.core.codegen import JITCodeLibrary

_F = TypeVar("_F", bound=Callable[..., Any])

FUNCTIONS: list[Any] = []
"""Every compiled function of the modules that were imported."""

_INDEX_PATIENCE_S = 5.0  # its holder writes a few kB; one that was stopped meanwhile holds up nobody for good


_NO_BITCODE = llvm.parse_assembly("").as_bitcode()


class Watcher(Protocol):
    """Is told what happens to the functions, by name."""

    def missing(self, name: str) -> bool:
        """Nothing is kept, so it would be compiled next; whether to look first once more."""

    def ready(self, name: str) -> None:
        """It was loaded, or compiled."""


class Watched:
    """A cache of numba whose hits and misses are told to a watcher."""

    watcher: ClassVar[Watcher | None] = None
    _py_func: Any  # the function in Python

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


class Unkept(Watched, NullCache):
    """Where there is no folder for the cache."""

    def __init__(self, py_func: Callable[..., Any]) -> None:
        self._py_func = py_func


class _Loaded(JITCodeLibrary):
    """Machine code that was loaded.  Its bitcode, which only a caller that is compiled later needs, is parsed for the
    first such caller: of a monitor that takes 2 of 5 parts of the time to load, and 25 MB for as long as it runs.
    """

    _bitcode = b""

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        name, kind, (code, bitcode) = state
        made: Any = super()._unserialize(codegen, (name, kind, (code, _NO_BITCODE)))  # type: ignore[no-untyped-call]
        made._shared_module, made._bitcode = None, bitcode
        return made

    def _get_module_for_linking(self) -> Any:
        if self._bitcode:
            codegen: Any = self._codegen
            self._shared_module = llvm.parse_bitcode(self._bitcode)
            codegen._engine._load_defined_symbols(self._shared_module)
            self._bitcode = b""
        return super()._get_module_for_linking()  # type: ignore[no-untyped-call]


class _Installed(_SourceFileBackedLocatorMixin, _CacheLocator):
    """Beside the sources, where somebody else may have compiled when the program was installed."""

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        self._py_file, self._lineno = py_file, py_func.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        return str(Path(self._py_file).parent / "__pycache__")

    def ensure_cache_path(self) -> None:
        if not Path(self.get_cache_path()).is_dir():
            raise FileNotFoundError(self.get_cache_path())


class _LoadedByNeed(CompileResultCacheImpl):
    _locator_classes = [*CompileResultCacheImpl._locator_classes, _Installed]  # noqa: RUF012

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Called with numba's compiler locked."""
        codegen, (_, function, *_) = target_context.codegen(), payload
        codegen._engine._defined_symbols |= {function.llvm_func_name, function.llvm_cpython_wrapper_name}
        codegen._library_class = _Loaded
        try:
            return super().rebuild(target_context, payload)  # type: ignore[no-untyped-call]
        finally:
            del codegen._library_class


class Kept(Watched, FunctionCache):
    """Numba's cache with constants in its key, in which index and code of a function change together.

    Numba writes the index first: two processes would give one file's name to two sets of argument types, and one that
    reads meanwhile would take older code for the new.
    """

    _impl_class = _LoadedByNeed

    def __init__(self, py_func: Callable[..., Any]) -> None:
        """Raises RuntimeError or OSError where there is neither a folder to write to nor one beside the sources."""
        super().__init__(py_func)  # type: ignore[no-untyped-call]
        made: Any = self._impl
        beside = _Installed(py_func, py_func.__code__.co_filename).get_cache_path()
        self.keeps = not isinstance(made.locator, _Installed)
        """Whether there is a folder to write to."""
        self._beside: Any = None
        if beside != self._cache_path:
            stamp = made.locator.get_source_stamp()
            self._beside = IndexDataCacheFile(beside, made.filename_base, stamp)  # type: ignore[no-untyped-call]

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return *super()._index_key(sig, codegen), fingerprint(self._py_func)  # type: ignore[no-untyped-call]

    def _load(self, sig: Any, target_context: Any) -> Any:
        with self._index(fcntl.LOCK_SH):
            found = FunctionCache.load_overload(self, sig, target_context)  # type: ignore[no-untyped-call]
        if found is None and self._beside is not None:
            key = self._index_key(sig, target_context.codegen())
            with contextlib.suppress(OSError):
                data = self._beside.load(key)
                found = None if data is None else self._impl.rebuild(target_context, data)
        return found

    def _save(self, sig: Any, data: Any) -> None:
        if not self.keeps:
            return
        with self._index(fcntl.LOCK_EX):
            FunctionCache.save_overload(self, sig, data)  # type: ignore[no-untyped-call]

    def _index(self, how: int) -> contextlib.AbstractContextManager[bool]:
        return locked(Path(self._cache_path) / "gripmon-index.lock", how, _INDEX_PATIENCE_S)


def compiled(function: _F) -> _F:
    """Compile ``function`` at its first call for each set of argument types.

    Arithmetic is done as written, neither fused nor reordered, so that a replay on another machine decides the same;
    division by zero behaves as in NumPy.  The GIL is held: reacquiring it takes longer than a kernel runs.
    """
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]  # for a debugger
        return function
    made: Any = numba.njit(error_model="numpy")(function)
    try:
        made._cache = Kept(function)
    except (RuntimeError, OSError):  # every start compiles
        made._cache = Unkept(function)
    FUNCTIONS.append(made)
    return cast("_F", made)


def _name_of(function: Any) -> str:
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
