"""Threads that decode their first messages at the same moment: two clients, a fleet's links, a page's requests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SAMPLES = Path(__file__).parent / "wire_samples"

HEAD = """
import sys, threading
from pathlib import Path
sys.setswitchinterval(1e-6)  # threads take turns in the middle of whatever they do

def at_once(tasks):
    start = threading.Barrier(len(tasks))
    def run(task):
        start.wait()
        task()
    threads = [threading.Thread(target=run, args=(task,)) for task in tasks]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    print(len(tasks), "done", flush=True)
"""

MESSAGES = """
from gripmon.model.records import MESSAGES, from_json
def reading(path):
    message, payload = MESSAGES[path.stem], path.read_bytes()
    return lambda: from_json(payload, message)
at_once([reading(path) for path in sorted(Path(sys.argv[1]).glob("*.json")) if path.stem in MESSAGES for _ in range(6)])
"""

SETTINGS = """
from gripmon.daemon.config.typed import to_settings
from gripmon.monitor.settings import MonitorSettings
at_once([lambda: to_settings({"corners": {}, "policy": {}}, MonitorSettings)] * 16)
"""


@pytest.mark.parametrize("tasks", [MESSAGES, SETTINGS], ids=["messages", "settings"])
def test_the_first_decoding_may_happen_in_many_threads_at_once(tasks: str):
    """Four starts each: with decoders made at first use 9 of 12 that read messages, and 6 of 12 that read settings,
    ended with a segmentation fault.
    """
    for _ in range(4):
        done = subprocess.run(
            [sys.executable, "-X", "faulthandler", "-c", HEAD + tasks, str(SAMPLES)],
            capture_output=True,
            text=True,
            timeout=120.0,
            cwd=Path(__file__).parent.parent,
        )
        assert done.returncode == 0 and "done" in done.stdout, done.stderr[-1500:]
