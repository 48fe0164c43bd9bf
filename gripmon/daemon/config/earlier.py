"""Keys of earlier versions: a file that still has them is read as if it hadn't, with a line that says so."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)


def without_gone(path: Path, values: dict[str, Any], *, say: bool) -> dict[str, Any]:
    """The content of a configuration without the keys that are gone.

    ``say``: log a line for each of them; otherwise, for a file that nobody can edit, only for those that had an effect.
    """
    monitor = values.get("monitor")
    if not isinstance(monitor, dict) or "look" not in monitor:
        return values
    look = monitor["look"]
    used = isinstance(look, dict) and look.get("enabled") is True
    if say or used:
        effect = "; transforms come from the edges alone" if used else ""
        _log.warning("%s: monitor.look: the look as a measurement is gone%s; remove the section", path, effect)
    return values | {"monitor": {key: value for key, value in monitor.items() if key != "look"}}
