"""A simulated wrist camera: in real time from its own process, or as a sequence as fast as it is read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec

from gripmon.io.sources.base import Source, SourceError, Stored
from gripmon.model.errors import one_line
from gripmon.model.records import Frame

if TYPE_CHECKING:
    from gripmon.simulate import Rig, Scenario, Simulator


class SimulatedSettings(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="simulator"
):
    """A simulated camera with the configuration's lens, gripper and calibration."""

    scenario: Annotated[
        str, msgspec.Meta(min_length=1, description="name of a built-in scenario, or a YAML file that describes one")
    ] = "demo"
    duration_s: Annotated[
        Annotated[float, msgspec.Meta(gt=0, le=1e7)] | None,
        msgspec.Meta(description="length to which a built-in scenario is stretched; absent: its own length (s)"),
    ] = None
    fps: Annotated[
        Annotated[float, msgspec.Meta(gt=0, le=1000)] | None,
        msgspec.Meta(description="frame rate of a built-in scenario; absent: its own (1/s)"),
    ] = None
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**32, description="seed of the random numbers (no unit)")] = 0
    realtime: Annotated[
        bool,
        msgspec.Meta(
            description="true: frames come at the camera's rate, as from a live camera; false: every frame, "
            "as fast as it is processed"
        ),
    ] = True
    ends: Annotated[
        bool, msgspec.Meta(description="with realtime: true: end with the scenario; false: continue in its last state")
    ] = False
    processes: Annotated[
        int, msgspec.Meta(ge=1, le=4, description="with realtime: how many processes render the frames (number)")
    ] = 2


def make_simulator(settings: SimulatedSettings, scene: Rig, relative_to: Path) -> Simulator:
    """The simulator for these settings, which also has the truth; SourceError if they don't fit the scene."""
    scenario = _load_scenario(settings, relative_to)
    try:
        return scene.simulator(scenario, settings.seed)
    except ValueError as error:
        raise SourceError(f"scenario: {error}") from error


def _load_scenario(settings: SimulatedSettings, relative_to: Path) -> Scenario:
    from gripmon.simulate import Scenario, make_scenario

    if not settings.scenario.endswith((".yaml", ".yml")):
        try:
            return make_scenario(settings.scenario, duration_s=settings.duration_s, fps=settings.fps)
        except ValueError as error:
            raise SourceError(str(error)) from error
    path = relative_to / settings.scenario
    if settings.duration_s is not None or settings.fps is not None:
        raise SourceError(f"scenario: {path} has its own duration_s and fps; neither beside it")
    try:
        return msgspec.yaml.decode(path.read_bytes(), type=Scenario)
    except (OSError, msgspec.DecodeError) as error:
        raise SourceError(
            f"scenario: {path} can't be used ({one_line(error)}); a file with the keys of a scenario"
        ) from error


class SimulatedSequence(Stored):
    """Every frame of a scenario in order, rendered when it is read; stamps are the scenario's."""

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self._count = simulator.frame_count
        self._seq = 0

    def __len__(self) -> int:
        return self._count

    def read(self) -> Frame | None:
        if self._seq >= self._count:
            return None
        frame = self._simulator.frame(self._seq)
        self._seq += 1
        return frame

    def close(self) -> None:
        self._count = 0


def open_simulated(settings: SimulatedSettings, scene: Rig, relative_to: Path) -> Source:
    """The simulated camera, live or as a sequence, depending on the settings."""
    simulator = make_simulator(settings, scene, relative_to)
    if not settings.realtime:
        return SimulatedSequence(simulator)
    from gripmon.io.sources.realtime import SimulatedCamera

    return SimulatedCamera(
        simulator,
        size_px=(scene.camera.width_px, scene.camera.height_px),
        fps=simulator.scenario.fps,
        name=simulator.scenario.name,
        frame_count=simulator.frame_count if settings.ends else None,
        processes=settings.processes,
    )
