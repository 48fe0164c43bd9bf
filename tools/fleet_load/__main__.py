"""``tools/fleet``: many monitors' traffic through one router into one table and one alert log, and what that costs."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_DESCRIPTION = """\
Lets many monitors talk through one router (gripmon router) into one reader of everything and one alert log
(gripmon watch --alerts), all on this machine, and prints what arrives, what is lost, how late, and what each
monitor costs router and readers. Then the same with gripmon watch in place of the reader: a table needs no
transforms, and where no one wants them they aren't even sent.

The monitors are real where this is about the network: each has a session, a publisher and messages as
gripmon run has. They process no images: one record, measured on a picture of the demo, is published again with
other numbers and stamps; fifty whole monitors would need the processors of fifty robots. Nor do they use
shared memory, as robots elsewhere can't."""

_HERE = Path(__file__).parent
_WATCH = ("-m", "gripmon", "watch")


@dataclass(frozen=True)
class Plan:
    monitors: int = 50
    rate_hz: float = 30.0
    processes: int = 2
    seconds: float = 30.0
    settle_s: float = 3.0


class Child:
    """A process that says ``ready``, and what it has seen in the end."""

    def __init__(self, *command: str, output: Any = subprocess.PIPE) -> None:
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, text=True)

    def line(self, expected: str) -> None:
        assert self.process.stdout is not None
        if (line := self.process.stdout.readline()) != f"{expected}\n":
            raise RuntimeError(f"{' '.join(self.process.args)}: printed {line!r}, not {expected!r}")  # type: ignore[arg-type]

    def mark(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write("mark\n")
        self.process.stdin.flush()
        self.line("marked")

    def finish(self) -> dict[str, Any]:
        answer, _ = self.process.communicate(timeout=60.0)
        figures: dict[str, Any] = json.loads(answer)
        return figures

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


def main() -> int:
    arguments = _arguments()
    plan = Plan(arguments.monitors, arguments.rate, arguments.processes, arguments.seconds)
    results = measure(plan)
    print(as_text(results))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")
    return 0 if results["alerts_logged"] == results["alerts_sent"] else 1


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="tools/fleet", description=_DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    defaults = Plan()
    for name, kind, text in (
        ("monitors", int, "how many"),
        ("rate", float, "transforms a second of each"),
        ("processes", int, "over how many processes the monitors are spread"),
        ("seconds", float, "how long each part is measured (s)"),
    ):
        default = getattr(defaults, "rate_hz" if name == "rate" else name)
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="N", help=f"{text}; default: {default:g}")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything that was measured")
    arguments = parser.parse_args()
    if min(arguments.monitors, arguments.rate, arguments.processes, arguments.seconds) <= 0:
        parser.error("monitors, rate, processes and seconds are above 0")
    if arguments.processes > arguments.monitors:
        parser.error(f"--processes {arguments.processes}: at most one for each of the {arguments.monitors} monitors")
    return arguments


def measure(plan: Plan) -> dict[str, Any]:
    """All of it; plain values."""
    from benchmarks import machine
    from benchmarks.wire_others import RouterProcess

    results: dict[str, Any] = {"machine": machine.description(), "plan": plan.__dict__}
    with tempfile.TemporaryDirectory(prefix="gripmon-fleet-") as scratch:
        folder = Path(scratch)
        record = folder / "record.json"
        record.write_bytes(real_record())
        results["transform_bytes"] = record.stat().st_size
        router = RouterProcess(folder, shared_memory=False)
        children: list[Child] = []
        try:
            _run(plan, folder, router, children, results)
        finally:
            for child in children:
                if child.process.poll() is None:
                    child.kill()
            router.close()
    results["machine"]["load_after"] = machine.load()
    return results


def _run(plan: Plan, folder: Path, router: Any, children: list[Child], results: dict[str, Any]) -> None:
    log, table = folder / "alerts.jsonl", folder / "table.jsonl"
    everything = _child(children, str(_HERE / "reader.py"), router.endpoint, "transform,state,reference,alive")
    everything.line("ready")
    alerts = _child(children, *_WATCH, "--alerts", "--out", str(log), "--connect", router.endpoint)
    time.sleep(plan.settle_s)
    results["rss_before_bytes"] = {"router": _rss(router.pid), "reader": _rss(everything.process.pid)}
    talkers = _talkers(plan, folder, router.endpoint, children)
    always = {"router": [router.pid], "alert log": [alerts.process.pid]}
    always["monitors"] = [talker.process.pid for talker in talkers]
    print("everything …", file=sys.stderr)
    time.sleep(plan.settle_s)
    everything.mark()
    costs = _costs({"reader": [everything.process.pid]} | always, plan.seconds)
    results["everything"] = costs | everything.finish()
    print("table …", file=sys.stderr)
    with table.open("w") as output:
        watch = _child(children, *_WATCH, "--json", "--connect", router.endpoint, output=output)
        time.sleep(plan.settle_s)
        results["table"] = _costs({"watch": [watch.process.pid]} | always, plan.seconds)
    newest = json.loads(table.read_text().splitlines()[-1])
    results["table"]["listed"] = len(newest["monitors"])
    results["table"]["unreadable"] = newest["unreadable"]
    sent = [sums for talker in talkers for sums in talker.finish().values()]
    time.sleep(1.0)
    logged = [json.loads(line) for line in log.read_text().splitlines()]
    results["alerts_sent"] = sum(each["alert"] for each in sent)
    results["alerts_logged"] = sum("alert_id" in each for each in logged)


def _costs(pids: dict[str, list[int]], seconds: float) -> dict[str, Any]:
    """Cores in use meanwhile and memory at the end, of each group of processes."""
    before_s, start_s = {who: _cpu_s(of) for who, of in pids.items()}, time.monotonic()
    time.sleep(seconds)
    span_s = time.monotonic() - start_s
    return {
        "span_s": span_s,
        "cores": {who: (_cpu_s(of) - before_s[who]) / span_s for who, of in pids.items()},
        "rss_bytes": {who: sum(_rss(pid) for pid in of) for who, of in pids.items()},
    }


def _child(children: list[Child], *arguments: str, output: Any = subprocess.PIPE) -> Child:
    children.append(Child(sys.executable, *arguments, output=output))
    return children[-1]


def _talkers(plan: Plan, folder: Path, endpoint: str, children: list[Child]) -> list[Child]:
    talkers, first = [], 0
    for i in range(plan.processes):
        count = (plan.monitors - first) // (plan.processes - i)
        command = (str(_HERE / "monitors.py"), endpoint, str(first), str(count), str(plan.rate_hz))
        talkers.append(_child(children, *command, str(folder / "record.json")))
        first += count
    for talker in talkers:
        talker.line("ready")
    return talkers


def real_record() -> bytes:
    """What the monitor says of a picture of the demo's scene."""
    from benchmarks import scene

    from gripmon.model.records import to_json
    from gripmon.monitor import Monitor

    config, ring = scene.config_for((768, 576)), scene.render((768, 576), 4)
    monitor = Monitor(config.camera, config.gripper, config.settings.monitor, config.reference)
    records = [monitor.process(ring.frame(seq)) for seq in range(4)]
    return to_json(records[-1])


def _cpu_s(pids: list[int]) -> float:
    import psutil

    times = [psutil.Process(pid).cpu_times() for pid in pids]
    return sum(each.user + each.system for each in times)


def _rss(pid: int) -> int:
    import psutil

    return int(psutil.Process(pid).memory_info().rss)


def as_text(results: dict[str, Any]) -> str:
    """The whole report."""
    from benchmarks.machine import machine_lines

    plan = results["plan"]
    monitors = plan["monitors"]
    lines = [
        *machine_lines(results["machine"]),
        "",
        f"{monitors} monitors in {plan['processes']} processes; each says {plan['rate_hz']:g} transforms a second",
        f"of {results['transform_bytes']} bytes, its state every second, an alert every ten seconds",
    ]
    everything, table = results["everything"], results["table"]
    lines += ["", f"one router, one reader of everything, one alert log ({everything['span_s']:.0f} s)"]
    for leaf in ("transform", "state"):
        count, lost = everything["count"].get(leaf, 0), everything["lost"].get(leaf, 0)
        median_us, high_us = everything["latency_us"].get(leaf, (float("nan"),) * 2)
        lines.append(
            f"  {leaf:10s} {count / everything['span_s']:8.1f} /s   lost {lost} of {count + lost}   "
            f"until read {1e-3 * median_us:.2f} ms median, {1e-3 * high_us:.2f} ms 99 %"
        )
    lines += [f"  monitors there: {everything['alive']}", *_cost_lines(everything, monitors)]
    lines += ["", f"the same, with gripmon watch in place of the reader ({table['span_s']:.0f} s)"]
    lines += [f"  monitors in the table: {table['listed']}", *_cost_lines(table, monitors)]
    grown = {
        who: (results["everything"]["rss_bytes"][who] - before) / monitors
        for who, before in results["rss_before_bytes"].items()
    }
    lines += ["", "memory for each monitor: " + ", ".join(f"{who} {v / 1024:.0f} KiB" for who, v in grown.items())]
    lines.append(f"alerts: {results['alerts_logged']} in the log of {results['alerts_sent']} that were sent")
    return "\n".join(lines)


def _cost_lines(part: dict[str, Any], monitors: int) -> list[str]:
    lines = ["                     a core       of it for each monitor      memory"]
    for who, cores in part["cores"].items():
        rss = part["rss_bytes"][who] / 2**20
        lines.append(f"  {who:12s} {1e2 * cores:10.1f} %   {1e2 * cores / monitors:14.3f} %   {rss:16.1f} MiB")
    return lines


if __name__ == "__main__":
    sys.exit(main())
