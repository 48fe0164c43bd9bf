"""How long work tells that it goes on: whoever calls it decides how that is shown."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

Progress = Callable[[int | None, str], AbstractContextManager[Callable[[], None]]]
"""From the number of steps (None: unknown) and their unit to a context, which gives a function to call at each step."""


def quiet(_total: int | None, _unit: str) -> AbstractContextManager[Callable[[], None]]:
    """Shows nothing."""
    return nullcontext(lambda: None)
