"""gripmon: watches whether a wrist camera still stands where its calibration says.

For programs and notebooks; the command line calls the same functions::

    import gripmon

    config = gripmon.load_config("arm1.yaml")
    monitor = gripmon.Monitor(config)  # no network, no files
    for frame in gripmon.open_source("images/"):
        record = monitor.process(frame)

A name is imported when it is first used: ``import gripmon`` by itself loads neither NumPy nor Zenoh nor rerun.  Wrong
input raises :class:`InputError` and sound input without a result :class:`NoResultError`, each with one line of text.
The rooms ``gripmon.simulate`` and ``gripmon.teach`` have those names already: their functions are
:func:`simulate_images` and :func:`teach_edges`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gripmon.analyse.api import correct, report
    from gripmon.calibrate.api import calibrate_intrinsics, calibrate_robot_world, verify
    from gripmon.client import Client, Fleet, TransformClient
    from gripmon.daemon.api import Monitor, open_source
    from gripmon.daemon.config import Config, load_config
    from gripmon.daemon.dataset import measure_dataset
    from gripmon.daemon.forecast import Forecast, forecast
    from gripmon.daemon.replaying import replay
    from gripmon.daemon.simulated import simulate_images
    from gripmon.laser.api import calibrate_laser
    from gripmon.model.errors import InputError, NoResultError
    from gripmon.model.records import Frame, FrameRecord
    from gripmon.record.export import export
    from gripmon.teach.api import teach as teach_edges
    from gripmon.teach.cad import gripper_from_cad
    from gripmon.teach.from_images import gripper_from_images
    from gripmon.teach.hand_eye import calibrate_plane

__version__ = "0.1.0"

_WHERE = {
    "Client": "client",
    "Config": "daemon.config",
    "Fleet": "client",
    "Forecast": "daemon.forecast",
    "Frame": "model.records",
    "FrameRecord": "model.records",
    "InputError": "model.errors",
    "Monitor": "daemon.api",
    "NoResultError": "model.errors",
    "TransformClient": "client",
    "calibrate_intrinsics": "calibrate.api",
    "calibrate_laser": "laser.api",
    "calibrate_plane": "teach.hand_eye",
    "calibrate_robot_world": "calibrate.api",
    "correct": "analyse.api",
    "export": "record.export",
    "forecast": "daemon.forecast",
    "gripper_from_cad": "teach.cad",
    "gripper_from_images": "teach.from_images",
    "load_config": "daemon.config",
    "measure_dataset": "daemon.dataset",
    "open_source": "daemon.api",
    "replay": "daemon.replaying",
    "report": "analyse.api",
    "simulate_images": "daemon.simulated",
    "teach_edges": "teach.api:teach",
    "verify": "calibrate.api",
}
"""Each public name, and the module below ``gripmon`` that has it; after a colon by which name, if by another."""

__all__ = [
    "Client",
    "Config",
    "Fleet",
    "Forecast",
    "Frame",
    "FrameRecord",
    "InputError",
    "Monitor",
    "NoResultError",
    "TransformClient",
    "__version__",
    "calibrate_intrinsics",
    "calibrate_laser",
    "calibrate_plane",
    "calibrate_robot_world",
    "correct",
    "export",
    "forecast",
    "gripper_from_cad",
    "gripper_from_images",
    "load_config",
    "measure_dataset",
    "open_source",
    "replay",
    "report",
    "simulate_images",
    "teach_edges",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'gripmon' has no attribute {name!r}")
    module, _, other = _WHERE[name].partition(":")
    found = getattr(importlib.import_module(f"gripmon.{module}"), other or name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
