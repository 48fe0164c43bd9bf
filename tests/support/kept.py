"""Rendered images, kept between files, workers and runs under a hash of what made them: the arguments, the sources of
simulator and tests, libraries, and the vector code that these use.  In the user's cache; ``GRIPMON_KEPT=`` keeps none.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import cv2
import numpy as np

P = ParamSpec("P")
R = TypeVar("R")
ROOT = Path(__file__).resolve().parents[2]
MADE_BY = ("gripmon/model", "gripmon/simulate", "gripmon/daemon", "gripmon/cli", "configs", "tests/support")
MOST_BYTES = 1_000_000_000
_SET = os.environ.get("GRIPMON_KEPT")
FOLDER = Path(_SET or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gripmon-tests"


@functools.lru_cache(maxsize=1)
def _sources() -> bytes:
    made = hashlib.sha256(f"{cv2.__version__} {np.__version__} {cv2.getCPUFeaturesLine()}".encode())
    made.update(os.environ.get("NPY_DISABLE_CPU_FEATURES", "").encode())
    for folder in MADE_BY:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".yaml"):
                made.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    return made.digest()


def _place(function: Callable[..., Any], *arguments: object) -> Path:
    name = f"{function.__module__}.{function.__qualname__}".encode()
    return FOLDER / hashlib.sha256(_sources() + name + pickle.dumps(arguments)).hexdigest()


def kept(function: Callable[P, R]) -> Callable[P, R]:
    """A pure function whose results are images, or hold some."""

    @functools.wraps(function)
    def result_of(*args: P.args, **kwargs: P.kwargs) -> R:
        if _SET == "":
            return function(*args, **kwargs)
        path = _place(function, args, sorted(kwargs.items()))
        with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError):
            found: R = pickle.loads(path.read_bytes())
            os.utime(path)
            return found
        result = function(*args, **kwargs)
        with _made(path) as unfinished:
            unfinished.write_bytes(pickle.dumps(result, protocol=5))
        return result

    return result_of


def copied(function: Callable[..., object], folder: Path, *args: object) -> None:
    """What ``function(folder, *args)`` writes, written into this folder, which doesn't exist yet."""
    if _SET == "":
        function(folder, *args)
        return
    place = _place(function, args)
    if not place.is_dir():
        with _made(place) as unfinished:
            function(unfinished, *args)
    os.utime(place)
    shutil.copytree(place, folder)


@contextlib.contextmanager
def _made(place: Path) -> Iterator[Path]:
    """Where to write what is at ``place`` afterwards, as a whole, also if others make the same."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=FOLDER, prefix="unfinished-") as beside:
        yield Path(beside) / "made"
        with contextlib.suppress(OSError):  # a folder that another process has made meanwhile
            (Path(beside) / "made").rename(place)


def forget_the_oldest() -> None:
    """Down to :data:`MOST_BYTES`; also what a killed process left."""
    sized = []
    for place in FOLDER.glob("*"):
        with contextlib.suppress(OSError):
            files = [place, *place.rglob("*")]
            sized.append((place.stat().st_mtime, sum(file.stat().st_size for file in files), place))
    total = 0
    for _, size, place in sorted(sized, reverse=True):
        total += size
        if total > MOST_BYTES:
            if place.is_dir():
                shutil.rmtree(place, ignore_errors=True)
            else:
                place.unlink(missing_ok=True)
