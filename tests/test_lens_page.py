"""The page of a camera's calibration: the residuals where they are, and which images they are of."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from support.sightings import CAMERAS, poses, seen

from gripmon.analyse.lens_page import CELLS, lens_page
from gripmon.calibrate.api import CameraFromViews
from gripmon.calibrate.intrinsics import calibrate
from gripmon.model.targets import parse_target


@pytest.fixture(scope="module")
def found() -> CameraFromViews:
    rng = np.random.default_rng(2)
    views = [replace(view, name=f"<b>{k}.png") for k, view in enumerate(seen(CAMERAS["paper"], poses(rng, 6), rng))]
    views[3].uv_px[7] += 30.0
    target = parse_target("chequerboard:9x7:0.02")
    return CameraFromViews(calibrate(views, "paper"), target, {"none.png": "no <i>board</i>"})


def figures(page: bytes) -> dict[str, dict]:
    parts = re.findall(r'<script type="application/json" id="data-(\w+)">(.*?)</script>', page.decode(), re.DOTALL)
    return {name: json.loads(text) for name, text in parts}


def test_each_point_stands_where_it_is_with_its_residual(found: CameraFromViews):
    made = figures(lens_page(found, "camera.yaml"))["residuals"]
    traces = {(trace["name"].partition(",")[0], trace["mode"]): trace for trace in made["data"]}
    uv_px = np.concatenate([s.uv_px[u] for s, u in zip(found.sightings, found.fit.used, strict=True)])
    residual_px = np.concatenate([r[u] for r, u in zip(found.fit.residuals_px, found.fit.used, strict=True)])
    points, lines = traces["residuals", "markers"], traces["residuals", "lines"]
    np.testing.assert_allclose(np.column_stack([points["x"], points["y"]]), uv_px, atol=1e-6)
    ends = np.column_stack([lines["x"][1::3], lines["y"][1::3]]).astype(float)
    enlarged = float(re.search(r", (\S+) times", points["name"])[1])
    np.testing.assert_allclose(ends - uv_px, enlarged * residual_px, rtol=0.01, atol=1e-3)
    assert 3.0 * found.fit.rms_px * enlarged == pytest.approx(0.03 * found.camera.width_px, rel=0.01)
    # The point that is wrong is red, its arrow is cut, and a name is a name.
    wrong = traces["left out", "markers"]
    assert [*wrong["x"], *wrong["y"]] == pytest.approx(found.sightings[3].uv_px[7].tolist(), abs=1e-6)
    assert wrong["text"] == [f"&lt;b&gt;3.png: {np.linalg.norm(found.fit.residuals_px[3][7]):.3f} px"]
    length = np.hypot(*(np.diff(traces["left out", "lines"][axis][:2])[0] for axis in "xy"))
    assert length == pytest.approx(0.06 * found.camera.width_px, rel=1e-6)
    assert made["layout"]["yaxis"]["range"] == [575.5, -0.5] and made["layout"]["xaxis"]["range"] == [-0.5, 767.5]


def test_images_of_one_name_are_told_apart_at_each_point(found: CameraFromViews):
    names = ["left/0.png", "right/0.png", "right/1.png", *(view.name for view in found.sightings[3:])]
    views = [replace(view, name=name) for view, name in zip(found.sightings, names, strict=True)]
    page = lens_page(replace(found, fit=replace(found.fit, sightings=tuple(views))), "camera.yaml")
    made = figures(page)["residuals"]
    words = [text.rpartition(": ")[0] for trace in made["data"] for text in trace.get("text", ())]
    assert list(dict.fromkeys(words))[:3] == ["left/0.png", "right/0.png", "1.png"]


def test_parts_of_the_image_without_points_are_tinted(found: CameraFromViews):
    tinted = figures(lens_page(found, "camera.yaml"))["residuals"]["layout"]["shapes"]
    uv_px = np.concatenate([s.uv_px for s in found.sightings])
    for shape in tinted:
        inside = (uv_px > [shape["x0"], shape["y0"]]) & (uv_px < [shape["x1"], shape["y1"]])
        assert not inside.all(axis=1).any()
        assert (shape["x1"] - shape["x0"], shape["y1"] - shape["y0"]) == pytest.approx((64.0, 64.0))
    filled = {tuple(cell) for cell in np.floor((uv_px + 0.5) / 64.0).astype(int).tolist()}
    assert 0 < len(tinted) == CELLS * 9 - len(filled)


def test_images_parameters_and_what_is_not_used_are_on_it(found: CameraFromViews):
    page = lens_page(found, "camera.yaml")
    (bars,) = figures(page)["views"]["data"]
    np.testing.assert_allclose(bars["x"], found.fit.view_rms_px, atol=1e-6)
    assert bars["y"][2] == "&lt;b&gt;2.png" and "1 left out" in bars["text"][3]
    text = page.decode()
    assert "no &lt;i&gt;board&lt;/i&gt;" in text and f"{found.camera.fx_px:.6g}" in text
    assert "https://" not in re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
