"""Imports point downward only: the floors of the design, read from the source with ``ast``."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from support.long_files import LONGEST

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "gripmon"

FLOORS = {
    "model": 0,
    "track": 1, "belief": 1,
    "judge": 2,
    "monitor": 3, "simulate": 3, "calibrate": 3,
    "laser": 4,
    "io": 5, "record": 5,
    "client": 6, "teach": 6, "analyse": 6,
    "daemon": 7,
    "cli": 8, "__main__": 9,
}  # fmt: skip
FOREIGN = {
    "zenoh": {"io", "client"},
    "rerun": {"record", "analyse"},
    "rosbags": {"io"},
    "rclpy": {"io"},
    "prometheus_client": {"io"},
}
HEAVY = (
    "numpy",
    "scipy",
    "cv2",
    "zenoh",
    "rerun",
    "yaml",
    "msgspec",
    "tqdm",
    "rosbags",
    "rclpy",
    "rich",
    "pyarrow",
    "plotly",
    "jinja2",
    "shtab",
    "trimesh",
    "fsspec",
    "mcap",
    "av",
    "ray",
)


def room_of(path: Path) -> str:
    """``gripmon/track/edges/robust_fit.py`` -> ``track``; the package's own ``__init__`` -> ``gripmon``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return "gripmon" if parts == ("__init__",) else parts[0]


def imported_modules(source: str, package: str = "gripmon") -> list[str]:
    """Full names of everything that a file imports, wherever in the file (deferred imports count too)."""
    names: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            prefix = node.module or ""
            if node.level:
                base = package.split(".")[: len(package.split(".")) - node.level + 1]
                prefix = ".".join([*base, prefix]) if prefix else ".".join(base)
            names += [f"{prefix}.{alias.name}" for alias in node.names]
    return names


def faults_of(room: str, modules: list[str]) -> list[str]:
    """What a room's imports break, in words."""
    faults = []
    for module in modules:
        top, _, rest = module.partition(".")
        if top in FOREIGN and room not in FOREIGN[top]:
            faults.append(f"{room} imports {top}; only {sorted(FOREIGN[top])} may")
        other = rest.split(".")[0]
        if top != "gripmon" or other in ("", "__version__", room):
            continue
        if other not in FLOORS:
            faults.append(f"{room} imports gripmon.{other}, which is in no floor")
        elif FLOORS[other] > FLOORS[room]:
            faults.append(f"{room} (floor {FLOORS[room]}) imports {other} (floor {FLOORS[other]}) above it")
        elif FLOORS[other] == FLOORS[room]:
            faults.append(f"{room} and {other} are on one floor; they don't know each other")
    return faults


def test_every_import_points_downward():
    faults = []
    for path in sorted(PACKAGE.rglob("*.py")):
        room = room_of(path)
        if room == "gripmon":
            continue
        package = ".".join(path.relative_to(ROOT).parent.parts)
        assert room in FLOORS, f"{path}: give the room a floor"
        faults += [
            f"{path.relative_to(ROOT)}: {fault}"
            for fault in faults_of(room, imported_modules(path.read_text(), package))
        ]
    assert not faults, "\n".join(faults)


def circles_of(imports: dict[str, set[str]]) -> list[list[str]]:
    """Modules that reach each other by their imports, in groups."""

    def reached(start: str) -> set[str]:
        found, todo = set(), [start]
        while todo:
            new = imports.get(todo.pop(), set()) - found
            found |= new
            todo += new
        return found

    reach = {module: reached(module) for module in imports}
    groups = {frozenset(other for other in reach[module] if module in reach.get(other, ())) for module in imports}
    return sorted(sorted(group) for group in groups if group)


def test_no_modules_import_each_other_in_a_circle():
    """Deferred imports and those for type checkers count: a circle of them can't be read from either end, either.

    Left out is ``gripmon`` itself, which names what it offers (test_the_package_itself_imports_no_room) and is imported
    for its ``__version__``; and that whatever imports a package's module runs the package's ``__init__`` first.
    """
    paths = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in PACKAGE.rglob("*.py")}
    paths = {name.removesuffix(".__init__"): path for name, path in paths.items()}
    del paths["gripmon"]
    imports = {
        name: {
            module if module in paths else module.rpartition(".")[0]
            for module in imported_modules(path.read_text(), ".".join(path.relative_to(ROOT).parent.parts))
        }
        & set(paths)
        for name, path in paths.items()
    }
    assert sum(map(len, imports.values())) > len(imports), "imports were found"
    assert circles_of(imports) == []


def test_the_package_itself_imports_no_room():
    """It only says where its names are; see tests/test_api.py."""
    body = ast.parse((PACKAGE / "__init__.py").read_text()).body
    at_once = [node for node in body if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")]
    modules = imported_modules("\n".join(map(ast.unparse, at_once)))
    assert not [name for name in modules if name.startswith("gripmon")]
    assert imported_modules((PACKAGE / "__init__.py").read_text()) != modules, "what is left out is there"


@pytest.mark.parametrize(
    ("room", "source", "expected"),
    [
        ("track", "from gripmon.model.records import Array", 0),
        ("model", "from gripmon import monitor", 1),
        ("track", "import gripmon.judge.policy", 1),
        ("track", "def f():\n    from gripmon.daemon import run", 1),
        ("monitor", "import zenoh", 1),
        ("io", "import zenoh", 0),
        ("daemon", "import rerun as rr", 1),
        ("record", "from rerun import log", 0),
        ("record", "from gripmon.io.wire import Keys", 1),
        ("track", "from .judge import x", 1),
        ("cli", "from gripmon import __version__", 0),
        ("judge", "from gripmon.nowhere import x", 1),
    ],
)
def test_the_rules_catch_what_they_should(room: str, source: str, expected: int):
    assert len(faults_of(room, imported_modules(source))) == expected


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["demo", "--help"], ["replay", "--help"], []])
def test_help_imports_nothing_heavy(arguments: list[str]):
    code = (
        "import sys\nfrom gripmon.cli import main\n"
        f"try:\n    main({arguments!r})\nexcept SystemExit:\n    pass\n"
        f"print('LOADED', sorted(set({HEAVY!r}) & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert "LOADED []" in done.stderr
    assert "gripmon" in done.stdout


def test_help_imports_no_command():
    """Modules are counted, since times vary: 0.05 s of processor time; 0.11 s when it imported every command's."""
    code = (
        "import sys, argparse; before = set(sys.modules)\nfrom gripmon.cli import main\nmain([])\n"
        "print(*sorted(set(sys.modules) - before), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    loaded = set(done.stderr.split())
    ours = {name for name in loaded if name.partition(".")[0] == "gripmon"}
    assert ours == {"gripmon", "gripmon.cli", "gripmon.model", "gripmon.model.errors", "gripmon.model.stopping"}
    assert len(loaded) <= 30, loaded


@pytest.mark.parametrize(
    ("module", "needless"),
    [
        (
            "gripmon.daemon.starting",
            ("rerun", "pyarrow", "scipy.interpolate", "scipy.ndimage", "scipy.optimize", "scipy.spatial"),
        ),
        ("gripmon.record.written_file", ("numba", "scipy", "zenoh", "gripmon.track", "gripmon.judge")),
        ("gripmon.record.files", ("rerun", "pyarrow", "scipy", "zenoh")),
    ],
)
def test_processes_of_a_monitor_start_without_what_others_need(module: str, needless: tuple[str, ...]):
    """Half a second of each start of the monitor, as much of its recorder's."""
    code = f"import sys, {module}; print(sorted(set({needless!r}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_package_list_matches_the_tree():
    """``packages`` in pyproject.toml is written by hand; a forgotten one would be missing from the wheel."""
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {".".join(p.parent.relative_to(ROOT).parts) for p in PACKAGE.rglob("*.py")}
    assert listed - {"gripmon.configs"} == found


def test_files_that_are_begun_first_are_there():
    """A name that was left behind by a renamed file would do nothing, and no one would notice."""
    assert [name for name in LONGEST if not (ROOT / "tests" / f"{name}.py").exists()] == []
