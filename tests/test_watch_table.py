"""The table of all monitors from given states, and the alert log: order, text, and what a hostile name can't do."""

from __future__ import annotations

import argparse
import json
import random
import resource
import time
from pathlib import Path

import msgspec
import pytest
from support.loopback import alert_record, state_record

from gripmon.cli import fleet_table
from gripmon.cli.alert_log import AlertLog
from gripmon.cli.watch import _print_alerts
from gripmon.client import Condition, MonitorName, MonitorStatus, trouble
from gripmon.model.records import AlertKind, Severity, StandingAlert, State, StateRecord, Verdict, from_json, to_json

RECORDED_NS = GONE_NS = 1_700_000_000_000_000_000


def state(**changes: object) -> StateRecord:
    return msgspec.structs.replace(state_record(), **({"tcp_shift_m": (0.001, 0.0, 0.0), "sigma_m": 2e-5} | changes))


def status(
    robot: str, *, age_s: float = 0.5, gone: bool = False, several: bool = False, **changes: object
) -> MonitorStatus:
    said = None if changes.get("state") == "none" else state(**changes)
    return MonitorStatus(
        name=MonitorName(robot, "wrist"),
        state=said,
        state_age_s=age_s,
        gone_since_ns=GONE_NS if gone else None,
        several=several,
    )


def standing(severity: Severity, text: str = "", **changes: object) -> StandingAlert:
    values = {"alert_id": "1-a", "since_ns": 5, "acknowledged": False} | changes
    return StandingAlert(kind=AlertKind.DRIFT, severity=severity, text=text, **values)  # type: ignore[arg-type]


UNKNOWN = {"verdict": Verdict.UNKNOWN, "tcp_shift_m": None, "sigma_m": None}
THE_WORST_FIRST = [
    status("gone", gone=True),
    status("stopped", gone=True, message="stopped", state=State.STALE, **UNKNOWN),
    status("hangs", age_s=9.0),
    status("twice", several=True),
    status("lost-with-error", state=State.LOST, open_alerts=(standing(Severity.ERROR),), **UNKNOWN),
    status("lost", state=State.LOST, **UNKNOWN),
    status("new", state="none", age_s=0.1),
    status("suspect-far", verdict=Verdict.SUSPECT, tcp_shift_m=(0.0, 0.004, 0.003)),
    status("suspect-near", verdict=Verdict.SUSPECT, tcp_shift_m=(0.0, 0.0, 0.0049)),
    status("error", open_alerts=(standing(Severity.INFO), standing(Severity.ERROR))),
    status("warning", open_alerts=(standing(Severity.WARNING),), tcp_shift_m=(0.0, 0.0, 0.0)),
    status("info", open_alerts=(standing(Severity.INFO),), tcp_shift_m=(0.1, 0.0, 0.0)),
    status("drift-2mm", tcp_shift_m=(-0.002, 0.0, 0.0)),
    status("drift-1mm"),
    status("well-a", tcp_shift_m=(0.0, 0.0, 0.0)),
    status("well-b", tcp_shift_m=(0.0, 0.0, 0.0)),
]


def test_a_monitor_that_stopped_with_something_wrong_has_stopped_nevertheless():
    said = "stopped; no jaw opening for 1 s or longer"
    assert status("arm", gone=True, message=said, state=State.STALE, **UNKNOWN).condition is Condition.STOPPED
    assert status("arm", gone=True, message="stopped short", state=State.LOST).condition is Condition.GONE


def test_the_worst_come_first_whatever_the_order_they_came_in():
    shuffled = random.Random(5).sample(THE_WORST_FIRST, len(THE_WORST_FIRST))
    assert [s.name.robot for s in sorted(shuffled, key=trouble)] == [s.name.robot for s in THE_WORST_FIRST]
    conditions = [s.condition for s in THE_WORST_FIRST]
    assert conditions == sorted(conditions, key=list(Condition).index) and set(conditions) == set(Condition)


def test_the_cells_say_what_the_monitor_said():
    alerts = (
        standing(Severity.INFO, "settling", since_ns=9),
        standing(Severity.WARNING, "older", since_ns=3),
        standing(Severity.WARNING, "moved 4.5 mm", since_ns=8),
        standing(Severity.WARNING, "seen", since_ns=10, acknowledged=True),
    )
    row = fleet_table.row(
        status(
            "arm",
            state=State.DRIFTING,
            tcp_shift_m=(0.0, -0.003, 0.004),
            sigma_m=12e-6,
            protection_m=3.51e-4,
            alert_limit_m=5e-4,
            open_alerts=alerts,
        )
    )
    assert dict(zip(fleet_table.COLUMNS, row.cells, strict=True)) == {
        "monitor": "arm/wrist", "state": "drifting", "verdict": "valid", "drift mm": "5.000", "sigma mm": "0.012",
        "bound mm": "0.35/0.5",
        "fps": "30.0", "heard s": "0.5", "reference": "3 plate-2", "alerts": "!3 i1 moved 4.5 mm",
    }  # fmt: skip
    assert row.condition == "valid"
    listened = msgspec.structs.replace(status("arm"), transforms_per_s=24.96, transform_age_s=0.04)
    assert fleet_table.row(listened).cells[6:8] == ("25.0", "0.0")


def test_a_bound_stands_there_as_far_as_it_is_known():
    def bound(**changes: object) -> str:
        return fleet_table.row(status("arm", **changes)).cells[5]

    assert bound() == bound(alert_limit_m=5e-4) == "-"  # an older monitor; one that has no transform
    assert bound(protection_m=8.3e-3) == "8.30" and bound(protection_m=8.3e-3, alert_limit_m=0.01) == "8.30/10"


def test_a_monitor_that_is_gone_or_hangs_vouches_for_nothing():
    gone, stopped, hangs, *_ = map(fleet_table.row, THE_WORST_FIRST)
    for row in (gone, stopped, hangs):
        assert row.cells[2] == "unknown" and row.cells[6] == "-"
    assert gone.cells[1].startswith("gone since 2023-11-1") and gone.cells[3] == "1.000"  # the last that was said
    assert stopped.cells[1].startswith("stopped since 2023-11-1") and stopped.cells[3] == "-"
    assert hangs.cells[1] == "silent, was tracking"
    assert fleet_table.row(status("new", state="none")).cells == (
        "new/wrist", "starting", "unknown", "-", "-", "-", "-", "0.5", "-", ""
    )  # fmt: skip


def test_a_terminal_gets_as_many_as_fit_and_the_count_of_the_rest():
    from rich.console import Console

    console = Console(width=120, height=12, force_terminal=True, color_system=None, legacy_windows=False)
    with console.capture() as capture:
        console.print(fleet_table.table(THE_WORST_FIRST, "no connection to tcp/x", 12, 120))
    lines = capture.get().splitlines()
    assert len(lines) <= 12
    shown = [line.split("/")[0] for line in lines if "/wrist" in line]
    assert shown == [s.name.robot for s in THE_WORST_FIRST[: len(shown)]] and len(shown) == 6
    below = " ".join(line.strip() for line in lines[-3:])
    assert (
        "16 monitors: 1 gone, 1 stopped, 1 silent, 1 several, 2 unknown, 1 starting, 2 suspect, 7 valid; "
        "no connection to tcp/x;" in below
    )
    assert "10 more not shown, none of them worse" in below and fleet_table.LEGEND in below


@pytest.mark.parametrize(("width", "has_sigma"), [(80, False), (120, True)])
def test_a_narrow_terminal_keeps_the_bound_and_the_drift(width: int, has_sigma: bool):
    from rich.console import Console

    console = Console(width=width, height=12, force_terminal=True, color_system=None, legacy_windows=False)
    told = status("arm", tcp_shift_m=(0.003, 0.0, 0.0), protection_m=3.51e-4, alert_limit_m=5e-4)
    with console.capture() as capture:
        console.print(fleet_table.table([told], "", 12, width))
    assert "3.000" in capture.get() and "0.35/0.5" in capture.get() and ("sigma mm" in capture.get()) == has_sigma


def test_a_log_gets_aligned_columns_or_one_line():
    lines = fleet_table.plain(THE_WORST_FIRST, "").splitlines()
    assert len(lines) == 1 + len(THE_WORST_FIRST) + 2 and lines.pop() == fleet_table.LEGEND
    start = lines[0].index("verdict")
    assert {line[start:].split()[0] for line in lines[1:-1]} == {"unknown", "suspect", "valid"}
    assert fleet_table.line(status("arm", message="jaw unknown")) == (
        "arm/wrist: tracking, valid, drift mm 1.000, sigma mm 0.020, fps 30.0, heard s 0.5, reference 3 plate-2; "
        "jaw unknown"
    )


def test_no_name_or_text_from_the_network_reaches_the_terminal_as_a_command():
    from rich.console import Console

    evil = "\x1b]0;owned\x07[red]x[/]\r\n"
    nasty = status(f"a{evil}", reference_id=evil, message=evil, state=State(evil))
    console = Console(width=300, force_terminal=True, color_system=None)
    with console.capture() as capture:
        console.print(fleet_table.table([nasty], evil, 20, 120))
    for text in (capture.get(), fleet_table.plain([nasty], evil), fleet_table.line(nasty)):
        assert "\x1b]" not in text and "\x07" not in text and "\r" not in text
        assert "[red]x[/]" in text  # not taken for markup either


def test_json_has_what_the_table_is_made_from():
    data = msgspec.json.encode([fleet_table.as_data(s) for s in THE_WORST_FIRST])
    told = json.loads(data)
    assert [each["condition"] for each in told] == [s.condition.value for s in THE_WORST_FIRST]
    assert told[0]["gone_since_ns"] == GONE_NS and told[7]["drift_m"] == pytest.approx(0.005)
    assert told[7]["state"]["schema"] == "gripmon.state/1" and told[6]["state"] is None


ARM = MonitorName("arm", "wrist")


class Log(AlertLog):
    """As ``gripmon watch --alerts`` shows it."""

    def __init__(self, path: Path | None, *, as_json: bool) -> None:
        super().__init__(path)
        self._arguments = argparse.Namespace(out=path, json=as_json)

    def show(self) -> None:
        _print_alerts(self, self._arguments)


def test_the_alert_log_has_every_alert_once_over_restarts(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "alerts.jsonl"
    records = [alert_record(f"moved {i} mm") for i in range(3)]
    payloads = [to_json(record).replace(b'","', b'",\n"') for record in records]  # however its writer lays it out
    for first in (0, 1):  # the second run gets again what the monitor kept
        log = Log(path, as_json=False)
        for record, payload in zip(records[: 2 + first], payloads[: 2 + first], strict=True):
            log.alert(ARM, record, payload)
        log.show()
        log.show()
    assert [json.loads(line) for line in path.read_text().splitlines()] == [json.loads(p) for p in payloads]
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 3 and "arm/wrist  warning  drift, revision 3: moved 0 mm" in said[0]


def test_an_alert_with_the_clock_of_recorded_images_says_so(capsys: pytest.CaptureFixture[str]):
    log = Log(None, as_json=False)
    for stamp_ns in (time.time_ns(), RECORDED_NS):
        record = msgspec.structs.replace(alert_record(), stamp_ns=stamp_ns)
        log.alert(ARM, record, to_json(record))
    log.show()
    now, recorded = capsys.readouterr().out.splitlines()
    assert "(" not in now.partition("arm/wrist")[0]
    assert (
        recorded.startswith("2023-11-1") and "(the clock of recorded images, or an alert from before)  arm" in recorded
    )


@pytest.mark.parametrize("number", [-1, 2**63, -(10**30), 10**400])
def test_no_number_from_the_network_stops_the_table_or_the_log(number: int, capsys: pytest.CaptureFixture[str]):
    odd = from_json(to_json(state(seq=number, stamp_ns=number, revision=number)), StateRecord)
    strange = MonitorStatus(name=ARM, state=odd, state_age_s=0.0, gone_since_ns=number)
    for shown in (fleet_table.plain([strange], ""), fleet_table.line(strange)):
        assert str(number) in shown
    assert json.loads(msgspec.json.encode(fleet_table.as_data(strange)))["state"]["seq"] == number
    log = Log(None, as_json=False)
    record = msgspec.structs.replace(alert_record(), stamp_ns=number)
    log.alert(ARM, record, to_json(record))
    log.show()
    assert "arm/wrist" in capsys.readouterr().out


def test_the_alert_log_says_who_vanished_and_came(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "alerts.jsonl"
    log = Log(path, as_json=True)
    log.presence(status("arm"))
    log.presence(status("arm", gone=True))
    log.show()
    came, went = (json.loads(line) for line in path.read_text().splitlines())
    assert (came["event"], went["event"], went["stamp_ns"]) == ("appeared", "vanished", GONE_NS)
    assert {came["schema"], went["schema"]} == {"gripmon.presence/1"}
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == [came, went]


def test_while_nobody_reads_what_is_printed_the_oldest_are_lost(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("gripmon.cli.alert_log.WAITING_MOST", 3)
    log = Log(None, as_json=True)
    for i in range(5):
        log.alert(ARM, alert_record(str(i)), to_json(alert_record(str(i))))
    log.show()
    assert [json.loads(line)["text"] for line in capsys.readouterr().out.splitlines()] == ["2", "3", "4"]


def test_a_log_that_can_not_be_written_is_said_once_and_complete_in_the_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "there" / "alerts.jsonl"
    log = Log(path, as_json=True)
    for i in range(3):
        log.alert(ARM, alert_record(str(i)), to_json(alert_record(str(i))))
        log.show()
    path.parent.mkdir()
    path.write_bytes(b'{"cut off')  # by whoever wrote last
    log.show()
    lines = path.read_text().splitlines()
    assert lines[0] == '{"cut off' and [json.loads(line)["text"] for line in lines[1:]] == ["0", "1", "2"]
    errors = capsys.readouterr().err.splitlines()
    assert errors == [f"watch: --out {path}: No such file or directory; trying again"]


def test_a_disk_that_is_full_in_the_middle_of_a_line_leaves_no_half_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "alerts.jsonl"
    log = Log(path, as_json=False)
    payloads = [to_json(alert_record(str(i))) for i in range(2)]
    log.alert(ARM, alert_record("0"), payloads[0])
    log.show()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(payloads[0]) + 20, limits[1]))  # as large as a file may become
    try:
        log.alert(ARM, alert_record("1"), payloads[1])
        log.show()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == payloads[0] + b"\n"
    log.show()
    assert path.read_bytes().splitlines() == payloads
    assert capsys.readouterr().err == f"watch: --out {path}: File too large; trying again\n"
