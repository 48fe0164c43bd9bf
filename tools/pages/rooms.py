"""The rooms of the package and who imports whom, read from the sources, and a drawing of them as SVG."""

from __future__ import annotations

import ast
from html import escape
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "gripmon"

_BOX = (150, 50)
_GAP = (30, 62)
_STAGGER = 45
_STYLE = (
    "text{font:14px sans-serif;fill:currentColor}.small{font-size:11px;opacity:.75}"
    "rect{fill:var(--md-default-bg-color,#fff);stroke:currentColor;stroke-width:1.5}path{fill:none;stroke:currentColor;stroke-width:1;opacity:.45}"
)


def imports() -> dict[str, set[str]]:
    """Each room (a folder of the package, or a module beside them) and the rooms that it imports, deferred ones too."""
    rooms = sorted({path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in PACKAGE.rglob("*.py")})
    rooms = [room for room in rooms if not room.startswith("__")]
    found: dict[str, set[str]] = {room: set() for room in rooms}
    for path in PACKAGE.rglob("*.py"):
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if room in found:
            found[room] |= {name for name in _imported(path) if name in found} - {room}
    return found


def _imported(path: Path) -> set[str]:
    modules: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            modules |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.split(".")[1] for name in modules if name.startswith("gripmon.")}


def floors(graph: dict[str, set[str]]) -> dict[str, int]:
    """How far above the ground a room stands: one more than the highest that it imports.  ValueError for a circle."""
    heights: dict[str, int] = {}
    while len(heights) < len(graph):
        ready = [room for room in graph if room not in heights and graph[room] <= heights.keys()]
        if not ready:
            raise ValueError(f"rooms import each other in a circle: {sorted(graph.keys() - heights.keys())}")
        heights |= {room: 1 + max((heights[below] for below in graph[room]), default=-1) for room in ready}
    return heights


def direct(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """Without the imports that a chain of others implies, so that a drawing can be read."""

    def reach(room: str) -> set[str]:
        return graph[room].union(*(reach(below) for below in graph[room]))

    return {
        room: {below for below in lower if not any(below in reach(other) for other in lower - {below})}
        for room, lower in graph.items()
    }


def size(room: str) -> int:
    """Lines of a room's sources."""
    folder = PACKAGE / room
    files = folder.rglob("*.py") if folder.is_dir() else [folder.with_suffix(".py")]
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)


def svg() -> str:
    """Rooms as boxes, the highest floor on top, with a line to each room that is imported directly."""
    graph = imports()
    heights = floors(graph)
    top = max(heights.values())
    widest = max(sum(height == floor for height in heights.values()) for floor in range(top + 1))
    width = widest * (_BOX[0] + _GAP[0]) + _GAP[0] + 2 * _STAGGER
    places: dict[str, tuple[float, float]] = {}
    for floor in range(top, -1, -1):
        # Below what imports it, so that lines are short; staggered, so that a line past a floor shows beside its boxes.
        above = {room: [places[user][0] for user in places if room in graph[user]] for room in graph}
        here = [room for room in graph if heights[room] == floor]
        here.sort(key=lambda room: (sum(above[room]) / max(1, len(above[room])), room))
        left = (width - len(here) * (_BOX[0] + _GAP[0]) + _GAP[0]) / 2 + _STAGGER * (-1) ** floor
        for index, room in enumerate(here):
            places[room] = (left + index * (_BOX[0] + _GAP[0]), (top - floor) * (_BOX[1] + _GAP[1]) + 10)
    parts = [_line(places[room], places[below]) for room, lower in direct(graph).items() for below in sorted(lower)]
    parts += [_box(room, *place) for room, place in places.items()]
    height = top * (_BOX[1] + _GAP[1]) + _BOX[1] + 20
    head = f'<svg viewBox="0 0 {width} {height}" width="100%" role="img" aria-label="Rooms and their imports">'
    return f"{head}<style>{_STYLE}</style>{''.join(parts)}</svg>"


def _line(upper: tuple[float, float], lower: tuple[float, float]) -> str:
    x0, y0 = upper[0] + _BOX[0] / 2, upper[1] + _BOX[1]
    x1, y1 = lower[0] + _BOX[0] / 2, lower[1]
    return f'<path d="M{x0:g} {y0:g}C{x0:g} {y0 + _GAP[1]:g} {x1:g} {y1 - _GAP[1]:g} {x1:g} {y1:g}"/>'


def _box(room: str, x: float, y: float) -> str:
    middle = x + _BOX[0] / 2
    return (
        f'<rect x="{x:g}" y="{y:g}" width="{_BOX[0]}" height="{_BOX[1]}" rx="6"/>'
        f'<text x="{middle:g}" y="{y + 22:g}" text-anchor="middle">{escape(room)}</text>'
        f'<text class="small" x="{middle:g}" y="{y + 39:g}" text-anchor="middle">{size(room):,} lines</text>'
    )


def table() -> str:
    """The rooms from the top down, each with the first sentence of its docstring."""
    heights = floors(imports())
    rows = ["| room | holds | lines |", "| --- | --- | --- |"]
    for room in sorted(heights, key=lambda name: (-heights[name], name)):
        path = PACKAGE / room / "__init__.py"
        path = path if path.exists() else (PACKAGE / room).with_suffix(".py")
        about = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n\n")[0]
        rows.append(f"| `gripmon/{room}` | {' '.join(about.split()).replace('``', '`')} | {size(room):,} |")
    return "\n".join(rows)
