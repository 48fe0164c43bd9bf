"""The evaluation of corners placed by hand, as lines of text."""

from __future__ import annotations

import math

from gripmon.teach.accuracy import PoseValues
from gripmon.teach.messages import Evaluation


def in_words(found: Evaluation) -> list[str]:
    """The measured corners and the expected accuracy, for a terminal."""
    snapped = found.snapped
    width = max(len(corner.name) for corner in snapped.corners)
    lines = [f"{'corner':<{width}}  measured at (px)      +- px  inliers"]
    for corner in snapped.corners:
        agree = "" if corner.inliers is None else f"{100.0 * corner.inliers:4.0f} %"
        if corner.uv_px is None or corner.sigma_px is None:
            lines.append(f"{corner.name:<{width}}  not measured: {corner.reason}")
            continue
        u, v = corner.uv_px.tolist()
        lines.append(f"{corner.name:<{width}}  ({u:7.2f}, {v:7.2f})  {corner.sigma_px:7.3f}  {agree}")
    if found.reference is not None and found.pose is not None:
        sigmas = ", ".join(f"{1e3 * found.reference.covariance[k] ** 0.5:.3f}" for k in (0, 7, 14))
        by = f"{len(found.pose.corners)} corners" if found.pose.corners else "the edges"
        lines.append(
            f"reference by {by}, TCP to {sigmas} mm: less accurate than with a plate (gripmon calibrate plane)"
        )
        if found.pose.rival:
            rival = (
                "another pose explains these corners as well; a corner outside of their plane would distinguish them"
            )
            lines.append(f"note: {rival}")
    expected = found.expected
    if expected is not None and expected.accuracy.expected is not None and expected.accuracy.drift is not None:
        lines.append(f"expected of a frame   {_axes(expected.accuracy.expected)}")
        lines.append(f"smallest drift        {_axes(expected.accuracy.drift.smallest)}")
        lines.append(f"promise               {expected.promise}")
    return lines


def _axes(values: PoseValues) -> str:
    x, y, z = values.tcp_m
    turns = ", ".join(f"{math.degrees(v):.3f}" for v in values.rotation_rad)
    return f"TCP x {1e3 * x:.3f}, y {1e3 * y:.3f}, z {1e3 * z:.3f} mm, turns {turns}°"
