"""The floors of docs/architecture.md, compared with the imports of the package."""

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from paths import ROOT

PACKAGE = ROOT / "src" / "gscompleter"


def floors() -> dict[str, int]:
    """Read the floor of each package from the table in docs/architecture.md."""
    rows = re.findall(
        r"^\| (\d+) \| ([^|]+) \|", (ROOT / "docs" / "architecture.md").read_text(), re.M
    )
    return {room: int(floor) for floor, rooms in rows for room in re.findall(r"`(\w+)`", rooms)}


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_rooms(path: Path) -> Iterator[str]:
    """Return the rooms that a file imports from, anywhere in it."""
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


def list_imports() -> dict[str, set[str]]:
    """List, for every package, the others that its files import."""
    found: dict[str, set[str]] = {}
    for path in files():
        package = room_of(path)
        found.setdefault(package, set()).update(set(imported_rooms(path)) - {package})
    return found


def test_imports_point_down_or_stay_on_their_floor():
    floor = floors()
    upward = [
        f"{package} ({floor[package]}) imports {other} ({floor[other]})"
        for package, others in list_imports().items()
        for other in others
        if floor[other] > floor[package]
    ]
    assert upward == []


def test_no_circle_of_packages():
    graph = TopologicalSorter(list_imports())
    graph.prepare()  # raises CycleError, which names the circle


def orders_inside() -> dict[str, list[set[str]]]:
    """Read the order of the rooms inside some packages, from the bottom up."""
    text = (ROOT / "docs" / "architecture.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| (.+) \|$", text, re.M)
    return {
        package: [set(re.findall(r"`(\w+)`", group)) for group in groups.split(", then ")]
        for package, groups in rows
        if "all others" in groups
    }


def list_imports_inside(package: str) -> dict[str, set[str]]:
    """List, for every file and folder of a package, the others in it that it imports."""
    found: dict[str, set[str]] = {}
    for path in sorted((PACKAGE / package).rglob("*.py")):
        room = path.relative_to(PACKAGE / package).parts[0].removesuffix(".py")
        others = found.setdefault(room, set())
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gscompleter."):
                _, owner, *inner = node.module.split(".")
                if owner == package:
                    others.update(inner[:1] or [alias.name for alias in node.names])
        others.discard(room)
    return {room: others & set(found) for room, others in found.items() if room != "__init__"}


@pytest.mark.parametrize("package", sorted(orders_inside()))
def test_imports_inside_a_package_point_down_and_make_no_circle(package):
    order = orders_inside()[package]
    imports = list_imports_inside(package)
    named = set().union(*order)
    assert named <= set(imports)
    rank = {room: number for number, rooms in enumerate(order) for room in rooms or imports}
    rank |= {room: number for number, rooms in enumerate(order) for room in rooms}
    upward = [
        f"{room} imports {other}"
        for room, others in imports.items()
        for other in others
        if rank[other] > rank[room]
    ]
    assert upward == []
    TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle


@pytest.mark.parametrize(
    ("folder", "others"),
    [("inputs", ("commands", "completing", "report")), ("report", ("commands", "completing"))],
)
def test_inputs_and_reports_know_no_command(folder, others):
    names = tuple(f"gscompleter.apps.{other}" for other in others)
    imported = [
        node.module
        for path in sorted((PACKAGE / "apps" / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(names)
    ]
    assert imported == []


def test_the_package_itself_imports_no_application():
    assert "apps" not in set(imported_rooms(PACKAGE / "__init__.py"))


def test_no_circle_of_modules():
    modules = {
        ".".join(path.relative_to(ROOT / "src").with_suffix("").parts).removesuffix(".__init__")
        for path in files()
    }
    graph = TopologicalSorter()
    for path in files():
        own = ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                names = {f"{node.module}.{alias.name}" for alias in node.names} & modules
                graph.add(own.removesuffix(".__init__"), *(names or {node.module} & modules))
    graph.prepare()


def test_the_core_imports_no_learned_model():
    core = [
        path for path in files() if room_of(path) not in ("models", "evaluation", "apps", "cli")
    ]
    assert [path.name for path in core if "models" in imported_rooms(path)] == []


def test_sentences_of_the_library_name_no_option_of_the_command_line():
    rooms = [path for path in files() if room_of(path) not in ("cli", "apps")]
    found = [
        (path.name, text.value)
        for path in rooms
        for call in ast.walk(ast.parse(path.read_text()))
        if isinstance(call, ast.Call) and getattr(call.func, "id", "").endswith("Error")
        for text in ast.walk(call)
        if isinstance(text, ast.Constant) and re.search(r"(^|[^-])--[a-z]", str(text.value))
    ]
    assert found == []
