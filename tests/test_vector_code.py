"""Decisions don't hang on last digits: the tests of tracking, search and integrity pass on lesser processors, too.

OpenCV, NumPy and OpenBLAS choose their vector code by the processor, and round differently.  Here a process is told to
do without; numba's code rounds as it is written, whatever the processor (``gripmon.model.compiled``).
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
DECISIONS = (
    "test_gripper_library.py::test_a_library_gripper_is_tracked[adaptive_two_finger_85-0.0002]",
    "test_search.py::test_random_jumps_are_found_and_never_a_wrong_place_is_trusted",
    "test_monitor.py::test_a_bump_is_a_jump_then_a_recalibration_near_the_truth[edges]",
    "test_trust.py::test_a_knock_along_the_fingers_in_free_view_is_followed_and_never_promised_away[-0.003-3]",
    "test_causes_images.py::test_the_camera_is_named_when_it_moved[motion0]",
)
# Dispatched (*), and neither disabled nor absent (?).
OPENCV_HAS = [name[1:] for name in cv2.getCPUFeaturesLine().split() if name[0] == "*" and name[-1] != "?"]
NUMPY_HAS = [
    name for name in np._core._multiarray_umath.__cpu_dispatch__ if np._core._multiarray_umath.__cpu_features__[name]
]


def without(newer_than_avx2: bool) -> dict[str, str]:
    """The environment of a process that does without vector code: all of it, or what first-generation EPYCs lack."""
    opencv = [name for name in OPENCV_HAS if not newer_than_avx2 or name.startswith("AVX512")]
    numpy = [name for name in NUMPY_HAS if not newer_than_avx2 or name.startswith(("AVX512", "X86_V4"))]
    own = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    own |= {"OPENCV_CPU_DISABLE": ",".join(opencv), "NPY_DISABLE_CPU_FEATURES": ",".join(numpy)}
    if platform.machine() == "x86_64":
        own["OPENBLAS_CORETYPE"] = "Haswell" if newer_than_avx2 else "Nehalem"
    return own


def run(environment: dict[str, str], *arguments: str) -> str:
    done = subprocess.run([sys.executable, *arguments], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_process_told_to_do_without_does_so():
    """Their names change with the libraries' versions; what isn't known is left as it is, with a warning."""
    own = without(newer_than_avx2=False) | {"PYTHONPATH": "tests"}
    told = run(own, "-c", "from test_vector_code import *; print(OPENCV_HAS, NUMPY_HAS)")
    assert told == "[] []\n"


@pytest.mark.parametrize(
    "newer_than_avx2",
    [False, pytest.param(True, marks=pytest.mark.slow("15 s; without any is in the default run"))],
)
def test_decisions_are_the_same_without_vector_code(newer_than_avx2: bool):
    paths = [f"tests/{name}" for name in DECISIONS]
    told = run(without(newer_than_avx2), "-m", "pytest", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", *paths)
    assert "skipped" not in told
