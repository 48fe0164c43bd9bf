"""Images of a simulated wrist camera in a folder, with the truth beside them and a configuration that fits."""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from gripmon import __version__
from gripmon.daemon.config import Config, builtin_config, load_config, load_scenario
from gripmon.model.errors import InputError
from gripmon.simulate import (
    CALIBRATION_KINDS,
    SCENARIO_NAMES,
    Rig,
    Scenario,
    Simulator,
    image_count,
    make_scenario,
    write_calibration_images,
    write_sequence,
)


class SimulatedImages(NamedTuple):
    """The folder, a configuration that fits (None where calibrations come first), and how many images there are."""

    folder: Path
    config: Path | None
    frames: int


def simulate_images(
    scenario: str | Path,
    out: str | Path,
    *,
    config: Config | None = None,
    seed: int = 0,
    duration_s: float | None = None,
    fps: float | None = None,
    step: Callable[[int, int], None] = lambda _done, _total: None,
) -> SimulatedImages:
    """Write one PNG a frame, ``timestamps.csv``, ``truth.jsonl`` (:class:`gripmon.simulate.FrameTruth`) and
    ``config.yaml`` with ``gripper.yaml`` to a new or empty folder.

    ``scenario`` is a built-in name (:data:`gripmon.simulate.SCENARIO_NAMES`), which ``duration_s`` (s) and ``fps``
    (1/s) stretch, or a YAML file; or what a calibration starts from (:data:`gripmon.simulate.CALIBRATION_KINDS`):
    single images with ``truth.json``.  "work" and these come without a configuration: the calibrations make it.
    ``config`` has camera, gripper and calibration; None: those of the demo.  ``step`` is called after each image with
    how many are done, of how many.  The same seed gives the same images.

    Raises :class:`InputError`: an unknown scenario, one that doesn't fit the configuration, a folder that isn't empty.
    """
    out = Path(out)
    config = load_config(builtin_config("demo.yaml"), check_source=False) if config is None else config
    if scenario in CALIBRATION_KINDS:
        return _calibration_images(str(scenario), out, config, seed, (duration_s, fps), step)
    made = _scenario(scenario, config, duration_s, fps)
    try:
        simulator = Simulator(config.camera, config.gripper, config.cam_T_grip, made, seed)
    except ValueError as error:
        raise InputError(f"{scenario}: {error}") from None
    _make_empty(out)
    if scenario == "work":
        return SimulatedImages(out, None, write_sequence(simulator, out, step))
    shutil.copyfile(config.gripper_path, out / "gripper.yaml")
    (out / "config.yaml").write_text(_config_text(config, made, seed), encoding="utf-8")
    return SimulatedImages(out, out / "config.yaml", write_sequence(simulator, out, step))


def _scenario(name: str | Path, config: Config, duration_s: float | None, fps: float | None) -> Scenario:
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        if duration_s is not None or fps is not None:
            raise InputError(f"{name}: --seconds and --fps are for built-in scenarios; duration_s and fps in the file")
        return load_scenario(path)
    if name not in SCENARIO_NAMES:
        raise InputError(f"simulate: there is no '{name}'; one of {', '.join((*SCENARIO_NAMES, *CALIBRATION_KINDS))}")
    try:
        return make_scenario(
            str(name),
            duration_s=duration_s,
            fps=fps,
            finger=config.gripper.finger_ids[0],
            jaw_opening_m=_rig(config).jaw_opening_m,
        )
    except ValueError as error:
        raise InputError(f"simulate: {error}") from None


def _rig(config: Config) -> Rig:
    return Rig(config.camera, config.gripper, config.cam_T_grip)


def _calibration_images(
    kind: str,
    out: Path,
    config: Config,
    seed: int,
    stretched: tuple[float | None, float | None],
    step: Callable[[int, int], None],
) -> SimulatedImages:
    if stretched != (None, None):
        raise InputError(f"simulate: {kind} is single images; neither --seconds nor --fps")
    _make_empty(out)
    count, done = image_count(kind), itertools.count(1)
    try:
        write_calibration_images(kind, _rig(config), out, seed, lambda: step(next(done), count))
    except ValueError as error:
        raise InputError(f"simulate {kind}: {error}") from None
    return SimulatedImages(out, None, count)


def _make_empty(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
        occupied = any(path.iterdir())
        wrong = "" if os.access(path, os.W_OK | os.X_OK) else "may not be written to; a directory of your own"
    except OSError as error:
        raise InputError(f"--out {path}: can't be made ({error.strerror}); a directory to write to") from None
    if occupied or wrong:
        raise InputError(f"--out {path}: {wrong or 'is not empty; a new or empty folder'}")


def _config_text(config: Config, scenario: Scenario, seed: int) -> str:
    """A configuration for the sequence, commented, in the form of the hand-written ones."""
    camera = msgspec.to_builtins(config.settings.camera)
    x, y, z, w = config.reference.cam_T_grip.rotation_xyzw
    lens = "\n".join(f"  {key}: {_yaml(value)}  # {_LENS_UNITS[key]}" for key, value in camera.items())
    jaw = "frames" if config.gripper.has_jaw and scenario.jaw.reported else "fixed"
    return f"""\
# Written by: gripmon simulate {scenario.name} --seed {seed} (gripmon {__version__})
robot: simulated  # name of the robot in the Zenoh keys
camera_name: wrist  # name of the camera in the Zenoh keys
camera:
{lens}
gripper: gripper.yaml  # path of the gripper file, relative to this file
reference:
  cam_T_grip:  # what a perfect calibration gave at the beginning: maps gripper coordinates to camera coordinates
    translation_m: {_yaml(list(config.reference.cam_T_grip.translation_m))}  # x, y, z (m)
    rotation_xyzw: {_yaml([x, y, z, w])}  # unit quaternion x, y, z, w
jaw:
  source: {jaw}  # the opening comes with each frame (timestamps.csv), or is the nominal one if fixed
source:
  kind: folder  # images in a folder
  path: .  # the folder, relative to this file
"""


_LENS_UNITS = {
    "model": "lens model: paper, brown_conrady or fisheye",
    "width_px": "image width (px)",
    "height_px": "image height (px)",
    "fx_px": "focal length over the pixel's width (px)",
    "fy_px": "focal length over the pixel's height (px)",
    "cx_px": "column of the principal point (px)",
    "cy_px": "row of the principal point (px)",
    "kappa_per_px2": "radial distortion (1/px²)",
    "coefficients": "distortion in OpenCV's order (no unit)",
}


def _yaml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_yaml, value))}]"
    return repr(value) if isinstance(value, float) else str(value)
