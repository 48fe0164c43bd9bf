"""Why a row of ``tools/bench accuracy`` misses what is to be reached: found by looking, shown beside the verdict."""

from __future__ import annotations

WHY: dict[str, str] = {}
