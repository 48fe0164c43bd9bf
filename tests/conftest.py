"""For all tests."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

# A shell's background job ignores Ctrl-C, and so would the processes that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _state_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No test finds what another one, or the user's own monitor, keeps over restarts."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state-home"))
