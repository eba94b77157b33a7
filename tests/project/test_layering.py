"""The floors of docs/architecture.md, compared with the imports of the package."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from paths import PACKAGE, ROOT
from sources import list_nodes, parse_package


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
    for node in list_nodes(path):
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


@cache
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
    table = text.split("| inside | from the bottom up |")[1].split("\n\n")[0]
    rows = re.findall(r"^\| `(\w+)` \| (.+) \|$", table, re.M)
    return {
        package: [set(re.findall(r"`(\w+)`", group)) for group in groups.split(", then ")]
        for package, groups in rows
    }


def list_imports_inside(package: str) -> dict[str, set[str]]:
    """List, for every file and folder of a package, the others in it that it imports."""
    found: dict[str, set[str]] = {}
    for path in sorted((PACKAGE / package).rglob("*.py")):
        room = path.relative_to(PACKAGE / package).parts[0].removesuffix(".py")
        others = found.setdefault(room, set())
        for node in list_nodes(path):
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
    # Each room has its floor, by its name or in a group that is called all others.
    assert set() in order or named == set(imports)
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


def test_no_application_knows_the_options_of_a_command():
    """A command makes a request of them; only the command line itself has options."""
    paths = [path for path in (PACKAGE / "apps").rglob("*.py") if path.parent.name != "commands"]
    known = [
        (path.name, name.id)
        for path in paths
        for name in list_nodes(path)
        if isinstance(name, ast.Name)
        and re.fullmatch(r"\w+Options", name.id)
        # Options of a generator are settings; those of a help page are a group of fields.
        and name.id not in ("GeneratorOptions", "PresetGeneratorOptions", "GroupedOptions")
    ]
    assert known == []


def test_a_request_needs_no_torch():
    """Commands import requests, and no help page waits for torch."""
    program = "import sys, pkgutil, importlib, gscompleter.apps.requests as requests\n"
    program += "for found in pkgutil.iter_modules(requests.__path__):\n"
    program += "    importlib.import_module(f'{requests.__name__}.{found.name}')\n"
    program += "print('torch' in sys.modules)\n"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr


def test_the_package_itself_imports_no_application():
    assert "apps" not in set(imported_rooms(PACKAGE / "__init__.py"))


def test_no_circle_of_modules():
    """In applications imports inside functions count, too: they hide a circle, and open none."""
    modules = {
        ".".join(path.relative_to(ROOT / "src").with_suffix("").parts).removesuffix(".__init__")
        for path in files()
    }
    graph = TopologicalSorter()
    for path in files():
        own = ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)
        is_application = room_of(path) in ("apps", "cli")
        for node in list_nodes(path) if is_application else parse_package()[path].body:
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
        for call in list_nodes(path)
        if isinstance(call, ast.Call) and getattr(call.func, "id", "").endswith("Error")
        for text in ast.walk(call)
        if isinstance(text, ast.Constant) and re.search(r"(^|[^-])--[a-z]", str(text.value))
    ]
    assert found == []
