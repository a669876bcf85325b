"""Who may import whom: a folder imports only from floors below its own, and nothing in a circle."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.statements import statements

ROOT = Path(__file__).resolve().parents[1]

FLOORS = (
    {"__main__", "cli", "api"},
    {"survey", "live", "lab", "sim_drivers"},
    {
        *("slam", "dive", "recordings", "doctor", "calibration", "web"),
        *("tracking", "telemetry", "mapping", "water", "render", "prior", "keyframes"),
        *("sources", "drivers"),
    },
    {"base", "config", "geometry", "optimise", "types"},
)
"""Top floor first: commands, the three shelves and the simulated devices, the core, its base."""

SHELVES = {"survey", "live", "lab"}
"""None of them knows another; they meet in the core, or through entry points."""
APART = (({"tracking"}, {"mapping", "water"}),)
"""Folders of the core that do not know each other; ``slam`` connects them."""
USERS_OF_DRIVERS = {"cli", "sim_drivers", "recordings"}
"""Logs on disk hold the bytes that devices sent, and are decoded as those are."""

LOOSE_MODULES = {"slam", "types"}
"""Modules right under ``aquaflow``; everything else lies in a folder."""
PYTHONS = {"__init__", "__main__"}
"""What Python itself looks for there."""

HEIGHT = {family: -level for level, floor in enumerate(FLOORS) for family in floor}
OWN = ("aquaflow", "drivers", "sim_drivers")
LINKED = ("drivers", "sim_drivers")
"""At the repository's top, and linked into ``aquaflow``, under which they are imported."""
PACKAGE = ("aquaflow",)
"""The package's own ``__init__``: it holds the version, which every floor may read."""
Module = tuple[str, ...]
Graph = dict[Module, set[Module]]


def dotted(path: Path) -> Module:
    parts = path.relative_to(ROOT).with_suffix("").parts
    if parts[0] in LINKED:
        parts = ("aquaflow", *parts)
    return parts[:-1] if parts[-1] == "__init__" else parts


FILES = {dotted(path): path for package in OWN for path in sorted((ROOT / package).rglob("*.py"))}
TESTS = sorted((ROOT / "tests").rglob("*.py"))


def family(module: Module) -> str:
    """The folder or module right under ``aquaflow``."""
    return module[1] if module[0] == "aquaflow" and len(module) > 1 else module[0]


def imported(source: str, path: Path) -> set[Module]:
    """Every module of ours that ``source`` imports, at its top or inside a function."""
    found: set[Module] = set()
    for node in statements(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {tuple(alias.name.split(".")) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base: Module = ()
            if node.level:
                package = dotted(path.parent / "__init__.py")
                base = package[: len(package) - node.level + 1]
            base += tuple(node.module.split(".")) if node.module else ()
            for alias in node.names:
                # `from aquaflow import slam` imports a module, `from slam import Slam` a name.
                whole = (*base, alias.name)
                is_module = whole in FILES or (base == PACKAGE and not alias.name.startswith("__"))
                found.add(whole if is_module else base)
    return {module for module in found if module[0] in OWN}


@cache
def imported_by(path: Path) -> set[Module]:
    """Every module of ours that a file imports; each file is parsed once."""
    return imported(path.read_text(), path)


def violations(imports: set[Module], path: Path) -> list[str]:
    """Sentences about every one of a module's ``imports`` that the floors do not allow."""
    mine = family(dotted(path))
    if dotted(path) == PACKAGE:
        return []
    if mine not in HEIGHT:
        return [f"{mine} has no floor; add it to FLOORS in this test"]
    problems = []
    for module in sorted(imports):
        theirs = family(module)
        if theirs == mine or module == PACKAGE:
            continue
        if theirs not in HEIGHT:
            problems.append(f"{mine} imports {'.'.join(module)}, which has no floor")
        elif (problem := refused(mine, theirs)) is not None:
            problems.append(f"{mine} imports {'.'.join(module)}; {problem}")
    return problems


def refused(mine: str, theirs: str) -> str | None:
    """Why ``mine`` may not import ``theirs``; None where it may."""
    if HEIGHT[theirs] > HEIGHT[mine]:
        return "that is on a floor above"
    if theirs in LINKED and mine not in USERS_OF_DRIVERS:
        return f"only {', '.join(sorted(USERS_OF_DRIVERS))} may import drivers"
    if mine == "drivers" and HEIGHT[theirs] == HEIGHT[mine] and theirs != "sources":
        return "drivers know nothing of the core but its sources"
    if theirs in SHELVES and mine in SHELVES:
        return "no shelf knows another"
    if any((mine in a and theirs in b) or (mine in b and theirs in a) for a, b in APART):
        return "slam connects them, neither knows the other"
    return None


def cycle(graph: Graph) -> list[str]:
    """The names around one circle of imports; empty where there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return [".".join(module) for module in error.args[1]]
    return []


def folded(graph: Graph, folder: Module) -> Graph:
    """Imports between what lies right in ``folder``, each subfolder taken as one."""
    depth = len(folder)
    between: Graph = {}
    for module, others in graph.items():
        if module[:depth] == folder:
            mine = module[: depth + 1]
            inside = {other[: depth + 1] for other in others if other[:depth] == folder}
            between.setdefault(mine, set()).update(inside - {mine})
    return between


def imported_tests(source: str) -> list[str]:
    """Test modules and conftest files that ``source`` imports."""
    names: list[Iterable[str]] = []
    for node in statements(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = (node.module or "").split(".")
            names += [(*base, alias.name) if base[0] == "tests" else base for alias in node.names]
    return [
        ".".join(parts)
        for parts in names
        if any(part == "conftest" or part.startswith("test_") for part in parts)
    ]


def graph_of_files() -> Graph:
    return {
        module: {other for other in imported_by(path) if other in FILES} - {module, PACKAGE}
        for module, path in FILES.items()
        if module != PACKAGE
    }


def test_a_module_imports_only_from_floors_below_its_own() -> None:
    found = {path: violations(imported_by(path), path) for path in FILES.values()}
    assert {path: problems for path, problems in found.items() if problems} == {}


def test_every_module_is_looked_at() -> None:
    assert {
        ("aquaflow", "slam"),
        ("aquaflow", "tracking", "tracker"),
        ("aquaflow", "sim_drivers", "oak"),
    } <= set(FILES)


@pytest.mark.parametrize("package", LINKED)
def test_drivers_are_imported_from_the_repositorys_top_by_way_of_the_package(package: str) -> None:
    assert (ROOT / "aquaflow" / package).samefile(ROOT / package)


def test_no_module_imports_itself_by_way_of_others() -> None:
    assert cycle(graph_of_files()) == []


def test_no_folder_imports_itself_by_way_of_its_neighbours() -> None:
    graph = graph_of_files()
    folders = {module[:length] for module in graph for length in range(1, len(module))}
    assert {folder: found for folder in folders if (found := cycle(folded(graph, folder)))} == {}


def test_a_program_begins_below_everything_that_it_calls() -> None:
    early = [
        ".".join(module)
        for module, path in FILES.items()
        if "__name__" in (source := path.read_text())
        for statement in ast.parse(source).body[:-1]
        if isinstance(statement, ast.If) and "__name__" in ast.unparse(statement.test)
    ]
    assert early == []


def test_every_folder_stands_on_one_of_four_floors() -> None:
    families = {family(module) for module in graph_of_files()}
    assert families == {name for floor in FLOORS for name in floor}
    assert len(FLOORS) == 4
    assert {path.stem for path in (ROOT / "aquaflow").glob("*.py")} - PYTHONS == LOOSE_MODULES


def test_no_test_imports_another_test() -> None:
    found = {path: imported_tests(path.read_text()) for path in TESTS}
    assert {path: names for path, names in found.items() if names} == {}


@pytest.mark.parametrize(
    ("path", "source", "problem"),
    [
        ("aquaflow/base/worker.py", "from aquaflow.slam import Slam", "on a floor above"),
        ("aquaflow/tracking/x.py", "import aquaflow.mapping.mapper", "slam connects them"),
        ("aquaflow/water/x.py", "import aquaflow.tracking.tracker", "slam connects them"),
        ("aquaflow/slam.py", "def f():\n    from aquaflow import survey", "on a floor above"),
        ("aquaflow/geometry/x.py", "from ..prior import flow", "on a floor above"),
        ("aquaflow/survey/x.py", "import aquaflow.live.loop", "no shelf knows another"),
        ("aquaflow/dive/replay.py", "from aquaflow.drivers.can import Bus", "may import drivers"),
        ("drivers/x.py", "import aquaflow.recordings.video", "nothing of the core but"),
        ("drivers/x.py", "import aquaflow.sim_drivers.oak", "on a floor above"),
        ("aquaflow/novelty.py", "", "novelty has no floor"),
        ("aquaflow/slam.py", "import aquaflow.novelty", "aquaflow.novelty, which has no floor"),
    ],
)
def test_an_import_from_above_or_the_side_is_found(path: str, source: str, problem: str) -> None:
    [found] = violations(imported(source, ROOT / path), ROOT / path)
    assert problem in found


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("aquaflow/cli/__init__.py", "import aquaflow.drivers.can, aquaflow.sim_drivers.oak"),
        ("sim_drivers/x.py", "import aquaflow.drivers.can"),
        ("aquaflow/recordings/x.py", "import aquaflow.drivers.can"),
        ("aquaflow/tracking/tracker.py", "from . import frames\nfrom .frames import Tracked"),
        ("aquaflow/keyframes/store.py", "from aquaflow.prior.contract import Encoding"),
        ("aquaflow/base/worker.py", "from aquaflow import __version__\nimport numpy, re"),
    ],
)
def test_imports_from_below_or_from_the_same_family_are_allowed(path: str, source: str) -> None:
    assert violations(imported(source, ROOT / path), ROOT / path) == []


def test_a_circle_is_found_between_modules_and_between_folders() -> None:
    a, b, c = ("x", "one", "a"), ("x", "two", "b"), ("x", "one", "c")
    in_folders = {a: {b}, b: {c}, c: set[Module]()}
    assert cycle(in_folders) == []
    assert set(cycle(folded(in_folders, ("x",)))) == {"x.one", "x.two"}
    assert set(cycle({a: {b}, b: {a}})) == {"x.one.a", "x.two.b"}


@pytest.mark.parametrize(
    "source",
    [
        "from tests.mapping.test_x import Scene",
        "from tests.render import test_x",
        "import tests.conftest",
        "from conftest import Cli",
    ],
)
def test_an_import_of_a_test_is_found(source: str) -> None:
    assert len(imported_tests(source)) == 1
