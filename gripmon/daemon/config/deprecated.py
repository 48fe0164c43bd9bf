"""Settings of earlier versions, and what stands for them now."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import msgspec

from gripmon.daemon.config.settings import Settings
from gripmon.daemon.config.typed import Fault

_log = logging.getLogger(__name__)

_OLD, _NEW = "suspect_sigma_m", "alert_limit_m"
_SECTION = "monitor.policy"
_LARGEST_LIMIT_M = 1.0


def with_alert_limit(path: Path, values: dict[str, Any], settings: Settings, *, say: bool) -> Settings | Fault:
    """The settings with ``alert_limit_m`` in place of ``suspect_sigma_m``; ``say``: a warning names both.

    ``values`` is what the file holds: with both of them nobody knows which is meant.
    """
    policy = settings.monitor.policy
    if policy.suspect_sigma_m is None:
        return settings
    limit_m = round(policy.position_limit_m, 6)
    if _NEW in values["monitor"]["policy"]:
        return Fault(f"{_SECTION}.{_OLD}", f"stands beside {_NEW}, which replaces it", f"{_NEW} alone")
    if not 0.0 < limit_m <= _LARGEST_LIMIT_M:
        wrong = f"{policy.suspect_sigma_m:g} stands for {_NEW}: {limit_m:g}, which is not within 0 and 1"
        return Fault(f"{_SECTION}.{_OLD}", wrong, f"{_NEW}, the error that the task bears (m)")
    if say:
        _log.warning(
            "%s: %s.%s: %g is deprecated; write %s: %g, which it stands for",
            path, _SECTION, _OLD, policy.suspect_sigma_m, _NEW, limit_m,
        )  # fmt: skip
    policy = msgspec.structs.replace(policy, alert_limit_m=limit_m, suspect_sigma_m=None)
    monitor = msgspec.structs.replace(settings.monitor, policy=policy)
    return msgspec.structs.replace(settings, monitor=monitor)
