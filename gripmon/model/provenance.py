"""Provenance of a written file: command, time, versions, and digests of the inputs."""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon import __version__

_BLOCK_BYTES = 1 << 20
_LIBRARIES = {"numpy": "numpy", "scipy": "scipy", "opencv": "opencv-contrib-python-headless"}

Digest = Annotated[str, Meta(pattern="^[0-9a-f]{64}$", description="SHA-256, 64 hexadecimal digits")]


class InputFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A file that a result was made from."""

    file: Annotated[str, Meta(description="its path, as it was given")]
    sha256: Digest


class Provenance(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a file was made."""

    gripmon: Annotated[str, Meta(description="version of gripmon that wrote it")]
    time: Annotated[str, Meta(description="when, UTC, ISO 8601")]
    command: Annotated[str, Meta(description="the command line, or what else wrote it")]
    versions: Annotated[dict[str, str], Meta(description="of the libraries that reckoned")] = {}
    inputs: tuple[InputFile, ...] = ()
    seed: Annotated[int | None, Meta(description="of what was drawn at random; null: nothing was")] = None


def provenance_of(command: str, inputs: Sequence[Path | InputFile] = (), seed: int | None = None) -> Provenance:
    """Provenance of a file that is written now.  OSError for an input that can't be read; one that has been read
    before is an :class:`InputFile`.
    """
    return Provenance(
        gripmon=__version__,
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        command=command,
        versions={name: importlib.metadata.version(package) for name, package in _LIBRARIES.items()},
        inputs=tuple(
            each if isinstance(each, InputFile) else InputFile(file=str(each), sha256=sha256_of(each))
            for each in inputs
        ),
        seed=seed,
    )


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes.  OSError if it can't be read."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()
