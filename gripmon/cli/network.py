"""Network commands: ``gripmon feed``, ``router`` and ``schema``."""

from __future__ import annotations

import json
import logging
import sys
import time

from gripmon.cli.common import NETWORK_OPTIONS, REQUIRED, Arguments, Command, positive_number, whole_number
from gripmon.model.errors import InputError
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED, signals_exit

_MESSAGES = (
    "transform", "state", "alert", "reference", "clock", "jaw", "frame", "command", "reply", "error",
)  # fmt: skip

_FEED_OPTIONS = f"""
SOURCE             a folder of images, a video file, or a camera (0, /dev/…, URL)
--robot NAME       the robot's name in the Zenoh keys
--camera NAME      the camera's name there (default wrist)
--key KEY          key to use instead of gripmon/<robot>/<camera>/image
{NETWORK_OPTIONS.format("the monitor's").strip()}
--format           encoding of the images (default raw)
--quality Q        JPEG quality, 1 to 100 (default 90)
--fps HZ           frames per second; default: by the input's stamps
--loop             repeat the input until interrupted
--recorded-stamps  send the input's time stamps instead of the time of sending
"""

_FEED_EXAMPLES = """\
  gripmon feed images/ --robot arm1
  gripmon feed wrist.mp4 --robot arm1 --format jpeg --loop
  gripmon feed /dev/video0 --robot arm1 --connect tcp/192.168.1.2:7447
  gripmon feed images/ --robot arm1 --zenoh-config mine/zenoh/robot.json5    docs/howto/security.md

exit codes: 0 all images sent; 2 wrong usage; 3 nothing could be sent; 130 interrupted"""

_ROUTER_EXAMPLES = """\
  gripmon router configs/zenoh/router.json5            mutual TLS and access rules (docs/howto/security.md)
  gripmon router configs/zenoh/local.json5             without security, on this machine only

exit codes: 0 SIGTERM; 2 wrong usage or configuration; 130 Ctrl-C"""

_SCHEMA_EXAMPLES = """\
  gripmon schema --list
  gripmon schema transform > transform.schema.json
  gripmon schema                                      any message

exit codes: 0 done; 2 wrong usage"""

_LOOK_EVERY_S = 1.0


@Command(
    _FEED_OPTIONS, _FEED_EXAMPLES, robot=REQUIRED,
    camera={"default": "wrist"}, format={"choices": ("raw", "jpeg", "png"), "default": "raw"},
    quality={"type": whole_number(1, 100, "isn't a quality; a whole number, 1 to 100"), "default": 90},
    fps=positive_number,
)  # fmt: skip
def feed(arguments: Arguments) -> int:
    """Publish images over Zenoh in real time, like the driver of a wrist camera, for a monitor configured
    with source: {kind: zenoh}.  For trying things out, and as an example of a driver:
    docs/howto/network_camera.md describes the protocol.
    """
    from gripmon.io.publish.feeding import Feeder
    from gripmon.io.sources import SourceError, open_source, settings_for_text
    from gripmon.io.wire import Keys, Link, PublishSettings
    from gripmon.io.wire.session import check_key

    joined = arguments.network()
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.WARNING)
    try:
        settings = settings_for_text(arguments.source, arguments.fps)
        sources = [open_source(settings)]  # before anything is sent, to report at once what can't be opened
    except SourceError as error:
        raise InputError(f"feed: {arguments.source}: {error}") from None
    try:
        with arguments.network_errors():
            own = Keys(arguments.robot, arguments.camera)["image"]
            key = own if arguments.key is None else check_key(arguments.key)
            if (file := joined["zenoh_config_file"]) is not None:
                link = Link(PublishSettings(zenoh_config=file))
            else:
                link = Link(PublishSettings(mode="client", connect=tuple(joined["connect"])))
    except ValueError as error:
        sources.pop().close()
        raise error if isinstance(error, InputError) else InputError(f"feed: {error}") from None
    feeder = Feeder(
        link, key, arguments.format, jpeg_quality=arguments.quality, recorded_stamps=arguments.recorded_stamps
    )
    try:
        feeder.run(lambda: sources.pop() if sources else open_source(settings), fps=arguments.fps, loop=arguments.loop)
    finally:
        for source in sources:
            source.close()
        link.close()
        unsent = f", {feeder.unsent} not ({feeder.reason})" if feeder.unsent else ""
        print(f"feed: {feeder.sent} frames sent on {key}{unsent}", file=sys.stderr)
    return EXIT_DONE if feeder.sent else EXIT_FAILED


@Command(
    "FILE  Zenoh configuration (json5, yaml)",
    _ROUTER_EXAMPLES,
)  # fmt: skip
def router(arguments: Arguments) -> None:
    """Route between monitors, controllers and operators until interrupted (Ctrl-C or SIGTERM).

    FILE is a Zenoh configuration (json5 or yaml), the same as for zenohd, Zenoh's own router. Its paths of
    certificates are relative to its folder. A router that connects to another one retries forever, and
    reports it.
    """
    from gripmon.io.wire import Router, ZenohFileError

    with signals_exit():
        try:
            opened = Router(arguments.file)
        except ZenohFileError as error:
            raise InputError(f"router: {error}") from None
        with opened:
            try:
                _say(f"listening on {', '.join(opened.listens_on)}")
                known = ""
                while True:
                    time.sleep(_LOOK_EVERY_S)
                    if (fault := opened.fault()) != known:
                        _say(fault or "connected")
                        known = fault
            finally:
                _say("stopped")


def _say(text: str) -> None:
    print(f"router: {text}", file=sys.stderr, flush=True)


_SCHEMA_OPTIONS = f"""
[MESSAGE]  {", ".join(_MESSAGES)}
--list     print name, schema and content of every message
"""


@Command(
    _SCHEMA_OPTIONS, _SCHEMA_EXAMPLES,
    message={"choices": _MESSAGES},
)  # fmt: skip
def schema(arguments: Arguments) -> None:
    """Print the JSON Schema (draft 2020-12) of one message, or of all messages: fields with units and frames,
    and when they are null.

    Every message names its schema with the major version: "schema": "gripmon.transform/2".  Within a major
    version fields and names may be added, and nothing else changes.
    """
    from gripmon.model.records import MESSAGES, json_schema, schema_name, summary

    if arguments.list and arguments.message:
        raise InputError(f"schema: --list lists all messages, but {arguments.message} is given; one of them")
    names = tuple(MESSAGES) if arguments.message is None else (arguments.message,)
    if arguments.list:
        for name in names:
            print(f"{name:10} {schema_name(MESSAGES[name]):20} {summary(name)}")
    else:
        print(json.dumps(json_schema(names), indent=2, ensure_ascii=False))
