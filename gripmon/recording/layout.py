"""The layout that a recording opens with."""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb

from gripmon.recording import palette
from gripmon.recording.overlay import IMAGE
from gripmon.recording.wire import Scene

_EYE_FROM_TCP = (0.42, -0.45, -0.62)  # beside and above the camera; camera axes, in camera-to-TCP distances


def make_blueprint(scene: Scene) -> rrb.Blueprint:
    """Left the image with its overlay and the events; right the rig in space, the TCP's shift, the states."""
    axis = rrb.TimeAxis(link="LinkToGlobal")
    shift = rrb.TimeSeriesView(
        origin="drift",
        contents=["drift/tcp_shift_mm", "drift/tcp_shift_sigma_mm", "drift/truth_mm"],
        name="TCP shift in mm, camera axes: x red, y green, z blue (thin: ±σ; wide and pale: truth)",
        axis_x=axis,
        plot_legend=rrb.PlotLegend(visible=False),
    )
    status = rrb.StateTimelineView(origin="status", name="State and verdict", time_view=axis)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(_image(scene), _events(), row_shares=[7, 2]),
            rrb.Vertical(_rig(scene), shift, status, _details(scene, axis), row_shares=[4.3, 4, 1.8, 2.6]),
            column_shares=[5, 4],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="capture_time"),
    )


def _image(scene: Scene) -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=[-0.5, scene.width_px - 0.5], y_range=[-0.5, scene.height_px - 0.5])
    name = f"{scene.robot} / {scene.camera} (edge points: green used, red refused; corners yellow; predicted blue)"
    return rrb.Spatial2DView(origin="rig/camera", contents=f"{IMAGE}/**", name=name, visual_bounds=bounds)


def _events() -> rrb.TextLogView:
    columns = rrb.TextLogColumns(timeline_columns=["frame"], text_log_columns=["LogLevel", "Body"])
    return rrb.TextLogView(origin="events", name="Alerts and changes", columns=columns)


def _rig(scene: Scene) -> rrb.Spatial3DView:
    tcp_m = np.array(scene.reference.cam_T_grip.translation_m)
    distance_m = float(np.linalg.norm(tcp_m))
    eye = rrb.EyeControls3D(
        position=tcp_m + distance_m * np.array(_EYE_FROM_TCP), look_target=tcp_m, eye_up=(0.0, -1.0, 0.0)
    )
    return rrb.Spatial3DView(
        origin="rig",
        contents=["rig/**"],
        name="Gripper as the camera sees it; white: reference",
        eye_controls=eye,
        line_grid=False,
        background=palette.BACKGROUND,
    )


def _details(scene: Scene, axis: rrb.TimeAxis) -> rrb.Tabs:
    def plot(origin: str, contents: str | list[str], name: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(origin=origin, contents=contents, name=name, axis_x=axis)

    error = [plot("drift", "drift/error_mm", "Error against truth (mm)")] if scene.has_truth else []
    return rrb.Tabs(
        *error,
        plot("quality", "quality/rms_px", "Residual (px)"),
        plot("drift", ["drift/d_mm", "drift/delta_deg"], "d (mm), δ (°)"),
        plot("quality", ["quality/corners_used", "quality/edge_points"], "Points"),
        plot("timing", "timing/**", "Latency (µs)"),
        plot("image", "image/**", "Image"),
        rrb.TextDocumentView(origin="about", name="About"),
        active_tab=0,
    )
