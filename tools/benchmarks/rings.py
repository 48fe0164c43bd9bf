"""Rendered frames on the disk, each kind once, and new processes to measure in."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

_T = TypeVar("_T")


class Rings:
    """Files with frames of the benchmarks' scene, rendered when they are first asked for."""

    def __init__(self, scratch: Path) -> None:
        self._scratch = scratch

    def of(self, size: tuple[int, int], count: int, kind: str = "clutter") -> Path:
        """A file with ``count`` frames of a kind (:data:`benchmarks.scene.KINDS`)."""
        path = self._scratch / f"{size[0]}x{size[1]}-{count}-{kind}.npz"
        if not path.exists():
            render(size, count, path, kind)
        return path


def render(size: tuple[int, int], count: int, path: Path, kind: str = "clutter") -> None:
    """Frames of the benchmarks' scene into a file."""
    from tqdm import tqdm

    from benchmarks import scene

    title = f"render {size[0]}x{size[1]} {kind}"
    with tqdm(total=count, desc=title, unit="frame", file=sys.stderr, disable=None) as bar:
        scene.render(size, count, bar.update, kind=kind).save(path)


def in_new_process(function: Callable[..., _T], *arguments: Any) -> _T:
    """What a function of a module returns, called where nothing else has run before."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context, initializer=_quiet) as pool:
        return pool.submit(function, *arguments).result()


def _quiet() -> None:
    """Half an hour of creep passes in seconds: its alerts are published, but not also printed."""
    import logging

    import cv2

    logging.getLogger("gripmon").setLevel(logging.CRITICAL)
    cv2.setNumThreads(1)
