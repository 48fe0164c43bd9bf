"""A second camera with a pulsed laser: calibrated by the command, its pulses rendered, the camera moved where asked."""

from __future__ import annotations

import atexit
import csv
import shutil
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp

import cv2
import msgspec
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from gripmon.calibrate.documents import CameraCalibration, CameraResiduals
from gripmon.cli import main
from gripmon.laser.setup import LaserSetup, spots_on_plane
from gripmon.model.geometry import perturb
from gripmon.model.provenance import provenance_of
from gripmon.model.records import Array, Image
from gripmon.model.yaml_text import as_yaml
from gripmon.simulate.laser import spot_image
from support.laser_scenes import PAPER_LENS, LaserData, paper_setup, sampled

PREFIX = "gripmon/cell/second"
MOVED = np.array([0.004, -0.003, 0.002, 0.004, 0.006, -0.003])
"""A knock of the camera: perturbs ``cam_T_base`` (m, rad)."""

PULSE_NS, PERIOD_NS = 200_000_000, 400_000_000
_PATCH_PX = 61


@dataclass(frozen=True)
class Cell:
    """``folder`` holds ``laser.yaml``, calibrated from other spots than ``data``, whose noise is 0.3 px."""

    folder: Path
    data: LaserData

    def uv_px(self, pulse: int, moved: Array | None = None) -> Array:
        """Where the spot of a pulse is, the camera moved or not."""
        setup: LaserSetup = self.data.truth
        if moved is not None:
            setup = replace(setup, cam_T_base=perturb(setup.cam_T_base, moved), **_plane_seen(setup, moved))
        spot = spots_on_plane(setup, self.data.base_T_ee[pulse][None])[0]
        return self.data.camera.project(spot)[0]


def _plane_seen(setup: LaserSetup, moved: Array) -> dict[str, object]:
    """The plane stands still in the base: a camera that moved has it elsewhere."""
    cam2_T_cam1 = perturb(setup.cam_T_base, moved) @ np.linalg.inv(setup.cam_T_base)
    normal = cam2_T_cam1[:3, :3] @ setup.normal_cam
    return {"normal_cam": normal, "distance_m": setup.distance_m + float(normal @ cam2_T_cam1[:3, 3])}


@lru_cache(maxsize=1)
def cell() -> Cell:
    """The same for all tests of a process."""
    folder = Path(mkdtemp(prefix="gripmon-cell-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    rng = np.random.default_rng(4)
    setup = paper_setup(rng)
    known = sampled(setup, rng, orientations=9)
    _write_camera(folder / "camera.yaml")
    write_table(
        folder / "spots.csv", known.base_T_ee, {"u_px": known.uv_px[:, 0] + rng.normal(0.0, 0.3, len(known.uv_px)),
                                                "v_px": known.uv_px[:, 1] + rng.normal(0.0, 0.3, len(known.uv_px))}
    )  # fmt: skip
    arguments = [
        str(folder / "spots.csv"),
        "--camera",
        str(folder / "camera.yaml"),
        "--out",
        str(folder / "laser.yaml"),
    ]
    assert main(["calibrate", "laser", *arguments]) == 0
    data = sampled(setup, rng, orientations=4)
    order = rng.permutation(len(data.base_T_ee))
    return Cell(folder, replace(data, base_T_ee=data.base_T_ee[order], uv_px=data.uv_px[order]))


def _write_camera(path: Path) -> None:
    calibration = CameraCalibration(
        camera=PAPER_LENS,
        parameters=("fx_px", "fy_px", "cx_px", "cy_px"),
        covariance=tuple(np.diag([0.01] * 4).ravel().tolist()),
        residuals=CameraResiduals(rms_px=0.1, views=10, points=500, outliers=0),
        target="chequerboard:9x6:0.025",
        provenance=provenance_of("test"),
    )
    path.write_text(as_yaml(msgspec.to_builtins(calibration)))


def write_table(path: Path, base_T_ee: Array, columns: dict[str, Array]) -> None:
    """A table of poses with further columns before them."""
    quaternions = Rotation.from_matrix(base_T_ee[:, :3, :3]).as_quat()
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*columns, "tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"])
        for k, pose in enumerate(base_T_ee):
            values = [column[k].item() for column in columns.values()]
            writer.writerow([*values, *pose[:3, 3].tolist(), *quaternions[k].tolist()])


def lit(uv_px: Array, rng: np.random.Generator) -> Image:
    """A frame with the laser on: the spot is rendered on a patch, which is faster."""
    corner = np.rint(uv_px).astype(int) - _PATCH_PX // 2
    spot = spot_image(uv_px - corner, rng, size_px=(_PATCH_PX, _PATCH_PX), height=120.0, speckle=0.1, noise=0.0)
    image = _ambient(rng)
    rows, columns = (slice(max(corner[k], 0), corner[k] + _PATCH_PX) for k in (1, 0))
    here = image[rows, columns]
    top, left = (max(-corner[k], 0) for k in (1, 0))
    here += spot[top : top + here.shape[0], left : left + here.shape[1]].astype(np.float32) - 30.0
    return _rounded(image)


def dark(rng: np.random.Generator) -> Image:
    """A frame with the laser off."""
    return _rounded(_ambient(rng))


def _ambient(rng: np.random.Generator) -> Array:
    noise: Array = rng.standard_normal((480, 640), np.float32)
    return 30.0 + 2.0 * noise


def _rounded(image: Array) -> Image:
    out: Image = np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)
    return out


def write_folder(cell: Cell, folder: Path, pulses: int, moved_from: int | None = None) -> None:
    """``images/`` with stamps and ``pulses.csv``: before each pulse a dark frame, within it three, of which the outer
    ones lie in the margin.
    """
    images = folder / "images"
    images.mkdir()
    rng = np.random.default_rng(7)
    rows = []
    begins_ns = PERIOD_NS * (1 + np.arange(pulses))
    for k in range(pulses):
        uv = cell.uv_px(k, MOVED if moved_from is not None and k >= moved_from else None)
        for offset_ns, image in ((-100_000_000, dark(rng)), (100_000_000, lit(uv, rng)), (140_000_000, lit(uv, rng))):
            name = f"{len(rows):04d}.png"
            cv2.imwrite(str(images / name), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            rows.append((name, int(begins_ns[k]) + offset_ns))
    (images / "timestamps.csv").write_text("file,stamp_ns\n" + "".join(f"{n},{s}\n" for n, s in rows))
    write_table(
        folder / "pulses.csv", cell.data.base_T_ee[:pulses], {"stamp_ns": begins_ns, "until_ns": begins_ns + PULSE_NS}
    )


def write_config(cell: Cell, folder: Path, endpoint: str | None, **sections: object) -> Path:
    """A configuration beside the frames; ``endpoint``: where it listens, None: nothing is published."""
    values = {
        "robot": "cell",
        "camera_name": "second",
        "laser": {"calibration": str(cell.folder / "laser.yaml"), "pulses": "pulses.csv"},
        "source": {"kind": "folder", "path": "images"},
        "publish": {"enabled": False} if endpoint is None else {"listen": [endpoint]},
        "recording": {"enabled": False},
        **sections,
    }
    path = folder / "second.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in values.items() if value is not None}))
    return path
