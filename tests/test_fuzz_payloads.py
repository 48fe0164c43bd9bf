"""90,000 malformed payloads through everything that reads the network: each is refused in one line, nothing else."""

from __future__ import annotations

import json
import random
from collections import Counter
from collections.abc import Iterable

import numpy as np
import psutil
import pytest
import zenoh
from support.rubbish import SIZE_PX, Rubbish, broken_json, files, frames, good_note, image, jaws

from gripmon.io.publish.commands import _name, _request
from gripmon.io.publish.inputs import opening_of_json
from gripmon.io.sources.network import PayloadDecoder
from gripmon.io.sources.payload import PayloadError
from gripmon.io.wire import Keys
from gripmon.model.jaw import JawError
from gripmon.model.records import CommandError, CommandFault, CommandRequest

MOST_GROWTH_BYTES = 48 << 20
"""Of the resident memory; one frame that is kept of each hundred would be more."""


def assert_one_line(error: Exception) -> None:
    text = str(error)
    assert text and "\n" not in text, text


def refusals(decoder: PayloadDecoder, payloads: Iterable[Rubbish]) -> tuple[Counter[str], int]:
    """How many were refused, by their first words, and how many were frames of this camera all the same."""
    refused: Counter[str] = Counter()
    taken = 0
    for payload in payloads:
        try:
            content = decoder.decode(*payload)
        except PayloadError as error:
            assert_one_line(error)
            refused[str(error)[:12]] += 1
            continue
        taken += 1
        assert content.image.shape[:2] == SIZE_PX[::-1] and content.image.dtype in (np.uint8, np.uint16, np.float32)
        assert content.stamp_ns is None or 0 <= content.stamp_ns < 2**63
        assert content.jaw_opening_m is None or -1e-3 <= content.jaw_opening_m <= 1.0
    return refused, taken


def resident_bytes() -> int:
    return psutil.Process().memory_info().rss


def assert_still_works(decoder: PayloadDecoder) -> None:
    for data in files():
        assert decoder.decode(data, "zenoh/bytes", None).image.shape[:2] == SIZE_PX[::-1]
    raw = decoder.decode(image().tobytes(), "zenoh/bytes", json.dumps(good_note()).encode())
    np.testing.assert_array_equal(raw.image, image())
    assert (raw.stamp_ns, raw.jaw_opening_m) == (5, 0.03)


def test_60000_frames(capfd: pytest.CaptureFixture[str]):
    decoder = PayloadDecoder("auto", SIZE_PX)
    refusals(decoder, frames(0, 500))  # what is loaded or cached once
    before = resident_bytes()
    refused, taken = refusals(decoder, frames(1, 60_000))
    assert resident_bytes() - before < MOST_GROWTH_BYTES
    assert sum(refused.values()) + taken == 60_000 and taken < 0.2 * 60_000
    assert len(refused) > 10, "many kinds of wrong are told from each other"
    assert_still_works(decoder)
    assert capfd.readouterr() == ("", ""), "damaged files are no lines on a terminal"


@pytest.mark.parametrize("frame_format", ["raw", "jpeg", "png"])
def test_3000_frames_where_one_format_is_told(frame_format: str):
    decoder = PayloadDecoder(frame_format, SIZE_PX)
    refused, taken = refusals(decoder, frames(2, 3_000))
    assert sum(refused.values()) + taken == 3_000 and taken < 0.2 * 3_000


def test_15000_jaw_messages():
    count = 0
    for payload in jaws(4, 16_500):
        count += 1
        try:
            opening_m = opening_of_json(payload).opening_m
        except JawError as error:
            assert_one_line(error)
            continue
        # A number, but none of metres of a gripper: refused by whoever knows the travel.
        assert abs(opening_m) > 1.0, f"{payload!r} is no opening, but {opening_m} came out"
    assert count > 15_000
    assert opening_of_json(b'{"stamp_ns": 1, "opening_m": 0.03}') == (1, 0.03)
    assert opening_of_json(b" 0.03\n") == (0, 0.03) and opening_of_json(b"0") == (0, 0.0)


def test_6000_commands():
    keys, rng = Keys("arm", "wrist"), random.Random(6)
    refused = 0
    for _ in range(6_000):
        request = _request(zenoh.ZBytes(broken_json(rng, {"argument": "plate-2"})))
        assert isinstance(_name(keys, f"gripmon/arm/wrist/cmd/{rng.choice(['*', '', 'explode', 'a/b'])}"), CommandError)
        if isinstance(request, CommandError):
            refused += 1
            assert request.error is CommandFault.MALFORMED and "\n" not in request.text
        else:
            assert isinstance(request.argument, str) and len(request.argument) < 4096
    assert refused > 4_000
    assert _request(zenoh.ZBytes(b'{"argument": "x"}')) == CommandRequest(argument="x")
