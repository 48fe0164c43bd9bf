"""``gripmon feed``: images on the network, as a camera's driver would put them there."""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common, joining

if TYPE_CHECKING:
    from gripmon.io.publish.frames import FramePublisher
    from gripmon.io.sources import Source
    from gripmon.io.wire import Link
    from gripmon.model.records import Frame

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

_LOOK_AGAIN_S = 0.05
_LAST_WORD_S = 0.2


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
    from gripmon.io.wire import Keys, Link, PublishError, PublishSettings
    from gripmon.io.wire.settings import check_key

    if wrong := joining.misuse(arguments):
        raise common.CommandFailedError(f"feed: {wrong}", common.EXIT_USAGE)
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.WARNING)
    source = _open(arguments)
    try:
        own = Keys(arguments.robot, arguments.camera)["image"]
        key = own if arguments.key is None else check_key(arguments.key)
        if arguments.zenoh_config:
            link = Link(PublishSettings(zenoh_config=arguments.zenoh_config))
        else:
            link = Link(PublishSettings(mode="client", connect=tuple(arguments.connect or (joining.DEFAULT_ENDPOINT,))))
    except PublishError as error:
        source.close()
        raise joining.failure("feed", error) from None
    except ValueError as error:
        source.close()
        raise common.CommandFailedError(f"feed: {error}", common.EXIT_USAGE) from None
    feeder = _Feeder(arguments, link, key)
    try:
        feeder.wait()
        for frame, due_s in _paced(arguments, source):
            feeder.send(frame, due_s)
        time.sleep(_LAST_WORD_S)  # what was put last is still on its way
    finally:
        source.close()
        link.close()
        print(f"feed: {feeder.sent} frames sent on {key}{feeder.trouble()}", file=sys.stderr)
    return common.EXIT_DONE if feeder.sent else common.EXIT_FAILED


class _Feeder:
    """Sends frames when they are due."""

    def __init__(self, arguments: argparse.Namespace, link: Link, key: str) -> None:
        from gripmon.io.publish.frames import FramePublisher

        self.sent = self._unsent = 0
        self._reason = ""
        self._recorded_stamps: bool = arguments.recorded_stamps
        self._publisher: FramePublisher | None = None

        def declare(session: Any) -> None:
            self._publisher = FramePublisher(session, key, arguments.format, jpeg_quality=arguments.quality)

        self._link = link
        link.attach(declare)

    def wait(self) -> None:
        """Until there is a monitor or a router: nothing is lost while it starts."""
        while self._link.fault():
            time.sleep(_LOOK_AGAIN_S)

    def send(self, frame: Frame, due_s: float) -> None:
        time.sleep(max(due_s - time.monotonic(), 0.0))
        assert self._publisher is not None
        if frame.image is None:
            self._unsent, self._reason = self._unsent + 1, f"{frame.name}: {frame.fault}"
            return
        stamp_ns = frame.stamp_ns if self._recorded_stamps else time.time_ns()
        try:
            self._publisher.put(frame.image, stamp_ns=stamp_ns, jaw_opening_m=frame.jaw_opening_m)
        except ValueError as error:
            self._unsent, self._reason = self._unsent + 1, f"{frame.name}: {error}"
            return
        self.sent += 1

    def trouble(self) -> str:
        return f", {self._unsent} not ({self._reason})" if self._unsent else ""


def _paced(arguments: argparse.Namespace, source: Source) -> Iterator[tuple[Frame, float]]:
    """Frames, and when each is due (monotonic s): by the input's stamps, or at ``--fps``; a camera's at once."""
    from gripmon.model.records import Frame

    start_s, passed_s = time.monotonic(), 0.0
    while True:
        first_ns, count = None, 0
        while (item := source.read()) is not None:
            if not isinstance(item, Frame):
                continue
            first_ns = item.stamp_ns if first_ns is None else first_ns
            since_s = 1e-9 * (item.stamp_ns - first_ns) if arguments.fps is None else count / arguments.fps
            yield item, start_s if source.live else start_s + passed_s + since_s
            count += 1
        source.close()
        if not arguments.loop or source.live or count == 0:
            return
        # The last frame lasts as long as the others do.
        passed_s += since_s * count / max(count - 1, 1) if count > 1 else 1.0 / (arguments.fps or 25.0)
        source = _open(arguments)


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
        raise common.CommandFailedError(f"feed: {name}: there is no such folder or file; {right}", common.EXIT_USAGE)
    else:
        settings = LiveSettings(device=int(name) if name.isdecimal() else name, fps=arguments.fps)
    try:
        return open_source(settings)
    except SourceError as error:
        raise common.CommandFailedError(f"feed: {name}: {error}", common.EXIT_USAGE) from None


def _quality(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 100:
        raise argparse.ArgumentTypeError(f"'{text}' is no quality; a whole number, 1 to 100")
    return int(text)
