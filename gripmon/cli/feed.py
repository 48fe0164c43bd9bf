"""``gripmon feed``: images on the network, as a camera's driver would put them there."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common, joining
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.io.sources import Source

_DESCRIPTION = """\
Publish images over Zenoh in real time, as the driver of a wrist camera would, for a monitor whose
configuration says source: {kind: zenoh}.  For trying things out, and as an example of a driver:
docs/howto/network_camera.md says what is on the wire."""

_EXAMPLES = """\
  gripmon feed images/ --robot arm1
  gripmon feed wrist.mp4 --robot arm1 --format jpeg --loop
  gripmon feed /dev/video0 --robot arm1 --connect tcp/192.168.1.2:7447
  gripmon feed images/ --robot arm1 --zenoh-config mine/zenoh/robot.json5    docs/howto/security.md

exit codes: 0 the images are at their end; 2 wrong usage; 3 nothing could be sent; 130 interrupted"""


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "feed", run, "publish images over Zenoh, as a camera's driver does", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument(
        "source", metavar="SOURCE", help="a folder of images, a video file, or a camera (0, /dev/…, URL)"
    )
    parser.add_argument("--robot", required=True, metavar="NAME", help="the robot's name in the Zenoh keys")
    parser.add_argument("--camera", default="wrist", metavar="NAME", help="the camera's name there (default wrist)")
    parser.add_argument("--key", metavar="KEY", help="another key than gripmon/<robot>/<camera>/image")
    joining.add_options(parser, "the monitor's")
    parser.add_argument("--format", choices=("raw", "jpeg", "png"), default="raw", help="how (default raw)")
    parser.add_argument("--quality", type=_quality, default=90, metavar="Q", help="of JPEG, 1 to 100 (default 90)")
    parser.add_argument(
        "--fps", type=common.positive_number, metavar="HZ", help="frames a second; default: as the input's stamps say"
    )
    parser.add_argument("--loop", action="store_true", help="begin again at the end, until interrupted")
    parser.add_argument(
        "--recorded-stamps", action="store_true", help="send the input's time stamps instead of the time of sending"
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon feed``."""
    from gripmon.io.publish.feeding import Feeder
    from gripmon.io.wire import Keys, Link, PublishError, PublishSettings
    from gripmon.io.wire.session import check_key

    if wrong := joining.misuse(arguments):
        raise InputError(f"feed: {wrong}")
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.WARNING)
    sources = [_open(arguments)]  # before anything is sent: what can't be opened is said at once
    try:
        own = Keys(arguments.robot, arguments.camera)["image"]
        key = own if arguments.key is None else check_key(arguments.key)
        if arguments.zenoh_config:
            link = Link(PublishSettings(zenoh_config=arguments.zenoh_config))
        else:
            link = Link(PublishSettings(mode="client", connect=tuple(arguments.connect or (joining.DEFAULT_ENDPOINT,))))
    except ValueError as error:
        sources.pop().close()
        if isinstance(error, PublishError):
            raise joining.failure("feed", error) from None
        raise InputError(f"feed: {error}") from None
    feeder = Feeder(
        link, key, arguments.format, jpeg_quality=arguments.quality, recorded_stamps=arguments.recorded_stamps
    )
    try:
        feeder.run(lambda: sources.pop() if sources else _open(arguments), fps=arguments.fps, loop=arguments.loop)
    finally:
        for source in sources:
            source.close()
        link.close()
        unsent = f", {feeder.unsent} not ({feeder.reason})" if feeder.unsent else ""
        print(f"feed: {feeder.sent} frames sent on {key}{unsent}", file=sys.stderr)
    return common.EXIT_DONE if feeder.sent else common.EXIT_FAILED


def _open(arguments: argparse.Namespace) -> Source:
    from gripmon.io.sources import FolderSettings, LiveSettings, SourceError, VideoSettings, open_source

    name: str = arguments.source
    path = Path(name)
    settings: FolderSettings | LiveSettings | VideoSettings
    if path.is_dir():
        settings = FolderSettings(path=name, fps=arguments.fps or 25.0)
    elif path.is_file():
        settings = VideoSettings(path=name)
    elif not (name.isdecimal() or name.startswith("/dev/") or "://" in name or "!" in name):
        right = "a folder of images, a video file, or a camera (0, /dev/video0, a URL, a GStreamer pipeline)"
        raise InputError(f"feed: {name}: there is no such folder or file; {right}")
    else:
        settings = LiveSettings(device=int(name) if name.isdecimal() else name, fps=arguments.fps)
    try:
        return open_source(settings)
    except SourceError as error:
        raise InputError(f"feed: {name}: {error}") from None


def _quality(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 100:
        raise argparse.ArgumentTypeError(f"'{text}' is no quality; a whole number, 1 to 100")
    return int(text)
