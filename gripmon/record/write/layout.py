"""The layout that a recording opens with."""

from __future__ import annotations

import os

import numpy as np
import rerun.blueprint as rrb

from gripmon.record.write import palette
from gripmon.record.write.overlay import IMAGE
from gripmon.record.write.spot_layout import spot_blueprint
from gripmon.record.write.wire import Scene

_EYE = (0.66, -0.36, -0.03)  # beside and above, so that camera and gripper are both in sight
_LOOK_AT = 0.64  # of the way from camera to TCP
_CLOSE_UP_MM = (-0.3, 0.3)
_STATISTIC_SHOWN = (0.0, 2.0)  # a collision is hundreds of times the threshold; what matters is where it crosses 1


def layout_file(scene: Scene, application_id: str) -> bytes:
    """The layout as rerun's own file of it, for :meth:`rerun.RecordingStream.log_file_from_contents`.

    Sending a blueprint leaves two threads and more than a MiB behind each time, for good; logging this leaves nothing.
    """
    descriptor = os.memfd_create("gripmon-layout")
    try:
        make_blueprint(scene).save(application_id, f"/proc/self/fd/{descriptor}")
        return os.pread(descriptor, os.fstat(descriptor).st_size, 0)
    finally:
        os.close(descriptor)


def make_blueprint(scene: Scene) -> rrb.Blueprint:
    """What opens with a recording of either kind of camera."""
    return _wrist_blueprint(scene) if scene.laser is None else spot_blueprint(scene)


def _wrist_blueprint(scene: Scene) -> rrb.Blueprint:
    """Left the image with its overlay and the events; right the rig in space, then what is judged: the TCP's drift
    against its limits, the drift test's statistic against its threshold, and what followed, the states.
    """
    axis = rrb.TimeAxis(link="LinkToGlobal")
    truth = ["drift/truth_mm"] if scene.has_truth else []
    truth_said = "; wide, pale: truth" if scene.has_truth else ""
    drift = rrb.TimeSeriesView(
        origin="drift",
        contents=[
            *truth,
            "drift/limits_mm",
            "drift/tcp_shift_sigma_mm",
            "drift/tcp_shift_mm",
            "drift/alerts/**",
        ],
        name=f"TCP drift (mm): x red, y green, z blue, length white{truth_said}; lines: warning, limit",
        axis_x=axis,
        plot_legend=rrb.PlotLegend(visible=False),
    )
    test = rrb.TimeSeriesView(
        origin="test",
        name="Drift test: statistic / threshold (alarm above 1)",
        axis_x=axis,
        axis_y=rrb.ScalarAxis(range=_STATISTIC_SHOWN),
        plot_legend=rrb.PlotLegend(visible=False),
    )
    status = rrb.StateTimelineView(origin="status", name="State and verdict", time_view=axis)
    judged = rrb.Vertical(rig_view(scene), drift, test, status, _details(scene, axis), row_shares=[3.9, 4, 2.1, 2, 2.6])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(image_view(scene), _events(), row_shares=[7, 2.4]), judged, column_shares=[5, 4]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="capture_time"),
    )


def image_view(scene: Scene) -> rrb.Spatial2DView:
    """The image with its overlay."""
    bounds = rrb.VisualBounds2D(x_range=[-0.5, scene.width_px - 0.5], y_range=[-0.5, scene.height_px - 0.5])
    name = f"{scene.robot} / {scene.camera} (edge points: green used, red refused; corners yellow; predicted blue)"
    return rrb.Spatial2DView(origin="rig/camera", contents=f"{IMAGE}/**", name=name, visual_bounds=bounds)


def _events() -> rrb.TextLogView:
    columns = rrb.TextLogColumns(timeline_columns=["frame"], text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin="events", name="Alerts and changes", columns=columns)


def rig_view(scene: Scene) -> rrb.Spatial3DView:
    """Camera and gripper in space."""
    tcp_m = scene.tcp_m
    distance_m = float(np.linalg.norm(tcp_m))
    target_m = _LOOK_AT * tcp_m
    eye = rrb.EyeControls3D(
        position=target_m + distance_m * np.array(_EYE), look_target=target_m, eye_up=(0.0, -1.0, 0.0)
    )
    return rrb.Spatial3DView(
        origin="rig",
        contents=["rig/**"],
        name="Camera and gripper; white: gripper at the reference",
        eye_controls=eye,
        line_grid=False,
        background=palette.BACKGROUND,
    )


def _details(scene: Scene, axis: rrb.TimeAxis) -> rrb.Tabs:
    def plot(origin: str, contents: str | list[str], name: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(origin=origin, contents=contents, name=name, axis_x=axis)

    error = [plot("drift", "drift/error_mm", "Error (mm)")] if scene.has_truth else []
    return rrb.Tabs(
        rrb.TimeSeriesView(
            origin="drift",
            contents=["drift/noticed_mm", "drift/tcp_shift_sigma_mm", "drift/tcp_shift_mm"],
            name="Close up (mm)",
            axis_x=axis,
            axis_y=rrb.ScalarAxis(range=_CLOSE_UP_MM),
            plot_legend=rrb.PlotLegend(visible=False),
        ),
        plot("protection", ["protection/level_mm", "protection/limit_mm"], "Protection (mm)"),
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
