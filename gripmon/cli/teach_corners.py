"""``gripmon teach`` from corners that a person puts on the fingertips: on a page (``--page``), or in a file
(``--corners``)."""

from __future__ import annotations

import argparse
import math
import os
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli import common
from gripmon.model.errors import InputError, NoResultError

if TYPE_CHECKING:
    from gripmon.daemon.teaching import Inputs
    from gripmon.teach.messages import Saved
    from gripmon.teach.page_server import OutlineSession
    from gripmon.teach.session import Evaluation, TeachSession

_LOOK_S = 0.2
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_NEED_A_GRIPPER = ("config", "gripper", "reference", "live", "robot", "camera_name", "jaw_opening", "jaw_source")


def run(arguments: argparse.Namespace, command: str) -> int:
    """Handle ``gripmon teach --page`` and ``--corners``; ``command`` goes into the files that are written."""
    _check_options(arguments)
    from gripmon.daemon.teaching import Named, outline_session, read_inputs

    images = [Path(name) for name in arguments.images]
    paths = {
        name: None if getattr(arguments, name) is None else Path(getattr(arguments, name))
        for name in ("out", "config", "camera", "gripper", "reference")
    }
    if arguments.page and all(getattr(arguments, name) is None for name in _NEED_A_GRIPPER):
        if len(images) > 1:
            text = f"teach: {len(images)} images, and no gripper; one image, to put rough corners in, or --gripper FILE"
            raise InputError(text)
        folder = paths["out"] or Path()
        session = outline_session(images[0], paths["camera"], folder)
        common.make_directory(folder)
        return _rough_page(arguments, session)
    inputs = read_inputs(
        Named(
            command, images, **paths, live=arguments.live, jaw_opening_m=arguments.jaw_opening,
            jaw_source=arguments.jaw_source, robot=arguments.robot, camera_name=arguments.camera_name,
        )
    )  # fmt: skip
    common.make_directory(inputs.folder)
    return _page(arguments, inputs) if arguments.page else _without_page(arguments, inputs)


def _check_options(arguments: argparse.Namespace) -> None:
    """Options that contradict each other end the command with exit code 2."""

    def refuse(text: str) -> None:
        raise InputError(f"teach: {text}")

    if arguments.page and arguments.corners is not None:
        refuse("--page and --corners are two ways of the same; one of them")
    if arguments.live is not None and (arguments.images or not arguments.page):
        refuse("--live goes with --page, without images; image files otherwise")
    if arguments.live_wait is not None and arguments.live is None:
        refuse("--live-wait: goes with --live")
    if not arguments.images and arguments.live is None:
        refuse("no image; image files, or --page --live DEVICE")
    if arguments.corners is not None and len(arguments.images) > 1:
        refuse(f"{len(arguments.images)} images; with --corners one, the image that they were put in")
    if arguments.into_config:
        refuse("--into-config: with --page and --corners the configuration gets its line anyway; leave it out")
    if arguments.picture is not None:
        refuse("--picture goes with --config alone; look at the page")
    if arguments.config is not None and arguments.jaw_source is not None:
        refuse("--jaw-source: --config says where jaw openings come from; leave it out")
    if arguments.config is not None and any((arguments.camera, arguments.gripper, arguments.reference)):
        refuse("--config has camera, gripper and reference already; either that, or --camera and --gripper")


def _rough_page(arguments: argparse.Namespace, session: OutlineSession) -> int:
    """Serve, then say what was saved, however the page ended."""
    try:
        return _serve(arguments, session)
    finally:
        if session.saved is not None:
            _say(session.saved)


def _say(saved: Saved) -> None:
    for note in saved.notes:
        print(f"note: {note}")
    for path, what in saved.written.items():
        print(f"written: {path} ({what})")
    if saved.next is not None:
        print(f"next: {saved.next}")
    sys.stdout.flush()


def _page(arguments: argparse.Namespace, inputs: Inputs) -> int:
    """Teach with a gripper."""
    from gripmon.daemon.teaching import FileSaving, live_settings
    from gripmon.io.sources import SourceError, open_source
    from gripmon.teach.session import TeachSession

    live = None
    if arguments.live is not None:
        try:
            live = open_source(live_settings(arguments.live, inputs.setup.camera))
        except SourceError as error:
            raise InputError(f"--live: {error}") from None
    saving = FileSaving(inputs)
    return _serve(arguments, TeachSession(inputs.setup, inputs.pictures, saving.labels(), saving, live))


def _serve(arguments: argparse.Namespace, session: TeachSession | OutlineSession) -> int:
    """Until the person is done."""
    from gripmon.teach.page_server import PageServer

    try:
        server = PageServer(session, arguments.port)
    except OSError as error:
        session.close()
        raise InputError(
            f"--port {arguments.port}: can't be listened on ({error.strerror}); another one, or none"
        ) from None
    try:
        print(f"teach on this page: {server.url}", flush=True)
        print("its address is the key to it: keep it to yourself; Ctrl-C, or Done on the page, ends it", flush=True)
        if not arguments.no_browser and _has_display():
            webbrowser.open(server.url)
        while not server.done.wait(_LOOK_S):  # an interrupt that another thread has caught is heard of here
            dark_s, why = session.dark()
            if arguments.live_wait is not None and dark_s > arguments.live_wait:
                raise NoResultError(f"--live: {why.partition(';')[0]}; given up after {arguments.live_wait:g} s")
    finally:
        server.close()
        session.close()
    return common.EXIT_DONE


def _has_display() -> bool:
    return sys.platform in ("darwin", "win32") or any(os.environ.get(name) for name in _DISPLAYS)


def _without_page(arguments: argparse.Namespace, inputs: Inputs) -> int:
    """Once, with the corners in a file."""
    import numpy as np

    from gripmon.daemon.teaching import FileSaving, read_rough
    from gripmon.teach.messages import Put, SaveOrder, SavingRefused
    from gripmon.teach.snapping import FEWEST_PUT

    rough = read_rough(Path(arguments.corners), inputs.setup.gripper)
    if inputs.setup.reference is None and len(rough) < FEWEST_PUT:
        raise InputError(
            f"{arguments.corners}: {len(rough)} of the gripper's corners; at least {FEWEST_PUT}, hidden ones too, "
            "about where they would show; or --reference FILE (of gripmon calibrate plane)"
        )
    picture = inputs.pictures[0]
    corners = {name: np.array(at) for name, at in rough.items()}
    found = inputs.setup.evaluate(picture.image, corners, (), picture.jaw_opening_m)
    if found.snapped.refused is not None:
        raise NoResultError(f"{picture.name}: {found.snapped.refused}")
    print("\n".join(_table(found)))
    put = Put(corners=rough, image=0, jaw_opening_m=picture.jaw_opening_m)
    order = SaveOrder(put=put, robot=inputs.robot, camera_name=inputs.camera_name, replace=arguments.force)
    try:
        saved = FileSaving(inputs).save(order, found, 0, inputs.pictures)
    except SavingRefused as refused:
        raise NoResultError(f"teach: {refused}") from None
    if saved.exists:
        raise InputError(f"--out {', '.join(saved.exists)}: there already; another folder, or --force to replace")
    _say(saved)
    return common.EXIT_DONE


def _table(found: Evaluation) -> list[str]:
    """What was seen, for a person."""
    snapped = found.snapped
    width = max(len(corner.name) for corner in snapped.corners)
    lines = [f"{'corner':<{width}}  measured at (px)      +- px  edges agree"]
    for corner in snapped.corners:
        agree = "" if corner.inliers is None else f"{100.0 * corner.inliers:4.0f} %"
        if corner.uv_px is None or corner.sigma_px is None:
            lines.append(f"{corner.name:<{width}}  not measured: {corner.reason}")
            continue
        u, v = corner.uv_px.tolist()
        lines.append(f"{corner.name:<{width}}  ({u:7.2f}, {v:7.2f})  {corner.sigma_px:7.3f}  {agree}")
    if found.reference is not None and found.pose is not None:
        sigma_mm = [1e3 * found.reference.covariance[k] ** 0.5 for k in (0, 7, 14)]
        told = f"{len(found.pose.corners)} corners" if found.pose.corners else "the edges"
        lines.append(
            f"reference by {told}, TCP to {sigma_mm[0]:.3f}, {sigma_mm[1]:.3f}, {sigma_mm[2]:.3f} mm: less exact than "
            "with a plate (gripmon calibrate plane)"
        )
        if found.pose.rival:
            lines.append(
                "note: another pose explains these corners as well; a corner outside of their plane would tell"
            )
    expected = found.expected
    if expected is not None:
        lines.append(f"expected of a frame   {_axes(expected.sigma)}")
        lines.append(f"smallest drift seen   {_axes(expected.smallest)}")
        lines.append(f"promise               {expected.promise}")
    return lines


def _axes(values: object) -> str:
    import numpy as np

    x, y, z, a, b, c = np.asarray(values, dtype=float).tolist()
    turns = ", ".join(f"{math.degrees(v):.3f}" for v in (a, b, c))
    return f"TCP x {1e3 * x:.3f}, y {1e3 * y:.3f}, z {1e3 * z:.3f} mm, turns {turns}°"
