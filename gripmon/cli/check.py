"""``gripmon check``: validate a configuration and forecast its performance; test whether a laser calibration holds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import render, sweep
from gripmon.cli.common import Arguments, Command, arm_noise, positive_number, progress_bar
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED

if TYPE_CHECKING:
    from gripmon.laser.check import CheckSettings
    from gripmon.laser.documents import LaserCalibration

_OPTIONS = """
[CONFIG...]  configuration file (YAML); with --laser: tables of fresh spots
--json          one JSON object instead of text; metres, radians, px
--verbose       also the forecast in numbers, as --json has it, in mm and degrees
--images INPUT  images of the gripper at the reference, a folder or a video, to run the monitor over (default: the
                recorded source, else those that were taught from)
--picture FILE  draw the first image with the edges that make the bounds as large (.png, .jpg)
"""

_LASER = """\
Instead of a configuration: does a file of gripmon calibrate laser still hold?  SPOTS are fresh tables of \
spots and poses as for gripmon calibrate laser.  Without SPOTS: which motions fresh spots would detect."""

_LASER_OPTIONS = """
--laser LASER.yaml  the calibration; the other arguments are SPOTS, if any
--arm-noise M:RAD   standard deviations of the arm's poses, position (m) and rotation (rad), each axis
                    (default 0.0001:0.0002)
--false-alarms N    false alarms per 1000 spots of an unmoved set-up (default 0.1, at most 10)
--wrong-spots PART  fraction of the spots that may be reflections (default 0.2, at most 0.5)
"""

_EXAMPLES = """\
  gripmon check configs/live_camera.yaml
  gripmon check configs/demo.yaml --verbose
  gripmon check mine/arm1.yaml --images mine/first --picture doubts.png
  gripmon check configs/demo.yaml --json | python3 -m json.tool
  gripmon check configs/folder.yaml --sweep --distance 0.08:0.2:7 --tilt 10:60:6
  gripmon check configs/folder.yaml --sweep --fov 40,60,80 --roll 0,90 --at 384,288
  gripmon check --laser laser.yaml
  gripmon check --laser laser.yaml fresh_spots.csv --arm-noise 0.0002:0.0004

exit codes: 0 sound, perhaps with warnings; 2 a fault in the configuration or in the Zenoh file that it
names, or a missing package (one line says file, key, what is wrong, what would be right); 3 a line
says FAIL, such as a camera that can't be reached now; or something has moved since a laser calibration,
or its spots are inconclusive"""

_WAYS = ("beam and plane / ray and plane", "ray and plane / beam and ray", "beam / ray")
_MOST = {"false_alarms": 10.0, "wrong_spots": 0.5}


@Command(
    _OPTIONS, _EXAMPLES,
    {"sweep of camera mounts": (sweep.ABOUT, sweep.OPTIONS), "laser calibration": (_LASER, _LASER_OPTIONS)},
    arm_noise=arm_noise, false_alarms=positive_number, wrong_spots=positive_number,
)  # fmt: skip
def check(arguments: Arguments) -> int:
    """Validate a configuration, its gripper file and its source, and rate each aspect: OK, WARN (the monitor
    runs, with limitations) or FAIL (it can't work).

    The promise is what the monitor itself says over images that are there: those of a recorded source, those
    that were taught from, or --images; at most the first hundred.  It names the edge or the end of a finger
    that makes the bounds as large, alert limits that nine of ten such frames would keep, and what would help
    most.  Without images it is a forecast from the geometry, and says so: what stands behind the fingers isn't
    in it.

    With --verbose, also the forecast: where the fingertip corners are in the image, which of them and which
    edges are visible, the accuracy of one frame along each axis, what the view can't separate (an unknown
    jaw opening and the distance), whether its corners suffice to recalibrate, how far camera and jaws may
    move until too little is in view.  The values are those of --json, under the same names.

    With --laser, in place of a configuration: does a laser calibration still hold?  Which motions of
    camera, plane and laser pointer fresh spots would detect, or which they show.

    With --sweep: what other camera mounts and lenses would see, as a table, before anyone
    drills a hole.
    """
    if arguments.laser is not None and arguments.sweep:
        raise InputError("--sweep: not with --laser; one of them")
    if not arguments.sweep:
        arguments.refuse(sweep.NAMES, "applies only to a sweep; add --sweep")
    if arguments.laser is not None:
        arguments.refuse(("images", "picture"), "not with --laser, which has spots; leave it out")
        return _check_laser(arguments)
    if arguments.sweep:
        arguments.refuse(("images", "picture"), "not with --sweep, a table of what is forecast; leave it out")
    names, why = ("arm_noise", *_MOST), "applies only to a laser calibration; add --laser LASER.yaml"
    arguments.refuse(names, why)
    if len(arguments.config) != 1:
        raise InputError(f"check: {len(arguments.config)} configurations; one, or --laser LASER.yaml")
    return sweep.run(arguments) if arguments.sweep else _check(arguments)


def _check(arguments: Arguments) -> int:
    from gripmon.daemon.findings import check_file

    arguments.check_outputs("picture")
    found = check_file(arguments.config[0], arguments.images)
    values = {"findings": [each._asdict() for each in found.findings], **found.values()}
    arguments.answer(values, _lines(values, verbose=arguments.verbose))
    if arguments.picture is not None:
        drawn = found.picture(arguments.picture.suffix)
        if drawn is None:
            raise NoResultError("--picture: no image of the gripper to draw in; --images FOLDER")
        arguments.save("picture", drawn)
        if not arguments.json:
            print(f"picture: {arguments.picture}")
    return EXIT_FAILED if any(each.level == "FAIL" for each in found.findings) else EXIT_DONE


def _lines(values: dict[str, Any], *, verbose: bool) -> list[str]:
    """A headline, then a line a finding; with ``verbose`` all other values."""
    findings, rest = values["findings"], _in_tables(values)
    parts = []
    for level, what, none in (("FAIL", "failure", "sound"), ("WARN", "warning", "")):
        count = sum(each["level"] == level for each in findings)
        parts.append(f"{count} {what}{'s' * (count > 1)}" if count else none)
    head = f"{values['config']}: {', '.join(filter(None, parts))}"
    rows = render.columns([[*each.values()] for each in findings])
    return [head, *rows, *(["", *render.lines(rest)] if verbose else [])]


def _in_tables(values: dict[str, Any]) -> dict[str, Any]:
    """All but the findings, with a table where a mapping's keys are values, or None means more than nothing."""
    accuracy, in_view = values["accuracy"], values["in_view"]
    if (drift := accuracy["drift"]) is not None:
        rows = [
            {"step_m": float(step_m), **dict(zip("xyz", ("never" if n is None else n for n in frames), strict=True))}
            for step_m, frames in drift["delay_frames"].items()
        ]
        accuracy = {**accuracy, "drift": {**drift, "delay_frames": rows}}
    if (freedom := in_view["camera_may_move"]) is not None:
        in_view = {**in_view, "camera_may_move": [*_freedom(freedom, "shift", "m"), *_freedom(freedom, "turn", "rad")]}
    rest = {key: value for key, value in values.items() if key != "findings"}
    return {**rest, "accuracy": accuracy, "in_view": in_view}


def _freedom(freedom: dict[str, Any], motion: str, unit: str) -> Iterator[dict[str, Any]]:
    """A row for each axis and direction of a motion."""
    sought = render.amount(f"sought_{unit}", freedom[f"sought_{unit}"])
    for axis, amounts in freedom[f"{motion}_{unit}"].items():
        for sign, amount, reason in zip("-+", amounts, freedom[f"{motion}_reason"][axis], strict=True):
            by = f"more than {sought}" if amount is None else render.amount(f"by_{unit}", amount)
            yield {"motion": f"{motion} {sign}{axis}", "by": by, "then": reason}


def _check_laser(arguments: Arguments) -> int:
    import msgspec

    from gripmon.laser.api import check_laser, forecast_laser

    settings, path = _check_settings(arguments), arguments.laser
    if not path.is_file():
        raise InputError(f"--laser {path}: there is no such file; a file of gripmon calibrate laser")
    calibration = _read_laser(path)
    residuals = calibration.residuals
    header = {
        "calibration": str(path),
        "time": calibration.provenance.time,
        "spots": residuals.spots,
        "used": residuals.used,
        "rms_px": residuals.rms_px,
        "arm_noise_m": settings.arm_noise_m,
        "arm_noise_rad": settings.arm_noise_rad,
        "false_alarms_per_1000_spots": settings.false_alarms_per_1000_spots,
    }
    if not arguments.config:
        report = {**header, **msgspec.to_builtins(forecast_laser(calibration, settings))}
        arguments.answer(report, render.lines(report))
        return EXIT_DONE
    found = check_laser(calibration, [Path(name) for name in arguments.config], settings, progress_bar)
    report = {**header, **msgspec.to_builtins(found)}
    shown = {**report, "spots_judged": [_spot_row(each) for each in report["spots_judged"]]}
    shown["verdict"] = f"{shown.pop('verdict')}: {shown.pop('text')}"  # last
    arguments.answer(report, render.lines(shown))
    return EXIT_DONE if found.verdict == "same" else EXIT_FAILED


def _spot_row(spot: dict[str, Any]) -> dict[str, Any]:
    """How far a spot is off what was predicted, in the image, and by how much each two ways to it disagree."""
    off_px = None if spot["off_px"] is None else math.hypot(*spot["off_px"])
    row = {"spot": spot["name"], "off_px": off_px, "sigmas": spot["sigmas"], **dict.fromkeys(_WAYS)}
    for gap in (gap for gap in spot["disagreements"] if " / ".join(gap["ways"]) in row):
        row[" / ".join(gap["ways"])] = f"{1e3 * gap['distance_m']:.2f} mm ({math.sqrt(gap['square']):.1f} sigmas)"
    return {**row, "reason": spot["reason"]}


def _read_laser(path: Path) -> LaserCalibration:
    from gripmon.calibrate.sighting import CalibrationError
    from gripmon.daemon.config.typed import ConfigError
    from gripmon.daemon.config.yaml_file import read_document
    from gripmon.laser.documents import LaserCalibration, calibrated

    calibration = read_document(path, LaserCalibration)
    try:
        calibrated(calibration)  # whether its numbers make a set-up
    except (CalibrationError, ValueError) as error:
        raise ConfigError(path, "", str(error)) from None
    return calibration


def _check_settings(arguments: Arguments) -> CheckSettings:
    from gripmon.laser.check import CheckSettings

    given: dict[str, Any] = {}
    if arguments.arm_noise is not None:
        given["arm_noise_m"], given["arm_noise_rad"] = arguments.arm_noise
    for name, most in _MOST.items():
        value = getattr(arguments, name)
        if value is not None and value > most:
            raise InputError(f"--{name.replace('_', '-')} {value:g}: too many; at most {most:g}")
        if value is not None:
            given["false_alarms_per_1000_spots" if name == "false_alarms" else name] = value
    return CheckSettings(**given)
