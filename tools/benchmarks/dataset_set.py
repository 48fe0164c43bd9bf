"""A LeRobot dataset of any number of episodes, and a folder of files that can't be read, for :mod:`benchmarks.dataset`.

Four episodes of 10 s are rendered; the dataset's episodes are these over and over, each read and decoded by itself, as
format 3.0 lets episodes share a video file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gripmon.daemon.config import builtin_config, load_config
from gripmon.model.geometry import perturb
from gripmon.simulate import Rig, Scenario

CAMERA = "observation.images.wrist"
FPS, SECONDS, RENDERED = 30, 10, 4
_WIDTH_PX, _FOCAL_PX = 768, 962.0
_OPEN_M = 0.08  # of the jaws where the state's gripper is 1
_CONFIG = """\
robot: bench
camera_name: wrist
camera: {{model: paper, width_px: {w}, height_px: {h}, fx_px: {f}, fy_px: {f}, cx_px: {cx}, cy_px: {cy}}}
gripper: {gripper}
reference:
  cam_T_grip: {{translation_m: [0.0004, 0.0014, 0.1188], rotation_xyzw: [0.267184, 0.003984, -0.001105, 0.963637]}}
jaw: {{source: frames}}
source: {{kind: lerobot, path: set, opening: {{joints: [gripper], scale: {opened}}}}}
monitor:
  recalibration: {{sure_sigma_m: 1.0e-4}}
"""


def write_config(path: Path, size: tuple[int, int]) -> None:
    """The monitor's configuration for images of (width, height) px."""
    (w, h), scale = size, size[0] / _WIDTH_PX
    gripper = builtin_config("grippers/two_box_fingers.yaml")
    path.write_text(
        _CONFIG.format(w=w, h=h, f=_FOCAL_PX * scale, cx=(w - 1) / 2, cy=(h - 1) / 2, gripper=gripper, opened=_OPEN_M)
    )


def render(folder: Path, config: Path) -> list[list[float]]:
    """Write the videos of the rendered episodes below ``folder`` and return the jaw opening (m) of each frame."""
    loaded = load_config(config, check_source=False)
    openings_m = []
    for number in range(RENDERED):
        scenario = Scenario(name="episode", duration_s=float(SECONDS), fps=float(FPS))
        # Mountings some millimetres apart, as a fleet has them.
        cam_T_grip = perturb(loaded.cam_T_grip, np.array([0.001 * (number % 2), 0.0, 0.001 * (number // 2), 0, 0, 0.0]))
        simulator = Rig(loaded.camera, loaded.gripper, cam_T_grip).simulator(scenario, number)
        frames = [simulator.frame(i) for i in range(simulator.frame_count)]
        write_video(_video(folder, number), [np.asarray(frame.image) for frame in frames], FPS)
        openings_m.append([float(frame.jaw_opening_m or 0.0) for frame in frames])
    return openings_m


def write_set(root: Path, videos: Path, openings_m: list[list[float]], size: tuple[int, int], episodes: int) -> None:
    """A dataset of ``episodes`` with the rendered ``videos``."""
    count = SECONDS * FPS
    info = {
        "codebase_version": "v3.0", "fps": FPS, "chunks_size": 1000, "total_episodes": episodes,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": {
            CAMERA: {"dtype": "video", "shape": [size[1], size[0], 3], "names": ["height", "width", "channels"]},
            "observation.state": {"dtype": "float32", "shape": [1], "names": ["gripper"]},
        },
    }  # fmt: skip
    for folder in ("meta/episodes/chunk-000", "data/chunk-000"):
        (root / folder).mkdir(parents=True)
    (root / "videos").symlink_to(videos / "videos")
    (root / "meta" / "info.json").write_text(json.dumps(info))
    places = [
        {
            "episode_index": number, "length": count, "data/chunk_index": 0, "data/file_index": 0,
            f"videos/{CAMERA}/chunk_index": 0, f"videos/{CAMERA}/file_index": number % RENDERED,
            f"videos/{CAMERA}/from_timestamp": 0.0,
        }
        for number in range(episodes)
    ]  # fmt: skip
    pq.write_table(pa.Table.from_pylist(places), root / "meta/episodes/chunk-000/file-000.parquet")
    state = np.array([openings_m[number % RENDERED] for number in range(episodes)], np.float32) / _OPEN_M
    table = pa.table(
        {
            "observation.state": pa.FixedSizeListArray.from_arrays(pa.array(state.ravel()), 1),
            "timestamp": pa.array(np.tile(np.arange(count, dtype=np.float32) / FPS, episodes)),
            "episode_index": pa.array(np.repeat(np.arange(episodes), count)),
        }
    )
    pq.write_table(table, root / "data/chunk-000/file-000.parquet", row_group_size=100 * count)


def write_damaged(root: Path, files: int) -> None:
    """MCAP files that fail at once: what is left of an episode is the engine's own cost."""
    root.mkdir()
    for number in range(files):
        (root / f"{number}.mcap").write_bytes(b"nothing")


def _video(folder: Path, number: int) -> Path:
    return folder / "videos" / CAMERA / "chunk-000" / f"file-{number:03d}.mp4"


def write_video(
    path: Path, images: Sequence[np.ndarray], fps: int, codec: str = "libsvtav1", *, key_every: int = 2, crf: int = 30
) -> None:
    """Grey images as LeRobot encodes them: AV1 (or another ``codec``) at a constant quality, a key frame now and then
    (every other one, by default).
    """
    os.environ.setdefault("SVT_LOG", "1")  # errors alone
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = images[0].shape[:2]
    preset = {"preset": "12"} if codec == "libsvtav1" else {}
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream(codec, rate=fps, options={"g": str(key_every), "crf": str(crf)} | preset)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = number, Fraction(1, fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
