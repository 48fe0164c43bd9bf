"""The layout that a second camera's recording opens with."""

from __future__ import annotations

import rerun.blueprint as rrb

from gripmon.record.write.wire import Scene

IMAGE = "base/camera/image"


def spot_blueprint(scene: Scene) -> rrb.Blueprint:
    """Left the pulse's image with the spot, and the events; right the cell in space, then what is judged."""
    axis = rrb.TimeAxis(link="LinkToGlobal")
    bounds = rrb.VisualBounds2D(x_range=[-0.5, scene.width_px - 0.5], y_range=[-0.5, scene.height_px - 0.5])
    name = f"{scene.robot} / {scene.camera} (spot: green believed, red not; foreseen blue)"
    image = rrb.Spatial2DView(origin=IMAGE, contents=f"{IMAGE}/**", name=name, visual_bounds=bounds)
    columns = rrb.TextLogColumns(timeline_columns=["frame"], text_log_columns=["LogLevel", "Body"])
    events = rrb.TextLogView(origin="events", name="Alerts and changes", columns=columns)
    cell = rrb.Spatial3DView(origin="base", contents=["base/**"], name="Base, camera, plane and beam", line_grid=False)

    def plot(contents: str, title: str, legend: bool = True) -> rrb.TimeSeriesView:
        origin, shown = contents.partition("/")[0], rrb.PlotLegend(visible=legend)
        return rrb.TimeSeriesView(origin=origin, contents=contents, name=title, axis_x=axis, plot_legend=shown)

    judged = rrb.Vertical(
        cell,
        plot("off/**", "Spot less foreseen (px), band of one standard deviation", legend=False),
        plot("gaps/**", "Disagreement of the three ways (mm)"),
        rrb.Tabs(
            plot("test/moved", "Probability that something moved", legend=False),
            plot("test/square", "Normalised square", legend=False),
            plot("shift/**", "Camera (mm, mrad)"),
            plot("timing/**", "Time (ms)"),
            rrb.TextDocumentView(origin="about", name="About"),
            active_tab=0,
        ),
        rrb.StateTimelineView(origin="status", name="State and verdict", time_view=axis),
        row_shares=[3.5, 2.5, 2.5, 2.5, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(image, events, row_shares=[7, 2.4]), judged, column_shares=[5, 4]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="capture_time"),
    )
