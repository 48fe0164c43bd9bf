"""Files in and out, as all methods of ``gripmon calibrate`` handle them."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common

if TYPE_CHECKING:
    import msgspec

    from gripmon.model.records import Image
    from gripmon.model.targets import Target


def image_paths(texts: Sequence[str]) -> list[Path]:
    """The images that are meant, folders for all images in them, in natural order; what isn't there, or is there
    twice, ends the command with exit code 2.
    """
    from gripmon.io.sources.folder import IMAGE_SUFFIXES, natural_key

    paths: list[Path] = []
    for path in map(Path, texts):
        if not path.is_dir():
            paths.append(path)
            continue
        inside = sorted(
            (p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()),
            key=lambda p: natural_key(p.name),
        )
        if not inside:
            raise common.CommandFailedError(f"{path}: no image in this folder; e.g. *.png, *.jpg", common.EXIT_USAGE)
        paths += inside
    return paths


def images_of(paths: Sequence[Path]) -> Iterator[tuple[Path, Image]]:
    """Each with its path, all of one size; one that can't be read, or is the same as another, ends the command with
    exit code 2.
    """
    from gripmon.io.sources.folder import read_image

    seen: dict[bytes, Path] = {}
    size: tuple[int, ...] | None = None
    for path in paths:
        if path.is_dir():
            raise common.CommandFailedError(f"{path}: is a folder; an image file", common.EXIT_USAGE)
        image, fault = read_image(path)
        if image is None:
            what = "an image file" + ("" if path.exists() else ", or a folder of them")
            raise common.CommandFailedError(f"{path}: {fault}; {what}", common.EXIT_USAGE)
        # The same image twice would make every uncertainty too small.
        first = seen.setdefault(hashlib.sha256(image.tobytes()).digest(), path)
        if first is not path:
            raise common.CommandFailedError(f"{path}: is the same image as {first}; each image once", common.EXIT_USAGE)
        if size is not None and image.shape[:2] != size:
            raise common.CommandFailedError(
                f"{path}: has {image.shape[1]} x {image.shape[0]} px and {paths[0]} {size[1]} x {size[0]} px; images "
                "of one camera, in one size",
                common.EXIT_USAGE,
            )
        size = image.shape[:2]
        yield path, image


def read_images(paths: Sequence[Path]) -> list[Image]:
    """All of them at once, as :func:`images_of`."""
    return [image for _, image in images_of(paths)]


def target_of(text: str, option: str = "--target") -> Target:
    """The target of a command line, or in the file that it names; a fault ends the command with exit code 2."""
    from gripmon.model.targets import parse_target

    if is_target_file(text):
        return _target_in(Path(text), option)
    try:
        return parse_target(text)
    except ValueError as error:
        raise common.CommandFailedError(f"{option}: {error}", common.EXIT_USAGE) from None


def is_target_file(text: str) -> bool:
    """Whether this names a file instead of describing a target."""
    return text.lower().endswith((".yaml", ".yml"))


def _target_in(path: Path, option: str) -> Target:
    """Of a calibration that was made with it, or described by itself."""
    from gripmon.daemon.config import ConfigError
    from gripmon.daemon.config.yaml_file import read_yaml
    from gripmon.model.targets import checked

    right = "a file of gripmon calibrate intrinsics or plane, or one with the line target: circles:8x8:0.008:0.004"
    try:
        values = read_yaml(path)
    except ConfigError as error:
        raise common.CommandFailedError(f"{option} {error}", common.EXIT_USAGE) from None
    text = values.get("target")
    if text is None:
        text = _target_of_command(values.get("provenance"))
    described = values if text is None and "kind" in values else text
    try:
        if isinstance(described, dict):
            return checked(described, str(path), right)
    except ValueError as error:
        raise common.CommandFailedError(f"{option}: {error}", common.EXIT_USAGE) from None
    if not isinstance(text, str) or is_target_file(text):
        raise common.CommandFailedError(f"{option} {path}: names no target; {right}", common.EXIT_USAGE)
    return target_of(text, f"{option} {path}")


def _target_of_command(provenance: object) -> str | None:
    """What a file's provenance gives after ``--target``."""
    command = provenance.get("command") if isinstance(provenance, dict) else None
    try:
        words = shlex.split(command) if isinstance(command, str) else []
    except ValueError:
        return None
    return words[words.index("--target") + 1] if "--target" in words[:-1] else None


def check_output(path: Path, *, force: bool, option: str = "--out") -> None:
    """End the command with exit code 2, before any work, if a file can't be written or is there already."""
    common.make_directory(path.parent, option)
    if path.is_dir():
        raise common.CommandFailedError(f"{option} {path}: is a folder; a file", common.EXIT_USAGE)
    if path.exists() and not force:
        raise common.CommandFailedError(
            f"{option} {path}: is there already; another file, or --force to replace it", common.EXIT_USAGE
        )


def check_picture(path: Path, *, force: bool, option: str = "--picture") -> None:
    """As :func:`check_output`, for a picture."""
    check_output(path, force=force, option=option)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise common.CommandFailedError(f"{option} {path}: has no known ending; .png or .jpg", common.EXIT_USAGE)


def write_document(document: msgspec.Struct, path: Path, option: str = "--out") -> None:
    """Write it as YAML, whole or not at all."""
    import msgspec

    from gripmon.daemon.config.yaml_file import as_yaml

    _write(path, as_yaml(msgspec.to_builtins(document)).encode(), option)


def write_picture(picture: Image, path: Path, option: str = "--picture") -> None:
    """Write it, whole or not at all, in the format that the file's name ends in."""
    import cv2

    _, data = cv2.imencode(path.suffix, picture)
    _write(path, data.tobytes(), option)


def write_bytes(data: bytes, path: Path, option: str = "--out") -> None:
    """Write them, whole or not at all."""
    _write(path, data, option)


def command_line(method: str, positional: Sequence[str], options: dict[str, Any]) -> str:
    """What a file's provenance calls the command; options that are None or False were not given."""
    words = ["gripmon", "calibrate", method, *positional]
    for option, value in options.items():
        if value is True:
            words.append(option)
        elif isinstance(value, list):
            words += [word for one in value for word in (option, str(one))]
        elif value is not None and value is not False:
            words += [option, str(value)]
    return shlex.join(words)


def _write(path: Path, data: bytes, option: str) -> None:
    from gripmon.model.atomic import write_atomically

    try:
        write_atomically(path, data)
    except OSError as error:
        raise common.not_writable(path, error, option) from None
