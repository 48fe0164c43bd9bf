"""The results of ``gripmon dataset`` as columns of a LeRobot dataset: a copy, made by LeRobot's own tools.

    gripmon dataset set --config wrist.yaml --out extrinsics --camera observation.images.wrist
    lerobot-env/bin/python lerobot_extrinsics.py set extrinsics/stretches set_extrinsics

Runs in LeRobot's environment (lerobot 0.4, datasets of format 3.0; docs/howto/lerobot.md says how to install gripmon's
client there).  Each frame of the copy has ``observation.extrinsics.<camera>``, the transform ``cam_T_grip`` of its
stretch (m, then the quaternion x, y, z, w; all 0 where it is unknown, which is no rotation), and
``observation.extrinsics_valid.<camera>``, 1 where it may be used.  The original isn't touched, nor is a folder that is
there already.  If ``set`` was one of several datasets below the folder given to ``gripmon dataset``, its path below
that folder is a fourth argument.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset as ds
from lerobot.datasets.dataset_tools import add_features
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from gripmon.model.lerobot_columns import POSE_NAMES, extrinsics_features


def transforms_at(rows: list[dict[str, Any]], stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transforms (n, 7) and flags (n,) at the frames of one episode, from its rows.  A transform holds in its stretch
    but for the frames in ``not_valid_ns``; while the camera may have moved, those of neither side do.
    """
    poses, usable = np.zeros((len(stamps_ns), 7), np.float32), np.zeros(len(stamps_ns), np.float32)
    known = [row for row in rows if row["cam_T_grip_tx_m"] is not None]
    for row in known:
        inside = (stamps_ns >= row["start_ns"]) & (stamps_ns <= row["end_ns"])
        poses[inside] = [row[f"cam_T_grip_{name}"] for name in POSE_NAMES]
        usable[inside] = row["verdict"] == "valid"
        for first, last in row["not_valid_ns"]:
            usable[(stamps_ns >= first) & (stamps_ns <= last)] = 0.0
    for row in known:
        if row["motion_ns"] is not None:
            usable[(stamps_ns > row["motion_earliest_ns"]) & (stamps_ns < row["motion_latest_ns"])] = 0.0
    return poses, usable


def columns(
    stretches: Path, episode_index: np.ndarray, timestamp_s: np.ndarray, below: str = ""
) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
    """What ``add_features`` takes, for frames (n,) with their episodes and time stamps: each column's values and its
    description.
    """
    table = ds.dataset(stretches, partitioning="hive").to_table()
    rows = table.drop_columns(["picture"]).to_pylist()
    stamps_ns = np.round(1e9 * timestamp_s.astype(float)).astype(np.int64)
    features: dict[str, tuple[np.ndarray, dict[str, Any]]] = {}
    for camera in sorted({row["camera"] for row in rows}):
        poses, usable = np.zeros((len(stamps_ns), 7), np.float32), np.zeros(len(stamps_ns), np.float32)
        of_episode: dict[str, list[dict[str, Any]]] = {}
        for row in rows:
            if row["camera"] == camera:
                of_episode.setdefault(row["episode"], []).append(row)
        for number in np.unique(episode_index).tolist():
            mine = episode_index == number
            poses[mine], usable[mine] = transforms_at(of_episode.get(f"{below}#{number:06d}", []), stamps_ns[mine])
        for (name, about), values in zip(extrinsics_features(camera).items(), (poses, usable), strict=True):
            features[name] = values, about | {"shape": tuple(about["shape"])}
    return features


def _one_each(values: np.ndarray) -> np.ndarray:
    """The values of the frames (n,), each a number or an array: pandas takes no column of two dimensions."""
    if values.ndim == 1:
        return values
    rows = np.empty(len(values), object)
    for number, row in enumerate(values):
        rows[number] = row
    return rows


def main(root: Path, stretches: Path, copy: Path, below: str = "") -> None:
    """Make the copy."""
    if copy.exists():
        raise SystemExit(f"{copy} is there already; a folder that isn't")
    dataset = LeRobotDataset("local/original", root=root)
    frames = dataset.hf_dataset.with_format("numpy").select_columns(["episode_index", "timestamp"])[:]
    added = columns(stretches, np.ravel(frames["episode_index"]), np.ravel(frames["timestamp"]), below)
    taken = {name: (_one_each(values), about) for name, (values, about) in added.items()}
    add_features(dataset, taken, output_dir=copy, repo_id="local/with_extrinsics")
    for name, (values, _) in added.items():
        if values.ndim == 1:
            print(f"{name}: 1 in {int(values.sum())} of {len(values)} frames")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]), *sys.argv[4:5])
