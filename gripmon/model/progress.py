"""Progress callbacks: long work reports its steps, and the caller decides how to show them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

Progress = Callable[[int | None, str], AbstractContextManager[Callable[[], None]]]
"""From the number of steps (None: unknown) and their unit to a context, which gives a function to call per step."""


def quiet(_total: int | None, _unit: str) -> AbstractContextManager[Callable[[], None]]:
    """Show nothing."""
    return nullcontext(lambda: None)
