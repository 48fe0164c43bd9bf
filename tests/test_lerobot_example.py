"""``docs/examples/lerobot_extrinsics.py``: what it gives LeRobot's ``add_features``, frame by frame; with the package
itself: tests/test_lerobot_package.py.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pytest
from support.episode_files import WRIST

from gripmon.analyse.dataset import table_of
from gripmon.analyse.stretches import Stretch

EXAMPLE = Path(__file__).resolve().parent.parent / "docs" / "examples" / "lerobot_extrinsics.py"
FIRST, LAST = (0.001, 0.002, 0.12, 0.0, 0.0, 0.0, 1.0), (0.002, 0.002, 0.12, 0.0, 0.0, 0.6, 0.8)
POSE, FLAG = "observation.extrinsics.wrist", "observation.extrinsics_valid.wrist"


def stretches(episode: str, last: str = "valid") -> list[Stretch]:
    """Six frames, ten a second: it moved between the third and the fifth, most probably before the fourth; in the
    second it wasn't valid.
    """
    at_ns = [round(1e9 * float(np.float32(i / 10))) for i in range(6)]
    plain = {"camera": WRIST, "episode": episode, "frames": 3}
    return [
        Stretch(
            start_ns=at_ns[0], end_ns=at_ns[2], verdict="valid", cam_T_grip=FIRST, **plain,
            not_valid_ns=((at_ns[1], at_ns[1]),),
        ),
        Stretch(
            stretch=1, start_ns=at_ns[3], end_ns=at_ns[5], verdict=last, cam_T_grip=LAST, not_valid_ns=(),
            motion_ns=at_ns[3], motion_earliest_ns=at_ns[2], motion_latest_ns=at_ns[4], **plain,
        ),
    ]  # fmt: skip


def write_stretches(folder: Path, rows: list[Stretch]) -> None:
    """As ``gripmon dataset`` writes them."""
    partitioning = ds.partitioning(pa.schema([("camera", pa.string())]), flavor="hive")
    ds.write_dataset(table_of(rows), folder, format="parquet", partitioning=partitioning)


def test_each_frame_has_the_transform_of_its_stretch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not to be used in valid stretches: the second frame, and those in which it may have moved by then or not."""
    calls: list[tuple[Any, dict, dict]] = []
    frames = {"episode_index": np.repeat([0, 1, 2], 6), "timestamp": np.tile(np.arange(6, dtype=np.float32) / 10, 3)}

    class Frames(dict):
        """As a dataset of the package ``datasets``, as far as it is asked."""

        def with_format(self, _: str) -> Frames:
            return self

        def select_columns(self, names: list[str]) -> Frames:
            return Frames({name: self[name] for name in names})

        def __getitem__(self, key: Any) -> Any:
            return self if isinstance(key, slice) else super().__getitem__(key)

    for name, function in (
        ("dataset_tools.add_features", lambda dataset, added, **how: calls.append((dataset, added, how))),
        ("lerobot_dataset.LeRobotDataset", lambda _, root: SimpleNamespace(root=root, hf_dataset=Frames(frames))),
    ):
        module, _, attribute = name.partition(".")
        stub = ModuleType(f"lerobot.datasets.{module}")
        setattr(stub, attribute, function)
        monkeypatch.setitem(sys.modules, stub.__name__, stub)
    fault = Stretch(camera=WRIST, episode="arm#000002", reason="too dark")
    rows = [*stretches("arm#000000"), *stretches("arm#000001", "suspect"), fault, *stretches("leg#000002")]
    write_stretches(tmp_path / "stretches", rows)
    runpy.run_path(str(EXAMPLE))["main"](tmp_path / "arm", tmp_path / "stretches", tmp_path / "copy", "arm")
    ((dataset, added, how),) = calls
    assert dataset.root == tmp_path / "arm" and how["output_dir"] == tmp_path / "copy"
    poses, flags = added[POSE][0], added[FLAG][0]
    assert poses.ndim == flags.ndim == 1, "pandas takes no column of two dimensions"
    poses = np.stack(list(poses))
    assert flags.tolist() == [1, 0, 1, 0, 1, 1] + [1, 0, 1, 0, 0, 0] + [0] * 6
    np.testing.assert_allclose(poses[:6], [FIRST] * 3 + [LAST] * 3, atol=1e-8)
    assert (poses[12:] == 0.0).all()
    assert [(about["dtype"], about["shape"]) for _, about in added.values()] == [("float32", (7,)), ("float32", (1,))]
