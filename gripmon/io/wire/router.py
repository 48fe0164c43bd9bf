"""A router in this process."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from gripmon.io.wire.link import missing
from gripmon.io.wire.session import ZenohFileError, endpoints, load_file, value_of, zenohs_words


class Router:
    """Routes from construction to :meth:`close`."""

    def __init__(self, path: Path) -> None:
        """``path``: a Zenoh configuration, json5 or yaml.  Raises :class:`ZenohFileError`."""
        import zenoh

        config = load_file(path, default_mode="router")
        if (mode := value_of(config, "mode")) != "router":
            raise ZenohFileError(f"{path}: mode: {mode} doesn't route; router")
        self.listens_on = endpoints(config, "listen")
        if not self.listens_on:
            raise ZenohFileError(f'{path}: listen.endpoints: there is none; e.g. ["tcp/127.0.0.1:7447"]')
        self._connects_to = endpoints(config, "connect")
        config.insert_json5("listen/exit_on_failure", "true")
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise ZenohFileError(f"{path}: can't route: {zenohs_words(error)}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def fault(self) -> str:
        """Which connections are missing, in a few words for people; empty if none."""
        places = missing(self._session, self._connects_to, one_is_enough=False)
        return f"no connection to {places}, trying again" if places else ""

    def close(self) -> None:
        """Leave the network and free the port."""
        self._session.close()
