"""The default layout of a recording in rerun's viewer."""

from __future__ import annotations

import os

import numpy as np
import rerun.blueprint as rrb

from gripmon.record.columns import APPLICATION_ID, RECORDED, REPLAYED, Palette
from gripmon.record.overlay import IMAGE
from gripmon.record.recorder import Scene

_EYE = (0.66, -0.36, -0.03)  # beside and above, so that camera and gripper are both visible
_LOOK_AT_FRACTION = 0.64  # of the way from camera to TCP
_CLOSE_UP_MM = (-0.3, 0.3)
_STATISTIC_SHOWN = (0.0, 2.0)  # a collision gives hundreds of times the threshold; the crossing of 1 matters
_AXIS = rrb.TimeAxis(link="LinkToGlobal")


def layout_file(layout: rrb.Blueprint) -> bytes:
    """A layout as a rerun blueprint file, for :meth:`rerun.RecordingStream.log_file_from_contents`.

    Each ``send_blueprint`` leaks two threads and more than a MiB; logging this file leaks nothing.
    """
    descriptor = os.memfd_create("gripmon-layout")
    try:
        layout.save(APPLICATION_ID, f"/proc/self/fd/{descriptor}")
        return os.pread(descriptor, os.fstat(descriptor).st_size, 0)
    finally:
        os.close(descriptor)


def layout_of(scene: Scene) -> rrb.Blueprint:
    """Left: the image with its overlay, and the events.  Right: the rig in space, the TCP's drift with its limits, the
    drift test's statistic over its threshold, and the resulting states.
    """
    if scene.then is not None:
        return _layout_of_both(scene)
    truth = ["drift/truth_mm"] if scene.has_truth else []
    truth_named = "; wide, pale: truth" if scene.has_truth else ""
    drift = plot(
        "drift",
        [*truth, "drift/limits_mm", "drift/tcp_shift_sigma_mm", "drift/tcp_shift_mm", "drift/alerts/**"],
        f"TCP drift (mm): x red, y green, z blue, length white{truth_named}; lines: warning, limit",
        legend=False,
    )
    test_name = "Drift test: statistic / threshold (alarm above 1)"
    test = plot("test", "$origin/**", test_name, legend=False, shown=_STATISTIC_SHOWN)
    judged: list[rrb.View | rrb.Container] = [rig_view(scene), drift, test, states_view("status", ""), _details(scene)]
    return two_columns(
        [image_view(scene), log_view()], [7, 2.4], rrb.Vertical(*judged, row_shares=[3.9, 4, 2.1, 2, 2.6])
    )


def _details(scene: Scene) -> rrb.Tabs:
    error = [plot("drift", "drift/error_mm", "Error (mm)")] if scene.has_truth else []
    close_up = ["drift/noticed_mm", "drift/tcp_shift_sigma_mm", "drift/tcp_shift_mm"]
    bounds = [f"protection/{name}_mm" for name in ("level", "since_reference", "absolute", "limit")]
    return rrb.Tabs(
        plot("drift", close_up, "Close up (mm)", legend=False, shown=_CLOSE_UP_MM),
        plot("protection", bounds, "Protection (mm)"),
        *error,
        plot("residual", "residual/rms_px", "Residual (px)"),
        plot("residual", "residual/corners_px", "Corners (px)"),
        plot("drift", ["drift/d_mm", "drift/limits_mm"], "d (mm)"),
        plot("drift", ["drift/delta_deg", "drift/limits_deg"], "δ (°)"),
        plot("sigma", "sigma/tcp_um", "σ (µm)"),
        plot("quality", ["quality/corners_used", "quality/edge_points"], "Points"),
        plot("timing", "timing/**", "Latency (µs)"),
        plot("noise", "noise/scatter_um", "Noise (µm)"),
        plot("image", "image/**", "Image"),
        rrb.TextDocumentView(origin="about", name="About"),
        active_tab=0,
    )


def _layout_of_both(scene: Scene) -> rrb.Blueprint:
    """Of a run and its replay; the recorded one is below its name.  Left: the image with the replay's overlay, and the
    events of both.  Right: drifts and limits of both in one plot, and the states of both.
    """
    root = f"{RECORDED}/"

    def both(paths: tuple[str, str], name: str) -> rrb.TimeSeriesView:
        return plot("/", [f"{where}{path}" for where in (root, "") for path in paths], name, legend=False)

    drift = both(
        ("drift/limits_mm", "drift/tcp_shift_mm"),
        f"TCP drift (mm): x red, y green, z blue, length white; wide, pale: {RECORDED}, thin: {REPLAYED}",
    )
    turn = both(("drift/delta_deg", "drift/limits_deg"), "δ (°) and its limits, of both")
    bounds = both(("protection/level_mm", "protection/limit_mm"), "Protection level (mm) and alert limit, of both")
    states = [states_view(f"{root}status", f", {RECORDED}"), states_view("status", f", {REPLAYED}")]
    details = rrb.Tabs(rig_view(scene), turn, bounds, active_tab=0)
    log = log_view("/", ["events", f"{root}events"], f", {REPLAYED} and {RECORDED}")
    judged = rrb.Vertical(drift, *states, details, row_shares=[4.5, 2, 2, 3])
    return two_columns([image_view(scene), log], [6, 3], judged)


def plot(
    origin: str, contents: str | list[str], name: str, *, legend: bool = True, shown: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """Curves over the shared time axis; ``shown`` is the range of values, None: automatic."""
    return rrb.TimeSeriesView(
        origin=origin, contents=contents, name=name, axis_x=_AXIS,
        axis_y=None if shown is None else rrb.ScalarAxis(range=shown),
        plot_legend=None if legend else rrb.PlotLegend(visible=False),
    )  # fmt: skip


def states_view(origin: str, whose: str) -> rrb.StateTimelineView:
    """State and verdict over time."""
    return rrb.StateTimelineView(origin=origin, name=f"State and verdict{whose}", time_view=_AXIS)


def image_view(scene: Scene) -> rrb.Spatial2DView:
    """The image with its overlay."""
    lens = scene.lens
    bounds = rrb.VisualBounds2D(x_range=[-0.5, lens.width_px - 0.5], y_range=[-0.5, lens.height_px - 0.5])
    legend = "edge points: green used, red refused; corners yellow; predicted blue"
    name = f"{scene.robot} / {scene.camera} ({legend})"
    return rrb.Spatial2DView(origin="rig/camera", contents=f"{IMAGE}/**", name=name, visual_bounds=bounds)


def rig_view(scene: Scene) -> rrb.Spatial3DView:
    """Camera and gripper in space."""
    tcp_m = scene.tcp_m
    target_m = _LOOK_AT_FRACTION * tcp_m
    eye = rrb.EyeControls3D(
        position=target_m + float(np.linalg.norm(tcp_m)) * np.array(_EYE), look_target=target_m,
        eye_up=(0.0, -1.0, 0.0),
    )  # fmt: skip
    return rrb.Spatial3DView(
        origin="rig", contents=["rig/**"], name="Camera and gripper; white: gripper at the reference",
        eye_controls=eye, line_grid=False, background=Palette.BACKGROUND,
    )  # fmt: skip


def log_view(origin: str = "events", contents: str | list[str] = "$origin/**", whose: str = "") -> rrb.TextLogView:
    """Alerts, commands and changes in words."""
    columns = rrb.TextLogColumns(timeline_columns=["frame"], text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin=origin, contents=contents, name=f"Alerts and changes{whose}", columns=columns)


def two_columns(left: list[rrb.View], left_shares: list[float], right: rrb.Container) -> rrb.Blueprint:
    """The panels of the viewer are folded away."""
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(*left, row_shares=left_shares), right, column_shares=[5, 4]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="capture_time"),
    )
