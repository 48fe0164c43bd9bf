"""Where and on what a benchmark ran; another commit beside this checkout, to be measured in the same benchmark."""

from __future__ import annotations

import datetime
import hashlib
import io
import os
import platform
import subprocess
import tarfile
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
_KEPT = ROOT / "build" / "revisions"
_PACKAGES = ("numpy", "scipy", "opencv-contrib-python-headless", "eclipse-zenoh", "rerun-sdk", "msgspec", "pyapriltags")


def description() -> dict[str, Any]:
    """Machine, versions, commit and date, as plain values."""
    return {
        "cpu": _cpu_name(),
        "cpus": cores(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "commit": commit(),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "load_before": load(),
    }


def machine_lines(machine: dict[str, Any]) -> list[str]:
    """What a report begins with; ``load_after``, where it is there, was added at the end."""
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    after = f", {machine['load_after']} after" if "load_after" in machine else ""
    return [
        f"gripmon {machine['commit']}, {machine['date']}",
        f"{machine['cpu']}, {machine['cpus']} cores, {machine['system']}",
        f"load average {machine['load_before']} before{after} (1 belongs to this benchmark)",
        f"Python {machine['python']}, {packages}; one thread each",
    ]


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0))


def load() -> float:
    """Processes that wanted a core during the last minute, on average."""
    return round(os.getloadavg()[0], 2)


def rss_bytes(pid: int | str = "self") -> int:
    """Memory of a process that is in RAM."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def children_s() -> float:
    """Processor time of the processes that this one started and that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def _cpu_name() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


@cache
def commit() -> str:
    """Hash of the checkout, with a + if the product's files differ from it."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "--short=10", "HEAD") + ("+" if git("status", "--porcelain", "gripmon") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def digest_of(*patterns: str) -> str:
    """Digest of the checkout's files as they are: what was measured with others isn't continued."""
    digest = hashlib.sha256()
    for path in sorted({path for pattern in patterns for path in ROOT.glob(pattern)}):
        digest.update(f"{path.relative_to(ROOT)}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:10]


def commit_of(revision: str) -> str:
    """Its full hash.  Raises ValueError for none."""
    asked = ["git", "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}"]
    found = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False)
    if found.returncode != 0:
        raise ValueError(f"{revision}: git knows no such commit here; a hash, a branch or a tag")
    return found.stdout.strip()


def checkout_of(revision: str) -> Path:
    """A folder with the commit's files, named by its hash; kept, since compiled code is kept beside it.  Raises
    ValueError for a revision that is none.
    """
    commit = commit_of(revision)
    folder = _KEPT / commit
    if not folder.exists():
        packed = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True, check=True).stdout
        unpacked = _KEPT / f"{commit}.{os.getpid()}"
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            archive.extractall(unpacked, filter="data")
        unpacked.rename(folder)
    return folder


def environment(checkout: Path) -> dict[str, str]:
    """For a process of ``python -P`` whose gripmon is that of a checkout, and whose benchmarks are these."""
    return {**os.environ, "PYTHONPATH": f"{checkout}{os.pathsep}{ROOT / 'tools'}"}
