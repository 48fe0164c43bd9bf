"""A camera that fills ten of sixteen bits, from ``gripmon run`` over its recording to a replay."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from support.taught_by_hand import make_rig

from gripmon.cli import main


@pytest.mark.slow("3 s: a daemon; ten bits in sixteen are measured in the default run")
def test_a_run_records_what_it_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The recording is of 8-bit JPEGs: of ten bits in sixteen they would keep two."""
    rig = make_rig(tmp_path)
    (tmp_path / "ten").mkdir()
    rows = ["file,stamp_ns,jaw_opening_m"]
    for k in range(6):
        noise = np.random.default_rng(k).normal(0.0, 2.0, rig.image.shape)
        ten_bits = np.clip(4.0 * rig.image + noise, 0.0, 1023.0).astype(np.uint16)
        cv2.imwrite(str(tmp_path / "ten" / f"{k}.png"), ten_bits)
        rows.append(f"{k}.png,{(k + 1) * 40_000_000},0.034")
    (tmp_path / "ten" / "timestamps.csv").write_text("\n".join(rows) + "\n")
    values = yaml.safe_load((tmp_path / "made_with.yaml").read_text())
    values.update(source={"kind": "folder", "path": "ten"}, jaw={"source": "frames"})
    values["publish"]["enabled"] = False
    values["recording"].update(image_every=1, image_format="jpeg")
    values.setdefault("monitor", {})["bit_depth"] = 10
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(values, sort_keys=False))
    assert main(["run", str(config), "--out", str(tmp_path / "out")]) == 0, capsys.readouterr().err
    (recording,) = (tmp_path / "out").rglob("*.rrd")
    for images, options in ((recording, []), (tmp_path / "ten", ["--config", str(config)])):
        out = tmp_path / f"{images.stem}.jsonl"
        assert main(["replay", str(images), *options, "--out", str(out)]) == 0, capsys.readouterr().err
        lines = [json.loads(line) for line in out.read_text().splitlines()]
        assert len(lines) == 6 and all(line["cam_T_grip"] is not None for line in lines)
