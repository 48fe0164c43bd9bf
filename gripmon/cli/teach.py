"""``gripmon teach``: what the gripper's edges look like, from images at the reference calibration."""

from __future__ import annotations

import argparse
import math
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.teach.measure import Taught
    from gripmon.track.edges.taught import TaughtEdge

_DESCRIPTION = """\
Measure where each edge of the gripper really shows, in images taken at the reference calibration,
and write it as a taught model.  Named in the configuration (`taught: taught.yaml`), it makes the
monitor compare like with like: what bevels, rounded edges, shading and blur shift the edges by
cancels.  The reference is by definition the gripper's pose in these images.

With --page a person drags rough corners onto the fingertips, on a web page that only this machine
can open, sees the edges snap and what accuracy to expect, and saves the taught model together with
a configuration for gripmon check and gripmon run; no configuration is needed for that, only the
camera's calibration and the gripper file.  Without --reference the pose comes from the corners,
less exactly than from a plate (gripmon calibrate plane).  --corners does the same without a page.
With neither --gripper nor --config the page writes rough.yaml, for gripmon calibrate plane --infer.

Best are three to ten images without any motion of the camera, in focus, the fingers free and lit as
in use, each before another background, some with the jaws opened otherwise."""

_EXAMPLES = """\
  gripmon teach first/*.png --config mine/arm1.yaml
  gripmon teach now.png --config mine/arm1.yaml --jaw-opening 0.034 --picture taught.png
  gripmon check mine/arm1.yaml

a gripper without a file: rough.yaml for gripmon calibrate plane --infer
  gripmon teach --page on_plate.png --camera camera.yaml

a new robot, without any configuration: put corners on the fingertips, on a page in your browser
  gripmon teach --page first/*.png --camera camera.yaml --gripper gripper.yaml --out mine
  gripmon teach --page --live 0 --camera camera.yaml --gripper gripper.yaml --reference hand_eye.yaml
  gripmon teach first.png --corners rough.yaml --camera camera.yaml --gripper gripper.yaml --out mine

exit codes: 0 written; 2 wrong usage, configuration or image files; 3 these images can't be taught
from, and why: nothing is written then"""


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "teach", run, "learn how the gripper's edges look at the reference", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("images", nargs="*", metavar="IMAGE", help="image file at the reference calibration")
    parser.add_argument("--config", metavar="CONFIG", help="configuration (YAML); its source section is not used")
    parser.add_argument(
        "--out",
        metavar="FILE",
        help="file to write (default: what the configuration names under taught, else taught.yaml beside it); with "
        "--page or --corners the folder to write to (default: the configuration's, else this one)",
    )
    parser.add_argument(
        "--jaw-opening",
        type=common.positive_number,
        metavar="M",
        help="jaw opening in all images (m); default: with jaw.source fixed jaw.opening_m, or the gripper's "
        "nominal if that is absent, else from a timestamps.csv beside each image",
    )
    parser.add_argument(
        "--picture", metavar="FILE.png", help="also draw the first image with what was taught, offsets enlarged"
    )
    parser.add_argument("--force", action="store_true", help="replace the file if there is one")
    parser.add_argument(
        "--into-config", action="store_true", help="also write the line that names it into the configuration"
    )
    _add_corner_options(parser)


def _add_corner_options(parser: argparse.ArgumentParser) -> None:
    """Those of teaching from corners that a person puts on the fingertips."""
    page = parser.add_argument_group("corners by hand")
    page.add_argument("--page", action="store_true", help="teach on a local web page")
    page.add_argument("--corners", metavar="FILE", help="without a page: rough corners, `corners: {name: [u, v], …}`")
    page.add_argument("--live", metavar="DEVICE", help="with --page: a camera instead of images, as in source.device")
    page.add_argument(
        "--live-wait", type=common.positive_number, metavar="S",
        help="give up when this camera has shown nothing for so long (s); default: never, the page says what is wrong",
    )  # fmt: skip
    page.add_argument("--camera", metavar="FILE", help="without --config: the camera's calibration")
    page.add_argument("--gripper", metavar="FILE", help="without --config: the gripper file")
    page.add_argument("--reference", metavar="FILE", help="without --config: calibration of hand and eye, if there is")
    page.add_argument(
        "--jaw-source",
        choices=("fixed", "frames", "zenoh"),
        help="in the configuration written: where jaw openings come from; zenoh: the robot says them (default: "
        "frames with a timestamps.csv that has them, else fixed)",
    )
    page.add_argument("--robot", type=_key, metavar="NAME", help="the robot's name in the configuration written")
    page.add_argument("--camera-name", type=_key, metavar="NAME", help="the camera's name in it")
    page.add_argument("--port", type=_port, default=0, metavar="N", help="port of the page (default: any free one)")
    page.add_argument("--no-browser", action="store_true", help="print the page's address, but open no browser")


def _key(text: str) -> str:
    """A name that may stand in a key on the network."""
    if not text or re.fullmatch(r"[^/*$#?@\s][^/*$#?\s]*", text) is None:
        raise argparse.ArgumentTypeError(f"'{text}' is no name; no blank, none of / * $ # ?, no @ in front")
    return text


def _port(text: str) -> int:
    if not (text.isdecimal() and int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"'{text}' is no port; a whole number, 0 (any free one) to 65535")
    return int(text)


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon teach``."""
    if arguments.page or arguments.corners is not None or arguments.live is not None:
        from gripmon.cli import teach_corners

        return teach_corners.run(arguments, command(arguments))
    _check_usage(arguments)
    from gripmon.daemon.config import load_config
    from gripmon.daemon.teaching import name_taught
    from gripmon.teach.api import teach

    config = load_config(Path(arguments.config), check_source=False, with_taught=False)
    out = _out(arguments, config)
    taught = teach(config, arguments.images, jaw_opening_m=arguments.jaw_opening, command=command(arguments))
    _write(out, taught.text().encode(), "--out")
    if arguments.into_config:
        config = name_taught(config, out)
    print(_summary(config, taught.taught, out))
    if arguments.picture is not None:
        picture = Path(arguments.picture)
        _write(picture, taught.picture(picture.suffix), "--picture")
    return common.EXIT_DONE


def command(arguments: argparse.Namespace) -> str:
    """The command line, as files name it that it writes."""
    words = ["gripmon", "teach", *(["--page"] if arguments.page else []), *arguments.images]
    for name in ("live", "corners", "config", "camera", "gripper", "reference", "out", "jaw_opening", "jaw_source"):
        value = getattr(arguments, name)
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def _check_usage(arguments: argparse.Namespace) -> None:
    """Without corners by hand images and a configuration are needed; nothing else makes sense."""

    def refuse(text: str) -> None:
        raise InputError(f"teach: {text}")

    if not arguments.images:
        refuse("no image; image files, or --page --live DEVICE")
    if arguments.config is None:
        refuse("--config is missing; a configuration, or --page with --camera and --gripper")
    for option in ("camera", "gripper", "reference", "robot", "camera_name", "live_wait", "jaw_source"):
        if getattr(arguments, option) is not None:
            refuse(f"--{option.replace('_', '-')} goes with --page or --corners")


def _out(arguments: argparse.Namespace, config: Config) -> Path:
    """Where to write; refused before any work if that can't be."""
    named = config.taught_path or config.directory / "taught.yaml"
    out = named if arguments.out is None else Path(arguments.out)
    for path, option in ((out, "--out"), (arguments.picture and Path(arguments.picture), "--picture")):
        if path:
            common.make_directory(path.parent, option)
            if path.is_dir():
                raise InputError(f"{option} {path}: is a folder; a file")
    if arguments.into_config and config.taught_path is not None and config.taught_path.resolve() != out.resolve():
        raise InputError(
            f"--into-config: {config.path} names {config.taught_path} already; without it, or without --out"
        )
    if out.exists() and not arguments.force:
        raise InputError(f"--out {out}: is there already; another file, or --force to replace it")
    if arguments.picture is not None and Path(arguments.picture).suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"--picture {arguments.picture}: has no known ending; .png or .jpg")
    return out


def _write(path: Path, data: bytes, option: str) -> None:
    from gripmon.model.atomic import write_atomically

    try:
        write_atomically(path, data)
    except OSError as error:
        raise common.not_writable(path, error, option) from None


def _summary(config: Config, taught: Taught, out: Path) -> str:
    px_per_m = config.camera.fx_px / float(config.cam_T_grip[2, 3])
    width = max(map(len, [*taught.edges, *taught.untaught]))
    lines = [f"{'edge':<{width}}          offset                 +-         seen  brighter"]
    lines += [_edge_line(name, edge, px_per_m, width) for name, edge in taught.edges.items()]
    lines += [f"{name:<{width}}  not taught: {reason}" for name, reason in taught.untaught.items()]
    lines += [f"left out: {why}" for why in taught.left_out.values()]
    lines += [f"note: {note}" for note in taught.notes]
    lines.append(f"measured again with this, the gripper shows at most {taught.closure_px:.2f} px from the reference")
    lines.append(f"written: {out}")
    if config.taught_path is None or config.taught_path.resolve() != out.resolve():
        name = out.name if out.parent.resolve() == config.directory.resolve() else out.resolve()
        lines.append(f"next: put the line `taught: {name}` into {config.path} (--into-config does)")
    return "\n".join(lines)


def _edge_line(name: str, edge: TaughtEdge, px_per_m: float, width: int) -> str:
    offset_m = max(edge.offset_m, key=abs)
    sigma_m = math.hypot(*edge.sigma_m) / math.sqrt(2.0)
    place = f"{1e6 * offset_m:+8.1f} um ({px_per_m * offset_m:+6.2f} px)   {1e6 * sigma_m:6.1f} um"
    kind = "crease" if edge.crease else "outline"
    return f"{name:<{width}}  {place}  {100.0 * edge.seen:5.0f} %  {edge.brighter:<5} {kind}"
