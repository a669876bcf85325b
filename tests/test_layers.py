"""Who may import whom (docs/architecture.md#levels): imports lead only to lower floors."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

FLOORS = (
    {"cli"},
    {"evaluation", "service", "doctor"},
    {"dive", "viewer"},
    {"slam", "export", "sim_drivers"},
    {"tracking", "mapping", "training", "recording", "drivers"},
    {"keyframes", "sources", "synthetic"},
    {"prior", "messages", "storage", "access"},
    {"config", "geometry", "render"},
    {"errors", "clocks", "profiler", "signals", "cores"},
)
"""Top floor first."""

HEIGHT = {family: -level for level, floor in enumerate(FLOORS) for family in floor}
OWN = ("aquaflow", "drivers", "sim_drivers")
MODULES = sorted(path for package in OWN for path in (ROOT / package).rglob("*.py"))


def dotted(path: Path) -> tuple[str, ...]:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def family(module: tuple[str, ...]) -> str:
    """The package or file right under ``aquaflow``, or the driver package."""
    return module[1] if module[0] == "aquaflow" and len(module) > 1 else module[0]


def imported(source: str, path: Path) -> set[tuple[str, ...]]:
    """Every module of ours that ``source`` imports, at its top or inside a function."""
    found: set[tuple[str, ...]] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {tuple(alias.name.split(".")) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base: tuple[str, ...] = ()
            if node.level:
                package = dotted(path.parent / "__init__.py")
                base = package[: len(package) - node.level + 1]
            base += tuple(node.module.split(".")) if node.module else ()
            # `from aquaflow import slam` imports a module, `from aquaflow.slam import Slam` a name.
            found |= {
                (*base, alias.name) if base == ("aquaflow",) else base for alias in node.names
            }
    return {
        ("aquaflow",) if module[:1] == ("aquaflow",) and is_name(module) else module
        for module in found
        if module[0] in OWN
    }


def is_name(module: tuple[str, ...]) -> bool:
    """True for ``aquaflow.__version__`` and the like: an attribute of the package."""
    return len(module) == 2 and module[1].startswith("__")


def violations(source: str, path: Path) -> list[str]:
    """Sentences about every import of ``source`` that this building does not allow."""
    mine = family(dotted(path))
    if mine not in HEIGHT:
        return [f"{mine} has no floor; add it to FLOORS in this test and to docs/architecture.md"]
    problems = []
    for module in sorted(imported(source, path)):
        theirs = family(module)
        if theirs == mine:
            continue
        if theirs not in HEIGHT:
            problems.append(f"{mine} imports {'.'.join(module)}, which has no floor")
        elif theirs in {"drivers", "sim_drivers"} and mine not in {"cli", "sim_drivers"}:
            problems.append(f"{mine} imports {'.'.join(module)}; only cli may import drivers")
        elif HEIGHT[theirs] >= HEIGHT[mine]:
            problems.append(f"{mine} imports {'.'.join(module)}, which is not on a floor below it")
    return problems


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_imports_only_from_floors_below_its_own(path: Path) -> None:
    assert violations(path.read_text(), path) == []


def test_every_module_is_looked_at() -> None:
    assert {"aquaflow/slam.py", "aquaflow/tracking/tracker.py", "sim_drivers/images.py"} <= {
        str(path.relative_to(ROOT)) for path in MODULES
    }


@pytest.mark.parametrize(
    ("path", "source", "problem"),
    [
        (
            "aquaflow/errors/__init__.py",
            "from aquaflow.config import Config",
            "not on a floor below",
        ),
        ("aquaflow/tracking/x.py", "import aquaflow.mapping.mapper", "not on a floor below"),
        ("aquaflow/slam.py", "def f():\n    from aquaflow import export", "not on a floor below"),
        ("aquaflow/geometry/x.py", "from ..prior import flow", "not on a floor below"),
        ("aquaflow/dive/replay.py", "from drivers.can import Bus", "only cli may import drivers"),
        ("drivers/x.py", "import sim_drivers.video", "only cli may import drivers"),
        ("sim_drivers/x.py", "import aquaflow.slam", "not on a floor below"),
        ("aquaflow/novelty.py", "", "novelty has no floor"),
        ("aquaflow/slam.py", "import aquaflow.novelty", "aquaflow.novelty, which has no floor"),
    ],
)
def test_an_import_from_above_or_the_side_is_found(path: str, source: str, problem: str) -> None:
    [found] = violations(source, ROOT / path)
    assert problem in found


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("aquaflow/cli/__init__.py", "import drivers.can, sim_drivers.video"),
        ("sim_drivers/x.py", "import drivers.can"),
        ("aquaflow/tracking/tracker.py", "from . import solver\nfrom .bundle import adjust"),
        ("aquaflow/keyframes.py", "from aquaflow.prior.contract import Encoding"),
        ("aquaflow/errors/__init__.py", "from aquaflow import __version__\nimport numpy, re"),
    ],
)
def test_imports_from_below_or_from_the_same_family_are_allowed(path: str, source: str) -> None:
    assert violations(source, ROOT / path) == []
