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
Lets many monitors talk through one router (gripmon router) into one reader of everything and one alert log, all on this
machine, and prints what arrives, what is lost, how late, and what each monitor costs router and readers.
Then the same with a reader that leaves transforms alone, as gripmon watch and a central router do.

The monitors are real where this is about the network: each has a session, a publisher and messages as
gripmon run has. They process no images: one record, measured on a picture of the demo, is said again with
other numbers and stamps; fifty whole monitors would need the processors of fifty robots. Nor do they use
shared memory, as robots elsewhere can't."""

_HERE = Path(__file__).parent


@dataclass(frozen=True)
class Plan:
    monitors: int = 50
    rate_hz: float = 30.0
    processes: int = 2
    seconds: float = 30.0
    settle_s: float = 3.0


class Child:
    """A process that says ``ready``, and what it has seen in the end."""

    def __init__(self, *command: str) -> None:
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def line(self, expected: str) -> None:
        assert self.process.stdout is not None
        if (said := self.process.stdout.readline()) != f"{expected}\n":
            raise RuntimeError(f"{' '.join(self.process.args)}: said {said!r}, not {expected!r}")  # type: ignore[arg-type]

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
    log = folder / "alerts.jsonl"
    everything = _reader(children, router.endpoint, "transform,state,reference,alive")
    alerts = _reader(children, router.endpoint, "alert", str(log))
    time.sleep(plan.settle_s)
    before = {"router": _rss(router.pid), "reader": _rss(everything.process.pid)}
    talkers = _talkers(plan, folder, router.endpoint, children)
    for name, reader in (("everything", everything), ("table", None)):
        print(f"{name} …", file=sys.stderr)
        reader = reader or _reader(children, router.endpoint, "state,reference,alive")
        time.sleep(plan.settle_s)
        reader.mark()
        pids = {"router": [router.pid], "reader": [reader.process.pid], "alert log": [alerts.process.pid]}
        pids["monitors"] = [talker.process.pid for talker in talkers]
        cpu_s, start_s = {who: _cpu_s(of) for who, of in pids.items()}, time.monotonic()
        time.sleep(plan.seconds)
        span_s = time.monotonic() - start_s
        used = {who: (_cpu_s(of) - cpu_s[who]) / span_s for who, of in pids.items()}
        rss = {who: sum(_rss(pid) for pid in of) for who, of in pids.items()}
        results[name] = {"span_s": span_s, "cores": used, "rss_bytes": rss} | reader.finish()
    results["rss_before_bytes"] = before
    sent = [sums for talker in talkers for sums in talker.finish().values()]
    time.sleep(1.0)
    alerts.finish()
    results["alerts_sent"] = sum(each["alert"] for each in sent)
    results["alerts_logged"] = len(log.read_text().splitlines())


def _reader(children: list[Child], endpoint: str, leaves: str, *file: str) -> Child:
    children.append(Child(sys.executable, str(_HERE / "reader.py"), endpoint, leaves, *file))
    children[-1].line("ready")
    return children[-1]


def _talkers(plan: Plan, folder: Path, endpoint: str, children: list[Child]) -> list[Child]:
    talkers, first = [], 0
    for i in range(plan.processes):
        count = (plan.monitors - first) // (plan.processes - i)
        command = (str(_HERE / "monitors.py"), endpoint, str(first), str(count), str(plan.rate_hz))
        talkers.append(Child(sys.executable, *command, str(folder / "record.json")))
        children.append(talkers[-1])
        first += count
    for talker in talkers:
        talker.line("ready")
    return talkers


def real_record() -> bytes:
    """What the monitor says of a picture of the demo's scene."""
    from benchmarks import scene

    from gripmon.monitor import Monitor
    from gripmon.records import to_json

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
    from benchmarks.report import machine_lines

    plan = results["plan"]
    monitors = plan["monitors"]
    lines = [
        *machine_lines(results["machine"]),
        "",
        f"{monitors} monitors in {plan['processes']} processes; each says {plan['rate_hz']:g} transforms a second",
        f"of {results['transform_bytes']} bytes, its state every second, an alert every ten seconds",
    ]
    for name, title in (
        ("everything", "one router, one reader of everything, one alert log"),
        ("table", "the same, but the reader leaves transforms alone"),
    ):
        part = results[name]
        lines += ["", f"{title} ({part['span_s']:.0f} s)"]
        for leaf, count in sorted(part["count"].items()):
            lost, (median_us, high_us) = part["lost"].get(leaf, 0), part["latency_us"].get(leaf, (0.0, 0.0))
            if leaf == "reference":
                continue
            lines.append(
                f"  {leaf:10s} {count / part['span_s']:8.1f} /s   lost {lost} of {count + lost}   "
                f"until read {1e-3 * median_us:.2f} ms median, {1e-3 * high_us:.2f} ms 99 %"
            )
        lines.append(f"  monitors there: {part['alive']}")
        lines.append("                     a core       of it for each monitor      memory")
        for who, cores in part["cores"].items():
            rss = part["rss_bytes"][who]
            lines.append(
                f"  {who:12s} {1e2 * cores:10.1f} %   {1e2 * cores / monitors:14.3f} %   {rss / 2**20:16.1f} MiB"
            )
    grown = {
        who: (results["everything"]["rss_bytes"][who] - before) / monitors
        for who, before in results["rss_before_bytes"].items()
    }
    lines += ["", "memory for each monitor: " + ", ".join(f"{who} {v / 1024:.0f} KiB" for who, v in grown.items())]
    lines.append(f"alerts: {results['alerts_logged']} in the log of {results['alerts_sent']} that were sent")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
