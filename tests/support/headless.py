"""A headless Chromium that loads a page and takes its picture, driven as ``tools/screenshot_recording`` does."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import shutil
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

TOOL = Path(__file__).resolve().parents[2] / "tools" / "screenshot_recording"
needs_chromium = pytest.mark.skipif(shutil.which("chromium") is None, reason="needs the browser chromium")


def _tool() -> ModuleType:
    loader = importlib.machinery.SourceFileLoader("screenshot_recording", str(TOOL))
    spec = importlib.util.spec_from_loader(loader.name, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def picture_of(url: str, wait_s: float) -> np.ndarray:
    """What a person sees there after a while, BGR."""
    png = _tool().screenshot(f"{url}&renderer=webgl", 1000, 700, wait_s, None)
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture
