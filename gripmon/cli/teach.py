"""``gripmon teach``: how the gripper's edges look, from images at the reference or from corners placed by hand."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli.common import (
    PAGE_PORT,
    PORT_OPTIONS,
    RESPONSE,
    RESPONSE_OPTION,
    Arguments,
    Command,
    announcer,
    length,
    make_directory,
    positive_number,
)
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.images import image_paths

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.teach.kept import Kept
    from gripmon.teach.measure import Taught
    from gripmon.teach.messages import Saved
    from gripmon.teach.page_server import Site
    from gripmon.track.edges.taught import TaughtEdge

_OPTIONS = f"""
[IMAGE...]          image file at the reference calibration, or a folder of them
--config CONFIG     configuration (YAML); its source section is not used
--out FILE          file to write (default: the configuration's `taught`, else taught.yaml beside it); with --page or
                    --corners the folder to write to (default: the configuration's, else this one)
--jaw-opening M     jaw opening in all images (m); default: with jaw.source fixed jaw.opening_m, or the gripper's
                    nominal opening if that is absent, else from a timestamps.csv beside each image
--picture FILE.png  also draw the first image with the taught edges, offsets enlarged
{RESPONSE_OPTION.strip()}
--force             replace an existing file
--into-config       also add the line `taught:` to the configuration
"""

_BY_HAND = f"""
--page              teach on a local web page
--corners FILE      without a page: rough corners in the first image, `corners: {{name: [u, v], …}}`; three or more
--distance M:SIGMA  without --reference: rough distance of the fingertips along the camera's axis, with its standard
                    deviation (m)
--live DEVICE       with --page: a camera instead of images, as in source.device
--live-wait S       give up if the camera has sent no image for this long (s); default: never, the page reports the
                    fault
--camera FILE       without --config: the camera's calibration
--gripper FILE      without --config: the gripper file
--reference FILE    without --config: hand/eye calibration, if there is one
--jaw-source        in the configuration written: source of the jaw openings; zenoh: the robot reports them (default:
                    frames if a timestamps.csv has them, else fixed)
--source SOURCE     in the configuration written: source of the frames, a folder, a video, a device,
                    zenoh:WIDTHxHEIGHT[:KEY] or ros2:WIDTHxHEIGHT:TOPIC (default: the images' folder)
--robot NAME        the robot's name in the configuration written
--camera-name NAME  the camera's name in it
{PORT_OPTIONS.strip()}
"""

_EXAMPLES = """\
  gripmon teach first/*.png --config mine/arm1.yaml
  gripmon teach now.png --config mine/arm1.yaml --jaw-opening 0.034 --picture taught.png
  gripmon check mine/arm1.yaml

a gripper without a file: rough.yaml for gripmon calibrate plane --infer
  gripmon teach --page on_plate.png --camera camera.yaml

a new robot, without any configuration: drag corners onto the fingertips, on a page in your browser
  gripmon teach --page first/*.png --camera camera.yaml --gripper gripper.yaml --out mine
  gripmon teach --page --live 0 --camera camera.yaml --gripper gripper.yaml --reference hand_eye.yaml
  gripmon teach first.png --corners rough.yaml --camera camera.yaml --gripper gripper.yaml --out mine

exit codes: 0 written; 2 wrong usage, configuration or image files; 3 no model from these images, with
the reason: nothing is written then"""

_NEED_CORNERS = (
    "camera", "gripper", "reference", "robot", "camera_name", "live_wait", "jaw_source", "source", "distance",
)  # fmt: skip
_NEED_A_GRIPPER = ("config", "gripper", "reference", "live", "robot", "camera_name", "jaw_opening", "jaw_source")


def _key(text: str) -> str:
    """A name that is valid in a Zenoh key."""
    if not text or re.fullmatch(r"[^/*$#?@\s][^/*$#?\s]*", text) is None:
        raise argparse.ArgumentTypeError(f"'{text}' isn't a name; no blank, none of / * $ # ?, no @ in front")
    return text


@Command(
    _OPTIONS, _EXAMPLES,
    {"corners by hand": (None, _BY_HAND)}, jaw_opening=positive_number, live_wait=positive_number, robot=_key,
    camera_name=_key, jaw_source={"choices": ("fixed", "frames", "zenoh")}, port=PAGE_PORT, response=RESPONSE,
    distance=length,
)  # fmt: skip
def teach(arguments: Arguments) -> None:
    """Measure where each edge of the gripper really appears, in images taken at the reference calibration,
    and write it as a taught model.  With this model in the configuration (`taught: taught.yaml`), the bias
    of bevels, rounded edges, shading and blur cancels.  The reference is by definition the gripper's pose
    in these images.

    With --page you drag rough corners onto the fingertips, on a web page that only this machine can open,
    see the edges snap and the expected accuracy, and save the taught model with a configuration for
    gripmon check and gripmon run; this needs no configuration, only the camera's calibration and the
    gripper file.  Without --reference the pose comes from the corners, less accurately than from a plate
    (gripmon calibrate plane).  --corners does the same without a page.  With neither --gripper nor
    --config the page writes rough.yaml, for gripmon calibrate plane --infer.

    Best are three to ten images without any motion of the camera, in focus, the fingers free and lit as
    in use, each before another background, some with another jaw opening.
    """
    if arguments.page or arguments.corners is not None or arguments.live is not None:
        _teach_by_hand(arguments)
        return
    if not arguments.image:
        raise InputError("teach: no image; image files, or --page --live DEVICE")
    if arguments.config is None:
        right = "a configuration, or --page or --corners with --camera and --gripper"
        raise InputError(f"teach: --config is missing; {right}")
    arguments.refuse(_NEED_CORNERS, "goes with --page or --corners")
    from gripmon.daemon.config import load_config
    from gripmon.daemon.config.writing import name_taught
    from gripmon.teach.api import teach

    config, command = load_config(arguments.config, check_source=False, with_taught=False), arguments.command_line()
    out = arguments.out = arguments.out or config.taught_path or config.directory / "taught.yaml"
    if arguments.into_config and config.taught_path is not None and config.taught_path.resolve() != out.resolve():
        wrong = f"{config.path} names {config.taught_path} already; without it, or without --out"
        raise InputError(f"--into-config: {wrong}")
    arguments.check_outputs("out", "picture")
    given = {"jaw_opening_m": arguments.jaw_opening, "response": arguments.response}
    taught = teach(config, arguments.image, **given, command=command)
    arguments.save("out", taught.text().encode())
    if arguments.into_config:
        config = name_taught(config, out)
    before, after = taught.kept()
    larger = before.median_excess < after.median_excess
    lines = [*_summary(config, taught.taught), *taught.response.notes, *_kept_lines(before, after, larger=larger)]
    print("\n".join([*lines, *written(config, out, larger=larger)]))
    arguments.save("picture", lambda: taught.picture(arguments.picture.suffix))


def _summary(config: Config, taught: Taught) -> list[str]:
    px_per_m = config.camera.fx_px / float(config.cam_T_grip[2, 3])
    width = max(map(len, [*taught.edges, *taught.untaught]))
    lines = [f"{'edge':<{width}}          offset                 +-         seen  brighter"]
    lines += [_edge_line(name, edge, px_per_m, width) for name, edge in taught.edges.items()]
    lines += [f"{name:<{width}}  not taught: {reason}" for name, reason in taught.untaught.items()]
    lines += [f"left out: {why}" for why in taught.left_out.values()]
    lines += [f"note: {note}" for note in taught.notes]
    lines.append(f"measured again with this, the gripper is at most {taught.closure_px:.2f} px from the reference")
    return lines


def _kept_lines(before: Kept, after: Kept, *, larger: bool) -> list[str]:
    """What frames like the images keep, without what was taught and with it, and what makes the bounds as large;
    ``larger``: than without it.
    """
    lines = [f"the monitor over these images: {before.text()}", f"     with what was taught: {after.text()}"]
    lines += [f"     {text}" for text in (after.why(), after.help()) if text]
    if larger:
        absolute = "it includes the reference's error now, and " if after.valid_by.value == "absolute" else ""
        lines.append(
            f"note: the bound is larger with what was taught ({absolute}an edge that moves with its background counts "
            "less)"
        )
    return lines


def written(config: Config, out: Path, *, larger: bool) -> list[str]:
    """What was written, and what to do with it; ``larger``: the bound is with it."""
    only = ", only if the edges lie elsewhere than the gripper file has them" if larger else ""
    if config.taught_path is not None and config.taught_path.resolve() == out.resolve():
        named = f"next{only}: leave `taught:` in {config.path}; otherwise take the line out again"
        return [f"written: {out}", *([named] if larger else [])]
    name = out.name if out.parent.resolve() == config.directory.resolve() else out.resolve()
    how = f"add the line `taught: {name}` to {config.path} (or use --into-config --force)"
    return [f"written: {out}", f"next{only}: {how}"]


def _edge_line(name: str, edge: TaughtEdge, px_per_m: float, width: int) -> str:
    offset_m = max(edge.offset_m, key=abs)
    sigma_m = math.hypot(*edge.sigma_m) / math.sqrt(2.0)
    place = f"{1e6 * offset_m:+8.1f} um ({px_per_m * offset_m:+6.2f} px)   {1e6 * sigma_m:6.1f} um"
    kind = "crease" if edge.crease else "outline"
    return f"{name:<{width}}  {place}  {100.0 * edge.seen:5.0f} %  {edge.brighter:<5} {kind}"


def _teach_by_hand(arguments: Arguments) -> None:
    """Run ``gripmon teach --page`` and ``--corners``."""
    arguments.image = image_paths(arguments.image)
    if wrong := _misuse(arguments):
        raise InputError(f"teach: {wrong}")
    from gripmon.daemon.teaching import in_words, outline_page, page_session, read_inputs, teach_from_file
    from gripmon.teach.sites import TeachSite

    images = arguments.image
    if arguments.page and all(getattr(arguments, name) is None for name in _NEED_A_GRIPPER):
        if len(images) > 1:
            right = "one image, to mark rough corners in, or --gripper FILE"
            raise InputError(f"teach: {len(images)} images, and no gripper; {right}")
        folder = arguments.out or Path()
        page = outline_page(images[0], arguments.camera, folder)
        make_directory(folder)
        try:
            _serve(arguments, page)
        finally:
            if page.saved is not None:
                _say(page.saved)
        return
    files = {name: getattr(arguments, name) for name in ("out", "config", "camera", "gripper", "reference")}
    inputs = read_inputs(
        images, command=arguments.command_line(), **files, live=arguments.live, source=arguments.source,
        jaw_opening_m=arguments.jaw_opening, jaw_source=arguments.jaw_source,
        robot=arguments.robot, camera_name=arguments.camera_name, response=arguments.response,
        distance_m=arguments.distance,
    )  # fmt: skip
    make_directory(inputs.folder)
    arguments.check_outputs("picture")
    if arguments.page:
        session = page_session(inputs)

        def look() -> None:
            dark_s, why = session.dark()
            if arguments.live_wait is not None and dark_s > arguments.live_wait:
                raise NoResultError(f"--live: {why.partition(';')[0]}; given up after {arguments.live_wait:g} s")

        try:
            _serve(arguments, TeachSite(session), look)
        finally:
            session.close()
        return
    found, save = teach_from_file(inputs, arguments.corners)
    print("\n".join(in_words(found)))
    saved, picture = save(arguments.force)
    if saved.exists:
        raise InputError(f"--out {', '.join(saved.exists)}: there already; another folder, or --force to replace")
    _say(saved)
    if picture is not None:
        arguments.save("picture", lambda: picture(arguments.picture.suffix))


def _misuse(arguments: Arguments) -> str:
    """Options that exclude each other, and what would be right; empty if none."""
    images, page, config, live = arguments.image, arguments.page, arguments.config, arguments.live
    if page and arguments.corners is not None:
        return "--page and --corners exclude each other; one of them"
    if arguments.source is not None and (live is not None or config is not None):
        return "--source: --live or --config gives the source of frames; leave it out"
    if live is not None and (images or not page):
        return "--live goes with --page, without images; image files otherwise"
    if arguments.live_wait is not None and live is None:
        return "--live-wait: goes with --live"
    if not images and live is None:
        return "no image; image files, or --page --live DEVICE"
    if arguments.into_config:
        return "--into-config: --page and --corners add the line anyway; leave it out"
    if arguments.picture is not None and page:
        return "--picture: the page shows it; leave it out"
    if config is not None and arguments.jaw_source is not None:
        return "--jaw-source: --config gives the source of jaw openings; leave it out"
    if config is not None and any((arguments.camera, arguments.gripper, arguments.reference)):
        return "--config names camera, gripper and reference already; either it, or --camera and --gripper"
    if arguments.distance is not None and (config is not None or arguments.reference is not None):
        return "--distance: the reference says where the gripper is; leave one of them out"
    return ""


def _say(saved: Saved) -> None:
    lines = [f"note: {note}" for note in saved.notes]
    lines += [f"written: {path} ({what})" for path, what in saved.written.items()]
    lines += [] if saved.next is None else [f"next: {saved.next}"]
    print("\n".join(lines), flush=True)


def _serve(arguments: Arguments, site: Site, look: Callable[[], object] = lambda: None) -> None:
    """Serve the page until the person is done."""
    from gripmon.teach.page_server import serve

    serve(site, arguments.port, announcer("teach"), open_browser=not arguments.no_browser, look=look)
