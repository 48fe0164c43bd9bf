"""``tools/fleet`` in small: every message is counted, by those who send and those who read.  No speed is asserted."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("tools_importable")


@pytest.mark.slow("20 s: the load of a whole fleet; one monitor and its readers are in the default run")
def test_a_small_fleet():
    import importlib

    fleet = importlib.import_module("fleet_load.__main__")
    plan = fleet.Plan(monitors=5, rate_hz=10.0, processes=2, seconds=6.0, settle_s=1.0)
    results = fleet.measure(plan)
    everything, table = results["everything"], results["table"]
    assert everything["alive"] == table["listed"] == 5 and table["unreadable"] == 0
    assert everything["count"]["transform"] > 0 and everything["count"]["state"] > 0
    # At most what five cameras say, and what comes late once the machine has time again.
    assert everything["count"]["transform"] + everything["lost"].get("transform", 0) < 3 * 5 * 10 * everything["span_s"]
    assert results["alerts_logged"] == results["alerts_sent"] >= 5
    for part, who in ((everything, "reader"), (table, "watch")):
        assert set(part["cores"]) == {"router", who, "alert log", "monitors"}
        assert all(rss > 5e6 for rss in part["rss_bytes"].values())
    for median_us, high_us in everything["latency_us"].values():
        assert 0.0 < median_us <= high_us
    text = fleet.as_text(results)
    assert "monitors there: 5" in text and f"{results['alerts_logged']} in the log" in text


def test_a_reader_counts_gaps_and_what_is_there(tmp_path: Path):
    from fleet_load.reader import Reading

    class Sample:
        def __init__(self, key: str, seq: int) -> None:
            self.key_expr, self.payload = key, self
            self._text = f'{{"seq":{seq},"stamp_ns":1,"more":[1]}}'

        def to_bytes(self) -> bytes:
            return self._text.encode()

    with (tmp_path / "log").open("w") as log:
        reading = Reading(log)
        for key, seq in (("a/transform", 1), ("b/transform", 5), ("a/transform", 2), ("b/transform", 9)):
            reading.take(Sample(key, seq))
        figures = reading.figures()
        reading.mark()
        reading.take(Sample("a/transform", 4))
    assert (figures["count"], figures["lost"]) == ({"transform": 4}, {"transform": 3})
    assert reading.figures()["lost"] == {"transform": 1}
    assert len((tmp_path / "log").read_text().splitlines()) == 5


def test_wrong_usage_is_said_in_a_line(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    import importlib

    fleet = importlib.import_module("fleet_load.__main__")
    for arguments in (["--monitors", "0"], ["--monitors", "2", "--processes", "3"], ["--rate", "x"]):
        monkeypatch.setattr(sys, "argv", ["tools/fleet", *arguments])
        with pytest.raises(SystemExit) as ended:
            fleet.main()
        assert ended.value.code == 2
        assert "Traceback" not in capsys.readouterr().err
