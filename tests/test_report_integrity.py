"""What a report says of how large errors may have been."""

from __future__ import annotations

import dataclasses
import re

import msgspec
import numpy as np
import pytest
from support.reported import Run, records, stepped

from gripmon.analyse.build import build
from gripmon.analyse.page import page
from gripmon.model.records import Protection, RecordedConfiguration, Verdict
from gripmon.model.records.recorded import RecordedFile


def test_protection_levels_stand_with_their_limits_and_shares():
    """Of 400 frames 100 are above the limit of 1 mm and suspect, 40 measure nothing."""
    shifts_m = np.zeros((400, 3))
    shifts_m[360:] = np.nan
    run = records(shifts_m)
    for i, record in enumerate(run[:360]):
        bound = Protection(4e-3 if i < 100 else 2e-4, 0.005, 1e-5, "nothing is wrong")
        verdict = Verdict.SUSPECT if i < 100 else Verdict.VALID
        run[i] = msgspec.structs.replace(record, protection=bound, verdict=verdict)
    text = "monitor:\n  policy:\n    alert_limit_m: 0.001\n"
    told_run = Run(run, configuration=RecordedConfiguration("main.yaml", {"main.yaml": RecordedFile(text)}))
    report, told = build([told_run])
    (recording,) = report.recordings
    assert (recording.limits.alert_limit_m, recording.limits.alert_limit_rad) == (1e-3, 0.035)
    found = recording.integrity
    assert (found.frames, found.valid, found.within, found.risk) == (360, 260 / 400, 260 / 400, 1e-5)
    assert (found.median_m, found.p99_m, found.median_rad) == (2e-4, 4e-3, 0.005)
    curve = next(c for c in recording.curves if c.name == "protection_m")
    assert curve.middle[0] == 4e-3 and curve.middle[200] == 2e-4 and curve.middle[-1] is None
    data = page(report, told)
    shown = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", data.decode())).replace("\u00a0", " ")
    assert "Valid, of all frames 65.0 %" in shown or "Valid, of all frames 65 %" in shown
    assert (
        "at most the alert limits, 1 mm and" in shown and b'id="data-protection-1"' in data and b"alert limit" in data
    )


def test_recordings_without_bounds_are_reported():
    text = "monitor:\n  policy:\n    suspect_sigma_m: null\n    alert_limit_m: 0.004417\n"
    run = stepped(configuration=RecordedConfiguration("main.yaml", {"main.yaml": RecordedFile(text)}))
    older = [msgspec.structs.replace(record, protection=None) for record in run.records]
    report, told = build([dataclasses.replace(run, records=older)])
    assert report.recordings[0].integrity is None
    assert report.recordings[0].limits.alert_limit_m == pytest.approx(4.417e-3, abs=1e-6)
    assert b"data-protection-1" not in page(report, told)
