"""A thousand episodes in one call: rate, memory, a kill in the middle, and Ray.

gripmon dataset on simulated episodes of 10 s (30 frames/s, AV1). One process on a tenth of them; two processes on all,
killed by SIGKILL in the middle and called again; Ray on all, with one node of one core and a second one that joins
after a third; what an episode costs that fails at once, by both; and the driver's end on ten times as many rows.
Needs two quiet cores; --size 768x576 --episodes 100 is the row for planning.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks import kit, machine
from benchmarks.dataset_set import render, write_config, write_damaged, write_set
from benchmarks.kit import Report
from gripmon.analyse.dataset import Results, write_table
from gripmon.analyse.dataset_page import write_page
from gripmon.analyse.stretches import Stretch
from gripmon.io.sources import BagSettings
from gripmon.io.sources.episodes import Episode

_LOOK_S = 0.5
_TARGET_RATIO, _TARGET_GB = 1.9, 2.0


@dataclass
class Call:
    """One call of the command.  ``stored_s`` (n,): when each episode was stored; ``cpu_s``: of all its processes, where
    they are its children; ``peak_gb``: of all its processes together, pages that they share counted in each.
    """

    workers: int
    begin_s: float
    end_s: float
    stored_s: list[float]
    cpu_s: float
    peak_gb: float
    measured: int
    said: str

    @property
    def rate(self) -> float:
        """Episodes a second between the first and the last that was stored, without the processes' start."""
        stored = sorted(self.stored_s)
        return (len(stored) - 1) / (stored[-1] - stored[0]) if len(stored) > 1 else float("nan")


def add_options(parser: argparse.ArgumentParser) -> None:
    kit.numbers(parser, episodes=(1000, "in the dataset"))
    parser.add_argument("--size", default="384x288", metavar="WxH", help="of the images, px (default 384x288)")
    parser.add_argument("--no-ray", action="store_true", help="leave Ray out")


def run(arguments: argparse.Namespace, report: Report) -> None:
    width, height = (int(part) for part in arguments.size.split("x"))
    episodes, few = arguments.episodes, max(arguments.episodes // 10, 4)
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as name:
        folder = Path(name)
        write_config(folder / "c.yaml", (width, height))
        openings_m = render(folder, folder / "c.yaml")
        for root, number in (("few", few), ("all", episodes)):
            write_set(folder / root, folder, openings_m, (width, height), number)
        write_damaged(folder / "damaged", episodes)
        calls = {"one process": call(folder, "few", "one")}
        calls["two, killed"] = call(folder, "all", "two", workers=2, kill_at=episodes // 2)
        calls["two, again"] = call(folder, "all", "two", workers=2)
        calls["two, nothing"] = call(folder, "damaged", "nothing", workers=2)
        joined_s = float("nan")
        if not arguments.no_ray:
            with ray_nodes() as (address, join):
                calls["Ray, nothing"] = call(folder, "damaged", "ray_nothing", address=address)
                join.due = episodes // 3
                calls["Ray"] = call(folder, "all", "ray", address=address, look=join)
                joined_s = join.at_s
        end = kit.in_new_process(driver_end, folder / "end", 10 * episodes)
        same = _same(folder / "two", folder / "ray")
    report.values |= {"calls": calls, "joined_s": joined_s, **end}
    report.say(f"{episodes} episodes of 10 s, {arguments.size} px, AV1")
    show(calls, episodes, joined_s, end, same, report)


def call(
    folder: Path,
    dataset: str,
    out: str,
    *,
    workers: int = 1,
    address: str = "",
    kill_at: int | None = None,
    look: Callable[[int], None] = lambda _stored: None,
) -> Call:
    """``gripmon dataset`` in a process of its own, killed once ``kill_at`` episodes are stored; ``look`` is called
    with their number now and then.
    """
    to = folder / out
    before = set(to.glob("episodes-*/*.parquet"))
    command = [sys.executable, "-m", "gripmon", "dataset", str(folder / dataset), "--config", str(folder / "c.yaml")]
    command += ["--out", str(to)]
    command += ["--engine", "ray", "--address", address] if address else ["--workers", str(workers)]
    begin_s, before_s, peak = time.time(), machine.children_s(), 0
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    said: list[str] = []
    reader = threading.Thread(target=lambda: said.extend(process.stderr or ()), daemon=True)
    reader.start()
    # Ray's processes are this process's children, as its cluster is.
    root = psutil.Process(os.getpid() if address else process.pid)
    while process.poll() is None:
        peak = max(peak, _memory(root))
        count = len(list(to.glob("episodes-*/*.parquet")))
        look(count)
        if kill_at is not None and count >= kill_at:
            process.kill()
        time.sleep(_LOOK_S)
    end_s = time.time()
    reader.join()
    used_s = machine.children_s() - before_s
    stored = [path.stat().st_mtime for path in set(to.glob("episodes-*/*.parquet")) - before]
    done = re.search(r"(\d+) measured now", "".join(said))
    if kill_at is None and done is None:
        raise SystemExit(f"gripmon dataset failed:\n{''.join(said[-10:])}")
    return Call(
        workers, begin_s, end_s, stored, float("nan") if address or kill_at else used_s, peak / 1e9,
        int(done[1]) if done else len(stored), "".join(said[-1:]).strip(),
    )  # fmt: skip


def _memory(root: Any) -> int:
    total = 0
    for process in [root, *root.children(recursive=True)]:
        try:
            total += process.memory_info().rss if process.pid != os.getpid() else 0
        except psutil.Error:
            continue
    return total


class _Join:
    """Starts a second node once ``due`` episodes are stored, and knows when."""

    def __init__(self, cluster: Any) -> None:
        self._cluster, self.due, self.at_s = cluster, 0, float("nan")

    def __call__(self, stored: int) -> None:
        if stored >= self.due and self.at_s != self.at_s:
            self._cluster.add_node(num_cpus=1)
            self.at_s = time.time()


@contextmanager
def ray_nodes() -> Iterator[tuple[str, _Join]]:
    """A cluster on this machine with one core: its address, and what starts a second node."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        yield cluster.address, _Join(cluster)
    finally:
        cluster.shutdown()


def _same(one: Path, other: Path) -> bool | None:
    """Whether two tables are the same to the byte; None without the other."""
    if not (other / "stretches").exists():
        return None
    files = [sorted((folder / "stretches").rglob("*.parquet")) for folder in (one, other)]
    return [path.read_bytes() for path in files[0]] == [path.read_bytes() for path in files[1]]


def driver_end(folder: Path, rows: int) -> dict[str, float]:
    """Processor time of storing a row, and of table, mountings and report for each; peak memory."""
    folder.mkdir()
    rng = np.random.default_rng(1)
    covariance = tuple(np.diag([1e-9] * 3 + [1e-7] * 3).ravel().tolist())
    episodes = [Episode(f"{number:06d}", BagSettings(path="x"), "") for number in range(rows)]
    before_gb = _peak_gb()
    with Results(folder, "bench") as results:
        begin_s = time.process_time()
        for number, episode in enumerate(episodes):
            place = (1e-3 * (number % 20), *(1e-5 * rng.standard_normal(2)), 0.0, 0.0, 0.0, 1.0)
            row = Stretch(
                camera="wrist", episode=episode.name, verdict="valid", start_ns=0, end_ns=10, frames=300,
                measured_share=1.0, valid_share=1.0, cam_T_grip=place, covariance=covariance, protection_m=5e-4,
                moved=False, not_valid_ns=((0, 0),), picture=rng.bytes(19_000), reason="1 times: not yet confirmed",
            )  # fmt: skip
            results.add(episode, (row,))
        stored_s = time.process_time()
        table = write_table(results, episodes, folder, 0.01, 0.0, 0.0)
        write_page(folder / "report.html", table, results, episodes, "bench")
        end_s = time.process_time()
        size = sum(results.path(episode).stat().st_size for episode in episodes)
    written = sum(path.stat().st_size for path in (folder / "stretches").rglob("*.parquet"))
    return {
        "rows": rows, "store_ms": 1e3 * (stored_s - begin_s) / rows, "end_ms": 1e3 * (end_s - stored_s) / rows,
        "end_kb_per_row": 1e6 * (_peak_gb() - before_gb) / rows, "file_kb": 1e-3 * size / rows,
        "table_kb": 1e-3 * written / rows,
    }  # fmt: skip


def _peak_gb() -> float:
    return 1e-6 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def show(
    calls: dict[str, Call], episodes: int, joined_s: float, end: dict[str, float], same: bool | None, report: Report
) -> None:
    """A row a call, what follows from them, and the targets."""
    one, killed, again = calls["one process"], calls["two, killed"], calls["two, again"]
    lines = []
    for name, each in calls.items():
        took = (f"{each.end_s - each.begin_s:.0f}", f"{each.rate:.3f}", f"{each.cpu_s / max(each.measured, 1):.2f}")
        lines.append([name, each.measured, *took, f"{each.peak_gb:.2f}"])
    head = ("call", "episodes", "took, s", "episodes/s", "processor time, s/episode", "memory, GB")
    report.say(kit.table(head, lines))
    if "Ray" in calls:
        stored = sorted(calls["Ray"].stored_s)
        alone, both = [at for at in stored if at < joined_s], [at for at in stored if at > joined_s]
        rates = [(len(part) - 1) / (part[-1] - part[0]) if len(part) > 1 else float("nan") for part in (alone, both)]
        per = [1e3 / calls[name].rate for name in ("two, nothing", "Ray, nothing")]
        report.say(
            f"Ray: {rates[0]:.3f} episodes/s on one node, {rates[1]:.3f} on two; by processes {again.rate:.3f}",
            f"an episode that fails at once: {per[0]:.1f} ms with processes, {per[1]:.1f} ms with Ray",
        )
    report.say(
        f"driver, {end['rows']:.0f} rows: {end['store_ms']:.2f} ms to store one, {end['end_ms']:.2f} ms each at the "
        f"end (table, mountings, report), {end['end_kb_per_row']:.1f} kB of memory each; "
        f"{end['file_kb']:.0f} kB a file, {end['table_kb']:.0f} kB of table"
    )
    ratio, peak_gb = again.rate / one.rate, max(killed.peak_gb, again.peak_gb)
    lost = killed.measured + again.measured - episodes
    report.reach(
        [
            (f"two processes over one: at least {_TARGET_RATIO} times the episodes/s", f"{ratio:.2f} times",
             ratio >= _TARGET_RATIO),
            (f"memory of two workers and the driver: at most {_TARGET_GB:g} GB", f"{peak_gb:.2f} GB",
             peak_gb <= _TARGET_GB),
            (f"killed after {killed.measured} episodes, the second call measured the rest",
             f"{again.measured}, {lost} twice", lost == 0),
            ("tables by processes with a kill and by Ray are the same to the byte",
             {True: "yes", False: "DIFFERENT", None: "no Ray"}[same], same),
        ]
    )  # fmt: skip
