"""``tools/bench latency --against REV``: two revisions on the same frames in one run, in blocks that alternate.

Each has a process of its own with its own package and benchmarks; both have the same core, and one waits while the
other runs.  What slows the machine meanwhile slows both.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import kit, machine
from benchmarks.kit import Report
from benchmarks.machine import checkout_of, commit_of
from benchmarks.parts import Frames, Rings

_SIDE = Path(__file__).parent / "latency_side.py"
_LEAST_SIGMAS = 2.0
"""Standard errors by which a ratio must exceed 1 to count as slower."""


@dataclass(frozen=True)
class Plan:
    """Frames of each side: ``settle`` before all, ``frames`` timed as the program runs, ``staged`` with stop watches,
    in blocks of ``block``; of ``ring`` rendered ones.
    """

    settle: int = 200
    frames: int = 6000
    staged: int = 3000
    block: int = 100
    ring: int = 90


QUICK = Plan(settle=60, frames=1000, staged=600, block=50, ring=16)


@dataclass(frozen=True)
class Compared:
    """A figure of both revisions, µs, and ratios of the new over the old: of medians with its standard error from
    pairs of neighbouring blocks, and of 99th percentiles (NaN: a figure that has no distribution).
    """

    what: str
    before_us: float
    after_us: float
    ratio: float
    ratio_sigma: float
    ratio_p99: float

    @property
    def slower(self) -> bool:
        """By more than the blocks' scatter explains."""
        return self.ratio - _LEAST_SIGMAS * self.ratio_sigma > 1.0

    @property
    def cells(self) -> list[str]:
        times = ("–" if np.isnan(us) else f"{us:.1f}" for us in (self.before_us, self.after_us))
        ratio = "–" if np.isnan(self.ratio) else f"{self.ratio:.3f} ± {self.ratio_sigma:.3f}"
        high = "–" if np.isnan(self.ratio_p99) else f"{self.ratio_p99:.3f}"
        return [self.what, *times, ratio, high, "slower" if self.slower else ""]


def compared(what: str, before_us: NDArray[np.float64], after_us: NDArray[np.float64], block: int) -> Compared:
    """Of the times (n,) of both sides' frames; block k of one ran beside block k of the other."""
    blocks = [us.reshape(-1, block) for us in (before_us, after_us)]
    old, new = (np.median(each, axis=1) for each in blocks)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = new / old
        middle, high = (np.percentile(after_us, q) / np.percentile(before_us, q) for q in (50.0, 99.0))
        sigma = float(np.std(ratios, ddof=1) / len(ratios) ** 0.5) if len(ratios) > 1 else np.nan
    return Compared(what, float(np.median(before_us)), float(np.median(after_us)), float(middle), sigma, float(high))


def run(revision: str, quick: bool, report: Report) -> None:
    """Say the rows, those of the stages last.  Refused is a revision that git doesn't know."""
    plan = QUICK if quick else Plan()
    try:
        name, roots = commit_of(revision)[:10], (checkout_of(revision), machine.ROOT)
    except ValueError as error:
        raise kit.Refused(f"--against {error}") from None
    with tempfile.TemporaryDirectory(prefix="gripmon-bench-") as scratch:
        ring = Rings(Path(scratch)).of(Frames(count=plan.ring))
        timed = _alternating(roots, ring, plan.settle, plan.frames, plan.block, staged=False)
        staged = _alternating(roots, ring, plan.settle, plan.staged, plan.block, staged=True)
    rows = [
        _of(timed, "handed over -> published", "published_us", plan.block),
        _of(timed, "until the loop wants the next frame", "loop_us", plan.block),
        _of(timed, "processor time of a frame, mean of a block", "cpu_us", 1),
    ]
    for stage in dict.fromkeys(name for side in staged for name in side["stages_us"]):
        before, after = (np.array(side["stages_us"].get(stage, [np.nan] * plan.staged)) for side in staged)
        rows.append(compared(f"stage: {stage}", before, after, plan.block))
    about = {"before": name, "after": machine.commit(), "frames": plan.frames}
    report.values |= {**about, "seen": [{key: side[key] for key in ("measured", "valid")} for side in timed]}
    report.values["rows"] = rows
    seen = ", ".join(f"measured {side['measured']}, valid {side['valid']}" for side in timed)
    report.say(f"{name} → {machine.commit()}: {plan.frames} frames of each, {seen}")
    head = ("", "before: median, µs", "after", "ratio of medians", "ratio of 99 %", "")
    report.say(kit.table(head, [row.cells for row in rows]))
    first = rows[0]
    report.reach([(f"{first.what}: not slower", f"{first.ratio:.3f} ± {first.ratio_sigma:.3f}", not first.slower)])


def _of(sides: list[dict[str, Any]], what: str, key: str, block: int) -> Compared:
    before, after = (np.array(side[key]) for side in sides)
    return compared(what, before, after, block)


def _alternating(
    roots: tuple[Path, ...], ring: Path, settle: int, frames: int, block: int, *, staged: bool
) -> list[dict[str, Any]]:
    """What each root's process measured.  Blocks in the order A B, B A, A B …, so that a steady drift cancels."""
    with ExitStack() as opened:
        sides = []
        for root in roots:  # one after the other: nobody settles while another compiles
            sides.append(opened.enter_context(_side(root, [ring, settle, frames, block, int(staged)])))
            _until_ready(sides[-1])
        out: list[dict[str, Any]] = [{} for _ in roots]
        for number in range(frames // block):
            for k in range(len(sides))[:: 1 if number % 2 == 0 else -1]:
                _to(sides[k]).write("go\n")
                _to(sides[k]).flush()
                out[k] = _until_ready(sides[k])
    for root, measured in zip(roots, out, strict=True):
        if Path(measured["package"]) != root / "gripmon":
            raise RuntimeError(f"{root}: {measured['package']} was measured instead")
    return out


@contextmanager
def _side(root: Path, arguments: list[Any]) -> Iterator[subprocess.Popen[str]]:
    """A side's process, in which ``root`` has precedence over what is installed."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(root / "tools"), str(root)])}
    command = [sys.executable, str(_SIDE), *map(str, arguments)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=root
    )
    try:
        yield process
        process.wait(60.0)
    finally:
        process.kill()
        process.communicate()


def _until_ready(side: subprocess.Popen[str]) -> dict[str, Any]:
    """Waits until a side has finished its block; what it measured, if that was its last."""
    assert side.stdout is not None
    line = side.stdout.readline()
    if not line:
        raise RuntimeError(f"a side ended with {side.wait()}; what it said is above")
    return {} if line == "ready\n" else dict(json.loads(line))


def _to(side: subprocess.Popen[str]) -> IO[str]:
    assert side.stdin is not None
    return side.stdin
