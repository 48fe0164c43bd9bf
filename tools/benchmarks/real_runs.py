"""Replays a real gripper's stills, untaught and taught in two halves: what ``tools/bench real`` judges.

It uses only what gripmon offers to notebooks and says in its files, so that the same code replays with the gripmon of
another revision: ``python -P -m benchmarks.real_runs NAME=LIMIT_M,LIMIT_RAD=FOLDER…`` with that one's path in front.
"""

from __future__ import annotations

import csv
import importlib.util
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import msgspec
import yaml

import gripmon
from gripmon.model.geometry import from_record, perturb, to_record
from gripmon.model.images import image_paths
from gripmon.model.records import Frame, FrameRecord, Protection, Verdict

CONFIG = "config.yaml"
BELIEF = "belief"
"""In a bound's place: the motion since the reference by the belief beside the rules."""
_STAMPS = "timestamps.csv"
_EVERY = slice(None)
_HALVES = {"even": (slice(0, None, 2), slice(1, None, 2)), "odd": (slice(1, None, 2), slice(0, None, 2))}
"""Taught from (its name): the stills taught from, those judged."""


class Limit(NamedTuple):
    """Alert limit of position and rotation."""

    position_m: float
    rotation_rad: float


class _Model(NamedTuple):
    path: Path
    left_out: int


class Still(msgspec.Struct, frozen=True):
    """What was decided about one image: pose (m; x, y, z, w) and covariance (36,) where it was measured, bounds (m,
    rad) where there are any; ``alerts``: kinds that were raised.
    """

    name: str
    measured: bool
    valid: bool
    translation_m: tuple[float, float, float] | None
    rotation_xyzw: tuple[float, float, float, float] | None
    covariance: tuple[float, ...] | None
    bound_m: float | None
    bound_rad: float | None
    hypothesis: str
    reason: str | None
    alerts: tuple[str, ...]


class Part(msgspec.Struct, frozen=True):
    """Stills that were replayed in one run, the first ``uncounted`` of them to begin with; ``proposed_m``,
    ``proposed_rad``: the limits that ``check`` proposes from the images that it has.  ``taught``: the half that was
    taught from, without those ``left_out``; ``refused``: why nothing could be, and nothing was replayed.
    """

    names: tuple[str, ...]
    uncounted: int
    taught: str | None = None
    left_out: int = 0
    refused: str | None = None
    stills: tuple[Still, ...] = ()
    proposed_m: float | None = None
    proposed_rad: float | None = None


class Run(msgspec.Struct, frozen=True):
    """All stills of a folder once, at fixed limits; ``bound``: the one that ``valid`` was decided by."""

    name: str
    taught: bool
    bound: str
    limit_m: float
    limit_rad: float
    reference_m: tuple[float, float, float]
    reference_xyzw: tuple[float, float, float, float]
    parts: tuple[Part, ...]


def bound_names() -> tuple[str, ...]:
    """The bounds that ``valid`` can be decided by, in this gripmon."""
    from gripmon.judge.policy import PolicySettings

    if "valid_by" not in PolicySettings.__struct_fields__:
        return ("absolute",)
    return ("reference", "absolute", *([BELIEF] if importlib.util.find_spec("gripmon.monitor.shadow") else []))


def bound_of(record: FrameRecord) -> Protection | None:
    """The bound that the record's verdict goes by; None without a transform measured in it.  By the motion since the
    reference that is also so before a frame proves where the gripper is: the transform is only the reference then.
    """
    by_reference = getattr(record, "valid_by", "absolute") == "reference"  # records of one bound don't say
    return None if not record.measured or (by_reference and record.since_reference is None) else record.protection


def proposed_by_check(config: gripmon.Config, images: Path) -> tuple[float | None, float | None]:
    """Alert limits (m, rad) that ``gripmon check`` proposes from a folder of images; in a gripmon that can't, the
    bounds that it forecasts, which it proposes where the configured ones are below.  None where there are none.
    """
    try:
        from gripmon.daemon.promised import images_of, kept_of
    except ImportError:
        bound = gripmon.forecast(config).protection
        return (None, None) if bound is None else (bound.position_m, bound.rotation_rad)
    given = images_of(config, images)
    assert given is not None
    return kept_of(config, given).proposed or (None, None)


def runs_of(name: str, folder: Path, limit: Limit) -> Iterator[Run]:
    """Untaught, and taught in halves, by each bound.  Raises :class:`~gripmon.InputError` for a folder that can't be
    used.

    The first still of each half is replayed, but not counted: a single frame is never confirmed.  The same stills are
    left out untaught.
    """
    with TemporaryDirectory(prefix="gripmon-real-") as place:
        project = _Project(folder, Path(place), limit)
        for bound in bound_names():
            # Untaught, check has a half of what is judged: with all of them it would propose what they need.
            yield _run(name, project, bound, (project.replayed(bound, _EVERY, _HALVES["even"][0], len(_HALVES)),))
            yield _run(name, project, bound, tuple(project.taught(bound, half) for half in _HALVES))


def _run(name: str, project: _Project, bound: str, parts: tuple[Part, ...]) -> Run:
    pose, (limit_m, limit_rad) = project.config(bound).reference.cam_T_grip, project.limit
    taught = parts[0].taught is not None
    return Run(name, taught, bound, limit_m, limit_rad, pose.translation_m, pose.rotation_xyzw, parts)


class _Project:
    """A folder with stills as a user's project, with its own configurations beside the same files."""

    def __init__(self, folder: Path, place: Path, limit: Limit) -> None:
        self.limit = limit
        self._images, self._place = image_paths([folder]), place
        self._openings = _openings(folder / _STAMPS)
        self._values = yaml.safe_load((folder / CONFIG).read_text())
        self._values.pop("taught", None)
        self._apart_s = 1.0 / self._values["source"].get("fps", 1.0)
        self._models: dict[str, _Model | str] = {}  # or why there is none, by half
        for path in folder.iterdir():
            if path not in self._images and path.name not in (CONFIG, _STAMPS):
                (place / path.name).symlink_to(path.resolve())

    def config(self, bound: str, taught: Path | None = None) -> gripmon.Config:
        """The folder's configuration with the fixed limits."""
        monitor = self._values.get("monitor") or {}
        policy = {**(monitor.get("policy") or {}), "alert_limit_m": self.limit.position_m}
        policy["alert_limit_rad"] = self.limit.rotation_rad
        if len(bound_names()) > 1:
            policy["valid_by"] = "reference" if bound == BELIEF else bound
        values: dict[str, Any] = {**self._values, "monitor": {**monitor, "policy": policy}}
        if taught is not None:
            values["taught"] = taught.name
        path = self._place / CONFIG
        path.write_text(yaml.safe_dump(values))
        return gripmon.load_config(path, check_source=False)

    def replayed(self, bound: str, judged: slice, promised: slice, uncounted: int, taught: Path | None = None) -> Part:
        """The stills one after another; ``promised``: those that ``check`` has."""
        images, config = self._images[judged], self.config(bound, taught)
        with gripmon.open_source(self._stills(images), fps=1.0 / self._apart_s) as source:
            judged_by = _believed if bound == BELIEF else _decided
            stills = tuple(judged_by(source, config))
        proposed_m = proposed_rad = None
        if bound != BELIEF:
            proposed_m, proposed_rad = proposed_by_check(config, self._stills(self._images[promised]))
        names = tuple(path.name for path in images)
        return Part(names, uncounted, stills=stills, proposed_m=proposed_m, proposed_rad=proposed_rad)

    def taught(self, bound: str, half: str) -> Part:
        """The other half, with what one half taught."""
        learnt_from, judged = _HALVES[half]
        model = self._models[half] = self._models.get(half) or self._teach(half, learnt_from)
        if isinstance(model, str):
            return Part(tuple(path.name for path in self._images[judged]), 1, half, refused=model)
        part = self.replayed(bound, judged, learnt_from, 1, model.path)
        return msgspec.structs.replace(part, taught=half, left_out=model.left_out)

    def _teach(self, half: str, learnt_from: slice) -> _Model | str:
        folder = self._stills(self._images[learnt_from])
        try:
            teaching = gripmon.teach_edges(self.config(bound_names()[-1]), [folder])
        except gripmon.NoResultError as refused:
            return str(refused).replace(f"{folder}/", "")  # files by their names
        path = self._place / f"taught_{half}.yaml"
        path.write_text(teaching.text())
        return _Model(path, len(teaching.taught.left_out))

    def _stills(self, images: Sequence[Path]) -> Path:
        """A folder with these images alone."""
        place = Path(self._place, f"stills_{images[0].stem}_{len(images)}")
        if not place.exists():
            place.mkdir()
            for path in images:
                (place / path.name).symlink_to(path.resolve())
            if self._openings:
                rows = [(p.name, round(1e9 * self._apart_s * i), self._openings[p.name]) for i, p in enumerate(images)]
                with (place / _STAMPS).open("w", newline="") as table:
                    csv.writer(table).writerows([("file", "stamp_ns", "jaw_opening_m"), *rows])
        return place


def _openings(table: Path) -> dict[str, str]:
    """Jaw openings (m) by file; none without a table of them."""
    if not table.is_file():
        return {}
    with table.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    return {row["file"]: row["jaw_opening_m"] for row in rows if row.get("jaw_opening_m")}


def _still(record: FrameRecord) -> Still:
    bound = bound_of(record)
    pose = None if bound is None else record.cam_T_grip
    return Still(
        record.name,
        bound is not None,
        record.verdict is Verdict.VALID,
        None if pose is None else pose.translation_m,
        None if pose is None else pose.rotation_xyzw,
        None if pose is None else record.covariance,
        None if bound is None else bound.position_m,
        None if bound is None else bound.rotation_rad,
        "" if bound is None else bound.hypothesis,
        record.reason,
        tuple(alert.kind.value for alert in record.alerts if alert.event.value == "raised"),
    )


def _decided(source: Iterable[Frame], config: gripmon.Config) -> Iterator[Still]:
    """Stills by the rules."""
    return map(_still, gripmon.replay(source, config))


def _believed(source: Iterable[Frame], config: gripmon.Config) -> Iterator[Still]:
    """Stills by the belief."""
    monitor, policy = gripmon.Monitor(config, shadow=True), config.settings.monitor.policy
    shadow = monitor.shadow
    assert shadow is not None
    for frame in source:
        record, believed = monitor.process(frame), shadow.newest
        if believed is None or not believed.known:
            yield Still(record.name, False, False, None, None, None, None, None, "", record.reason, ())
            continue
        bound = believed.bound
        pose = to_record(perturb(from_record(monitor.reference.cam_T_grip), believed.motion))
        valid = bound.within(policy.alert_limit_m, policy.alert_limit_rad)
        yield Still(
            record.name, True, valid, pose.translation_m, pose.rotation_xyzw, tuple(shadow.covariance.ravel().tolist()),
            bound.position_m, bound.rotation_rad, "", None, (),
        )  # fmt: skip


def main(arguments: Sequence[str]) -> None:
    """One run a line, as JSON."""
    for argument in arguments:
        name, limits, folder = argument.split("=", 2)
        for run in runs_of(name, Path(folder), Limit(*map(float, limits.split(",")))):
            print(msgspec.json.encode(run).decode(), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
