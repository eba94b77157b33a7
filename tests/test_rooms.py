"""The rooms of docs/design.md, held against the imports of the package."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "gscompleter"


def floors() -> dict[str, int]:
    """The floor of each room, as the table in docs/design.md has it."""
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \|", (ROOT / "docs" / "design.md").read_text(), re.M)
    return {room: int(floor) for floor, rooms in rows for room in re.findall(r"`(\w+)`", rooms)}


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_rooms(path: Path) -> Iterator[str]:
    """The rooms that a file imports from, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "gscompleter":
            yield from (alias.name for alias in node.names if alias.name != "__version__")
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gscompleter."):
            yield node.module.split(".")[1]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
            yield from (n.split(".")[1] for n in names if n.startswith("gscompleter."))


def files() -> list[Path]:
    return [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]


def test_every_room_has_its_floor():
    assert set(floors()) == {room_of(path) for path in files()}


def test_a_room_knows_only_those_below_it():
    floor = floors()
    upward = [
        f"{path.relative_to(PACKAGE)} (floor {floor[room_of(path)]}) imports {room} ({floor[room]})"
        for path in files()
        for room in imported_rooms(path)
        if room != room_of(path) and floor[room] >= floor[room_of(path)]
    ]
    assert upward == []


def test_the_core_imports_no_particular_model():
    reconstructors = ("plane_sweep", "feed_forward", "depth_anything")
    models = (*reconstructors, "warp_inpaint", "diffusion", "oracle")
    core = [PACKAGE / "completer.py", *sorted((PACKAGE / "stages").glob("*.py"))]
    found = [(path.name, name) for path in core for name in models if name in path.read_text()]
    assert found == []


def test_sentences_of_the_library_name_no_option_of_the_command_line():
    rooms = [path for path in files() if room_of(path) not in ("cli", "commands")]
    found = [
        (path.name, text.value)
        for path in rooms
        for call in ast.walk(ast.parse(path.read_text()))
        if isinstance(call, ast.Call) and getattr(call.func, "id", "").endswith("Error")
        for text in ast.walk(call)
        if isinstance(text, ast.Constant) and re.search(r"(^|[^-])--[a-z]", str(text.value))
    ]
    assert found == []
