"""A camera's calibration as a page: residuals over the image, how well each view fits, and the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gripmon.analyse.page import Table, rendered
from gripmon.analyse.plots import BAD, BLUE, IDLE, Figure, plain
from gripmon.analyse.words import count
from gripmon.calibrate.api import CameraFromViews
from gripmon.model.records import Array

CELLS = 12
"""Across the image: those without a point are tinted."""
_ARROW = 0.03
"""Length of an arrow for three standard deviations, over the image's width; no outlier's is more than twice that."""
_TINT = "rgba(217,80,77,0.16)"


def lens_page(found: CameraFromViews, title: str) -> bytes:
    """The page, UTF-8; it needs no network."""
    fit = found.fit
    parameters = [
        (name, f"{value:.6g}", "held" if sigma is None else f"{sigma:.2g}")
        for (name, value), sigma in zip(fit.values.items(), found.sigmas.values(), strict=True)
    ]
    crossed = fit.cross_validated_rms_px
    others = "" if crossed is None else f", {crossed:.3f} px in images that had no part in the fit"
    return rendered(
        "lens.html.j2",
        {"residuals": residual_figure(found), "views": view_figure(found)},
        title=title,
        summary=f"{fit.model}: {count(len(found.sightings), 'image')}, {count(found.points, 'point')}, "
        f"{found.outliers} left out; rms {fit.rms_px:.3f} px{others}.",
        parameters=Table(("Parameter", "Value", "±"), parameters),
        warnings=fit.warnings,
        not_used=Table(("Image", "Why it isn't used"), list(found.not_found.items())),
    )


def residual_figure(found: CameraFromViews) -> Figure:
    """Each point with its residual, enlarged, where it is in the image; parts of the image without points tinted."""
    camera, fit = found.camera, found.fit
    enlarged = _ARROW * camera.width_px / max(3.0 * fit.rms_px, 1e-6)
    height_px = round(min(900.0, 700.0 * camera.height_px / camera.width_px)) + 96
    figure = Figure(height_px, [("v (px)", 1.0)], axis="u (px)")
    figure.axis(1, range=[camera.height_px - 0.5, -0.5], constrain="domain")
    figure.layout["xaxis"] |= {"range": [-0.5, camera.width_px - 0.5], "scaleanchor": "y", "constrain": "domain"}
    figure.layout["shapes"] = _without_points(found)
    names = _names([sighting.name for sighting in found.sightings])
    for what, colour, good in (("residuals", BLUE, True), ("left out", BAD, False)):
        starts, ends, words = [], [], []
        for name, sighting, residual, used in zip(names, found.sightings, fit.residuals_px, fit.used, strict=True):
            some = used == good
            starts.append(sighting.uv_px[some])
            ends.append(starts[-1] + _arrows(residual[some], enlarged, 2.0 * _ARROW * camera.width_px))
            sizes = np.linalg.norm(residual[some], axis=1).tolist()
            words += [f"{name}: {size:.3f} px" for size in sizes]
        at, to = np.concatenate(starts), np.concatenate(ends)
        if not len(at):
            continue
        lines = np.stack([at, to, np.full_like(at, np.nan)], axis=1).reshape(-1, 2)
        named, group = f"{what}, {enlarged:{'.0f' if enlarged >= 100.0 else '.2g'}} times", {"legendgroup": what}
        figure.add(1, lines[:, 0], lines[:, 1], named, line={"color": colour, "width": 1.2}, hoverinfo="skip", **group)
        figure.add(
            1, at[:, 0], at[:, 1], named, mode="markers", marker={"color": colour, "size": 4}, text=words,
            hovertemplate="%{text}<extra></extra>", showlegend=True, **group,
        )  # fmt: skip
    figure.add(
        1, [camera.cx_px], [camera.cy_px], "principal point", mode="markers", showlegend=True,
        marker={"symbol": "cross-thin", "size": 16, "line": {"width": 2, "color": IDLE}},
        hovertemplate="principal point (%{x:.1f}, %{y:.1f}) px<extra></extra>",
    )  # fmt: skip
    return figure


def _arrows(residual_px: Array, enlarged: float, longest_px: float) -> Array:
    """Residuals (n, 2), enlarged; those of points that don't project are none, and no outlier crosses the image."""
    arrows = np.nan_to_num(residual_px) * enlarged
    lengths = np.linalg.norm(arrows, axis=1, keepdims=True)
    out: Array = arrows * np.minimum(1.0, longest_px / np.maximum(lengths, 1e-9))
    return out


def _without_points(found: CameraFromViews) -> list[dict[str, object]]:
    """Rectangles over the cells of the image in which no view has a point."""
    width, height = found.camera.width_px, found.camera.height_px
    edges_u, edges_v = (
        np.linspace(-0.5, size - 0.5, cells + 1).tolist()
        for size, cells in ((width, CELLS), (height, max(1, round(CELLS * height / width))))
    )
    seen = np.concatenate([sighting.uv_px for sighting in found.sightings])
    points, _, _ = np.histogram2d(seen[:, 0], seen[:, 1], bins=(edges_u, edges_v))
    return [
        {"type": "rect", "layer": "below", "line": {"width": 0}, "fillcolor": _TINT, "xref": "x", "yref": "y",
         "x0": edges_u[i], "x1": edges_u[i + 1], "y0": edges_v[j], "y1": edges_v[j + 1]}
        for i, j in np.argwhere(points == 0).tolist()
    ]  # fmt: skip


def _names(files: Sequence[str]) -> list[str]:
    """Of files, without their folders unless two have one name."""
    short = [Path(file).name for file in files]
    return [plain(short[k] if short.count(short[k]) == 1 else file) for k, file in enumerate(files)]


def view_figure(found: CameraFromViews) -> Figure:
    """The root mean square residual of each view; a bar is red where most of its points were left out."""
    names = _names([sighting.name for sighting in found.sightings])
    figure = Figure(96 + max(22 * len(names), 60), [("", 1.0)], axis="rms residual of each image (px)")
    figure.axis(1, type="category", autorange="reversed", showgrid=False)
    colours = [BLUE if used.mean() > 0.5 else BAD for used in found.fit.used]
    words = [
        f"{len(sighting)} points, {int((~used).sum())} left out{f'; {plain(sighting.note)}' if sighting.note else ''}"
        for sighting, used in zip(found.sightings, found.fit.used, strict=True)
    ]
    figure.add(
        1, list(found.fit.view_rms_px), names, "rms", type="bar", orientation="h", marker={"color": colours},
        text=words, textposition="none", hovertemplate="%{y}: %{x:.3f} px; %{text}<extra></extra>",
    )  # fmt: skip
    return figure
