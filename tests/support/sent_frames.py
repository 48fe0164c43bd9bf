"""Small images and attachments, as a driver sends them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

WIDTH, HEIGHT = 40, 30


def grey(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH), np.uint8)


def colour(seed: int = 0, dtype: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, (HEIGHT, WIDTH, 3), dtype, endpoint=True)


def note(**fields: Any) -> bytes:
    return json.dumps(fields).encode()


def raw_note(encoding: str = "mono8", **more: Any) -> bytes:
    return note(width=WIDTH, height=HEIGHT, encoding=encoding, **more)
