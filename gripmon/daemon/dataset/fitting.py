"""Determines which of several gripper files an episode shows, or none, from the outlines in its frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from scipy.special import bdtrc

from gripmon.calibrate.verify import CHANCE
from gripmon.daemon.api import Monitor
from gripmon.daemon.config import Config
from gripmon.daemon.config.checks import view_fault
from gripmon.model.geometry import from_record, invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Frame, FrameRecord, MeasurementTrace, Verdict

FRAMES = 24
"""Frames of an episode, evenly spread: with 24 the sign test at 1/1000 tolerates four that disagree, with 10 none."""
_PLACES = 33
"""Sample points along an outline."""
_EDGE_PX = 1.0
"""Points farther from an edge aren't on it: edges of a sharp image are located to some tenths of a pixel."""


@dataclass(frozen=True)
class Fit:
    """The fit of one gripper file: ``fault``: why the frames don't show it, None if they may.  ``scores`` (n,):
    fraction of the outline that is found in a frame, lower if edges are beside it; NaN where nothing was measured.
    """

    name: str
    fault: str | None
    scores: Array


def spread(frames: Iterable[Frame]) -> list[Frame]:
    """From :data:`FRAMES` to twice as many frames with images, evenly spread over the episode."""
    kept: list[Frame] = []
    step = 1
    for number, frame in enumerate(frame for frame in frames if frame.image is not None):
        if number % step == 0:
            kept.append(frame)
        if len(kept) >= 2 * FRAMES:
            kept, step = kept[::2], 2 * step
    return kept


def chosen(fits: Sequence[Fit]) -> int | str:
    """The index of the only gripper that fits and isn't beaten by another; otherwise why none was chosen.

    One beats another if its score is higher in significantly more frames (sign test at 1/1000), by more than its own
    score varies from frame to frame.  A gripper that is beaten doesn't fit, even if the other one doesn't fit either.
    """
    beaten = {b: a for a, b in permutations(range(len(fits)), 2) if _beats(fits[a].scores, fits[b].scores)}
    faults = {n: fit.fault for n, fit in enumerate(fits) if fit.fault is not None}
    faults |= {b: f"{fits[a].name} fits better" for b, a in beaten.items() if b not in faults}
    left = [n for n in range(len(fits)) if n not in faults]
    if len(left) == 1:
        return left[0]
    if left:
        return f"gripper: {' and '.join(fits[n].name for n in left)} fit alike; one file fewer, or images that differ"
    return f"gripper: none fits; {'; '.join(f'{fits[n].name}: {fault}' for n, fault in sorted(faults.items()))}"


def _beats(one: Array, other: Array) -> bool:
    both = np.isfinite(one) & np.isfinite(other)
    if not both.any():
        return False
    more = (one - other)[both]
    usual = 1.4826 * float(np.median(np.abs(one[both] - np.median(one[both]))))
    # The sign test: probability of as many or more by chance.
    chance = float(bdtrc(int((more > 0.0).sum()) - 1, len(more), 0.5)) if (more > 0.0).any() else 1.0
    return bool(chance < CHANCE and np.median(more) > usual)


def fit_of(config: Config, frames: Sequence[Frame]) -> Fit:
    """The fit of a configuration's gripper to the frames of an episode."""
    name, nothing = config.gripper_path.stem, np.full(len(frames), np.nan)
    if (wrong := view_fault(config.view(), config.gripper, config.camera)) is not None:
        return Fit(name, f"{wrong.key} {wrong.wrong}", nothing)
    monitor, scores, valid = Monitor(config), nothing, 0
    by_edge: dict[int, list[float]] = {}
    for number, frame in enumerate(frames):
        record = monitor.process(frame)
        valid += record.verdict is Verdict.VALID
        if record.measured and (trace := monitor.trace()) is not None:
            seen = _seen(config, record, trace)
            for edge, (share, _) in seen.items():
                by_edge.setdefault(edge, []).append(share)
            if seen:
                scores[number] = np.mean([score for _, score in seen.values()])
    if 2 * valid < len(frames):
        return Fit(name, f"valid in {valid} of {len(frames)} frames", scores)
    shares = {edge: float(np.median(each)) for edge, each in by_edge.items() if 2 * len(each) > len(frames)}
    if shares and shares[least := min(shares, key=lambda edge: shares[edge])] < 0.5:
        where = config.gripper.edge_ids[least]
        return Fit(name, f"of its outline {where} {100 * shares[least]:.0f} % is seen", scores)
    return Fit(name, None, scores)


def _seen(config: Config, record: FrameRecord, trace: MeasurementTrace) -> dict[int, tuple[float, float]]:
    """For each outline in the image: the fraction of it with edge points, and the same reduced for points beside it.

    Creases between two faces of a finger may be too faint to be detected; outlines are visible on most backgrounds.
    """
    gripper: Gripper = config.gripper
    assert record.measured_T is not None
    cam_T_grip = from_record(record.measured_T)
    points_m = gripper.points_grip_m(record.jaw_opening_m if gripper.has_jaw else None)
    view = gripper.edge_view(points_m, invert(cam_T_grip)[:3, 3])
    edges = np.flatnonzero(view.visible & ~view.crease)
    points_cam_m = points_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    lines_m = gripper.outlines_m(points_cam_m, edges, _PLACES, cam_T_grip[:3, :3])
    lines_px = config.camera.project(lines_m.reshape(-1, 3)).reshape(len(edges), _PLACES, 2)
    last_px = np.array([config.camera.width_px, config.camera.height_px]) - 1.0
    lengths_px = np.nan_to_num(np.linalg.norm(np.diff(lines_px, axis=1), axis=2)).sum(axis=1)
    # The search lines are distributed over the outlines by the square roots of their lengths.
    apart_px = np.sqrt(lengths_px) * np.sqrt(lengths_px).sum() / config.settings.monitor.corners.sampling.samples
    out = {}
    for edge, line_px, reach_px in zip(edges.tolist(), lines_px, apart_px + _EDGE_PX, strict=True):
        inside = np.isfinite(line_px).all(axis=1) & ((line_px >= 0.0) & (line_px <= last_px)).all(axis=1)
        if 2 * inside.sum() < _PLACES:
            continue
        mine = trace.edge_used & (trace.edge_index == edge)
        worth = np.clip(1.0 - (trace.edge_residual_px[mine] / _EDGE_PX) ** 2, 0.0, None)
        near = np.linalg.norm(line_px[inside][:, None] - trace.edge_uv_px[mine], axis=2) < reach_px
        best = np.where(near, worth, 0.0).max(axis=1, initial=0.0)
        out[edge] = float(near.any(axis=1).mean()), float(best.mean())
    return out
