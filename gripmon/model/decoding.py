"""Types that any thread may decode to."""

from __future__ import annotations

import threading
from typing import TypeVar

import msgspec

_T = TypeVar("_T")
_making = threading.Lock()
_made: dict[object, msgspec.json.Decoder[object]] = {}


def decoder_of(kind: type[_T]) -> msgspec.json.Decoder[_T]:
    """The decoder of JSON for a type, which is made once.

    msgspec describes a struct when the first decoder for it, or conversion to it, is made, in Python code: a second
    thread that decodes meanwhile reads the unfinished description, which ends the process (msgspec 0.22).  Once this
    has returned any thread may decode or convert to the type, and to those inside it.
    """
    found = _made.get(kind)
    if found is None:
        with _making:
            found = _made[kind] = _made.get(kind) or msgspec.json.Decoder(kind)
    return found  # type: ignore[return-value]
