"""A router in this process: Zenoh's Python sessions route as ``zenohd`` does, by the same configuration file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Self

from gripmon.io.wire.endpoints import endpoints, endpoints_fault
from gripmon.io.wire.files import ZenohFileError, load_file, said
from gripmon.io.wire.reach import missing
from gripmon.io.wire.zenoh_errors import in_short

if TYPE_CHECKING:
    pass


class Router:
    """Routes from construction to :meth:`close`."""

    def __init__(self, path: Path) -> None:
        """``path``: a json5 or yaml file of Zenoh's.  Raises :class:`ZenohFileError`."""
        import zenoh

        config = load_file(path, default_mode="router")
        if (mode := said(config, "mode")) != "router":
            raise ZenohFileError(f"{path}: mode: {mode} doesn't route; router")
        self.listens_on = _endpoints(said(config, "listen/endpoints"))
        if not self.listens_on:
            raise ZenohFileError(f'{path}: listen.endpoints: there is none; e.g. ["tcp/127.0.0.1:7447"]')
        if fault := endpoints_fault(config):
            raise ZenohFileError(f"{path}: {fault[0]}.endpoints: {fault[1]}")
        self._connects_to = endpoints(config, "connect")
        config.insert_json5("listen/exit_on_failure", "true")
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            if taken := re.search(r"bound to (\S+?): .*Address already in use", str(error)):
                remedy = "stop the program that has it, or choose another port"
                raise ZenohFileError(f"{path}: listen.endpoints: {taken[1]} is already in use; {remedy}") from error
            raise ZenohFileError(f"{path}: can't route: {in_short(error)}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def fault(self) -> str:
        """Whom it should be connected to and isn't, in a few words for a person; empty if all is well."""
        places = missing(self._session, self._connects_to, one_is_enough=False)
        return f"no connection to {places}, trying again" if places else ""

    def close(self) -> None:
        """Leave the network and free the port."""
        self._session.close()


def _endpoints(listed: object) -> tuple[str, ...]:
    if isinstance(listed, dict):
        listed = listed.get("router")
    return tuple(map(str, listed)) if isinstance(listed, list) else ()
