"""A configuration file of Zenoh's, with gripmon's cautious defaults for what it doesn't say."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from gripmon.io.wire.zenoh_errors import in_short
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    import zenoh

_TLS = "transport/link/tls"
_TLS_FILES = (
    "root_ca_certificate",
    "listen_private_key",
    "listen_certificate",
    "connect_private_key",
    "connect_certificate",
)
_SECRETS = ("listen_private_key", "connect_private_key")


class ZenohFileError(InputError):
    """The file can't be used; the text is one line, ``file: key: what is wrong; what would be right``."""


def load_file(path: Path, default_mode: str = "peer") -> zenoh.Config:
    """The configuration in a json5 or yaml file.

    The files that it names for TLS count from its folder.  Where it is silent, Zenoh would listen on all interfaces and
    look for others by multicast; with gripmon it doesn't.  Raises :class:`ZenohFileError`.
    """
    import zenoh

    if not path.is_file():
        raise ZenohFileError(f"no file {path}; give a json5 or yaml file of Zenoh's")
    try:
        config = zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        if _is_gripmons(path):
            right = "one of Zenoh's, as those in configs/zenoh are"
            raise ZenohFileError(f"{path}: this is gripmon's configuration, not Zenoh's; {right}") from error
        raise ZenohFileError(f"{path}: {in_short(error)}") from error
    if said(config, "mode") is None:
        config.insert_json5("mode", _json(default_mode))
    if said(config, "listen/endpoints") == said(zenoh.Config(), "listen/endpoints"):
        config.insert_json5("listen/endpoints", "[]")
    if said(config, "scouting/multicast/enabled") is None:
        config.insert_json5("scouting/multicast/enabled", "false")
    _find_tls_files(config, path)
    return config


def said(config: zenoh.Config, key: str) -> object:
    """The value of a key, as plain Python values."""
    return msgspec.json.decode(config.get_json(key))


def _is_gripmons(path: Path) -> bool:
    """Is it a configuration of ours, given in place of one of Zenoh's?  Only asked when Zenoh can't read it."""
    text = path.read_text(encoding="utf-8", errors="replace")
    return len(set(re.findall(r"^(robot|camera|gripper|reference|monitor)\s*:", text, re.MULTILINE))) > 1


def _find_tls_files(config: zenoh.Config, path: Path) -> None:
    for name in _TLS_FILES:
        key = f"{_TLS}/{name}"
        value = said(config, key)
        if not isinstance(value, str):
            continue
        file = path.parent / value
        if not file.is_file():
            raise ZenohFileError(f"{path}: {key}: no file {file}; {_remedy(name, file)}")
        if name in _SECRETS and file.stat().st_mode & 0o077:
            raise ZenohFileError(f"{path}: {key}: others may read {file}; chmod 600 {file}")
        config.insert_json5(key, _json(str(file.resolve())))


def _remedy(name: str, file: Path) -> str:
    """Where a missing certificate or key is to come from: a second authority would help nobody."""
    if name != "root_ca_certificate" and (file.parent / "ca-key.pem").is_file():
        host = " --host ADDRESS" if name.startswith("listen") else ""
        return f"gripmon certificates {file.stem.removesuffix('-key')} --out {file.parent}{host} makes it"
    return "copy it from where the certificates were made (by gripmon certificates, once for all machines)"


def _json(value: str) -> str:
    return msgspec.json.encode(value).decode()
