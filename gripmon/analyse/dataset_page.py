"""The report on a dataset: mountings over time, motions and failures, in one HTML file."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from gripmon.analyse.content import count
from gripmon.analyse.dataset import Journal, Line, Written, moved
from gripmon.analyse.page import rendered
from gripmon.model.atomic import write_atomically
from gripmon.model.records import Verdict

_MOST_SHOWN, _MOST_ROWS, _MOST_POINTS = 24, 200, 4000
"""Episodes with pictures, rows of a table, points of a plot; the Parquet table has all of them."""


def write_page(written: Written, journal: Journal, name: str) -> None:
    """Write the report on the dataset ``name`` where ``written`` says, replacing an earlier one."""
    write_atomically(written.report, _page(written, journal, name))


def _page(written: Written, journal: Journal, name: str) -> bytes:
    """The whole page, UTF-8, which needs no network."""
    from plotly.offline import get_plotlyjs

    from gripmon.analyse.plots import as_json, mountings_figure

    lines = written.lines
    episodes: dict[str, list[Line]] = {}
    for line in lines:
        episodes.setdefault(line.key, []).append(line)
    figures = {
        camera: as_json(mountings_figure(*_points(written, camera)))
        for camera in sorted({line.camera for line, m in zip(lines, written.mountings, strict=True) if m >= 0})
    }
    failed = Counter(line.fault.partition(";")[0] for line in lines if line.fault is not None)
    return rendered(
        "dataset.html.j2",
        name=name,
        summary=_summary(written, episodes),
        mountings=_mountings(written),
        worst=[_shown(each, journal) for each in sorted(episodes.values(), key=_badness, reverse=True)[:_MOST_SHOWN]],
        failed=[(reason, number, _first(lines, reason)) for reason, number in failed.most_common(_MOST_ROWS)],
        most_rows=_MOST_ROWS,
        figures=figures,
        plotly=get_plotlyjs() if figures else "",
    )


def _summary(written: Written, episodes: dict[str, list[Line]]) -> str:
    good = [any(s.stretch and s.stretch.verdict == Verdict.VALID for s in each) for each in episodes.values()]
    went = sum(moved([s.stretch for s in each if s.stretch is not None]) for each in episodes.values())
    cameras = {line.camera for line in written.lines}
    pairs = {(line.camera, int(m)) for line, m in zip(written.lines, written.mountings, strict=True) if m >= 0}
    return (
        f"{count(len(episodes), 'episode')} of {count(len(cameras), 'camera')}: {sum(good)} with a transform that "
        f"may be used, {len(good) - sum(good) or 'none'} without one; {count(len(pairs), 'mounting')}; "
        f"the camera moved in {went or 'none'} of them."
    )


def _badness(lines: Sequence[Line]) -> tuple[float, float]:
    """How far it moved, then the fraction of unusable frames; failures are in a separate table."""
    stretches = [line.stretch for line in lines if line.stretch is not None]
    if not stretches:
        return -1.0, 0.0
    far = max(max(s.motion.size_m if s.motion else 0.0, s.crept_m or 0.0) for s in stretches)
    frames = sum(s.frames for s in stretches)
    return far, 1.0 - sum(s.valid for s in stretches) / max(frames, 1)


def _shown(lines: Sequence[Line], journal: Journal) -> dict[str, Any]:
    pictures = journal.read(lines[0].key).pictures
    return {
        "episode": lines[0].episode,
        "camera": lines[0].camera,
        "lines": lines,
        "pictures": [base64.b64encode(picture).decode() for picture in pictures],
    }


def _first(lines: Sequence[Line], reason: str) -> str:
    return next(line.episode for line in lines if line.fault is not None and line.fault.partition(";")[0] == reason)


def _mountings(written: Written) -> list[dict[str, Any]]:
    groups: dict[tuple[str, int], list[Line]] = {}
    for line, number in zip(written.lines, written.mountings.tolist(), strict=True):
        if number >= 0:
            groups.setdefault((line.camera, number), []).append(line)
    out = []
    for (camera, number), lines in sorted(groups.items()):
        at = np.array([line.stretch.cam_T_grip[:3] for line in lines if line.stretch and line.stretch.cam_T_grip])
        middle = np.median(at, axis=0)
        out.append(
            {
                "camera": camera, "number": number, "stretches": len(lines), "first": lines[0].episode,
                "last": lines[-1].episode, "tcp_mm": " ".join(f"{1e3 * value:.2f}" for value in middle),
                "spread_m": float(np.linalg.norm(at - middle, axis=1).max()),
            }
        )  # fmt: skip
    return out


def _points(written: Written, camera: str) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Episodes, TCPs (n, 3) relative to the first, m, and mountings (n,) of a camera; thinned if there are many."""
    places = [
        place
        for place, (line, number) in enumerate(zip(written.lines, written.mountings, strict=True))
        if line.camera == camera and number >= 0
    ]
    places = places[:: max(len(places) // _MOST_POINTS, 1)]
    stretches = [written.lines[place].stretch for place in places]
    at = np.array([one.cam_T_grip[:3] for one in stretches if one is not None and one.cam_T_grip is not None])
    names = [f"{written.lines[place].episode}, stretch {written.lines[place].number}" for place in places]
    return names, at - at[0], written.mountings[places]
