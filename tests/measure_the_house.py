"""How large the product is, and how often it breaks its own rules of size and words.

    python -m tests.measure_the_house [CHECKOUT]

Reads the sources only, so that any checkout can be counted, also one of before.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

OWN = ("aquaflow", "drivers", "sim_drivers")
LINKED = ("aquaflow/drivers", "aquaflow/sim_drivers")
SHELVES = ("survey", "live", "lab")
"""Folders of ``aquaflow`` that are not the core."""
CRUMB_LINES = 90
"""A module of at most so many lines, imported by one other, belongs into that one."""
PARTICIPLE = re.compile(r"^[a-z]{2,}ed$")
IRREGULAR = {
    *("said", "told", "found", "made", "kept", "held", "left", "sent", "met", "lost", "built"),
    *("begun", "drawn", "swum", "worn", "known", "shown", "taken", "chosen", "written", "seen"),
}
NO_PARTICIPLE = {"need", "feed", "seed", "speed", "exceed", "proceed", "embed", "bleed"}


@dataclass(frozen=True)
class Module:
    """One source file of the product."""

    name: str
    """Dotted, as it is imported."""
    path: Path
    lines: int
    tree: ast.Module

    @property
    def in_core(self) -> bool:
        """False for shelves, drivers and simulated devices."""
        parts = self.name.split(".")
        return parts[0] == "aquaflow" and not {*parts[1:2]} & {*SHELVES, "drivers", "sim_drivers"}

    @property
    def defined(self) -> Iterator[ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef]:
        """Every class and function, also nested ones."""
        kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        return (node for node in ast.walk(self.tree) if isinstance(node, kinds))


def modules_of(root: Path) -> list[Module]:
    """All modules of the product in a checkout."""
    found = []
    for top in OWN:
        for path in sorted((root / top).rglob("*.py")):
            relative = path.relative_to(root)
            if relative.as_posix().startswith(LINKED):
                continue
            parts = relative.with_suffix("").parts
            parts = parts if parts[0] == "aquaflow" else ("aquaflow", *parts)
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            text = path.read_text()
            found.append(Module(name, path, text.count("\n"), ast.parse(text)))
    return found


def crumbs_in(modules: list[Module]) -> list[str]:
    """Names of small modules with one importer."""
    importers: Counter[str] = Counter()
    names = {module.name for module in modules}
    for module in modules:
        imported = set()
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                imported |= {node.module} | {f"{node.module}.{each.name}" for each in node.names}
            elif isinstance(node, ast.Import):
                imported |= {each.name for each in node.names}
        importers.update((imported & names) - {module.name})
    return [
        module.name
        for module in modules
        if module.path.name != "__init__.py"
        and module.lines <= CRUMB_LINES
        and importers[module.name] == 1
    ]


def repeated_classes_in(modules: list[Module]) -> list[str]:
    """Names that more than one class has."""
    names = Counter(
        node.name for module in modules for node in module.defined if isinstance(node, ast.ClassDef)
    )
    return sorted(name for name, count in names.items() if count > 1)


def participles_in(modules: list[Module]) -> list[str]:
    """Functions, but no properties, that are named by a bare participle."""
    return sorted(
        f"{module.name}.{node.name}"
        for module in modules
        for node in module.defined
        if not isinstance(node, ast.ClassDef)
        and not any("property" in ast.unparse(each) for each in node.decorator_list)
        and _is_participle(node.name)
    )


def _is_participle(name: str) -> bool:
    bare = name.lstrip("_")
    if bare in NO_PARTICIPLE:
        return False
    return bare in IRREGULAR or PARTICIPLE.match(bare) is not None


def keys_of(root: Path) -> int:
    """Keys that a user's YAML file can set, without those of the lab and of tables of tables."""
    models: dict[str, dict[str, str]] = {}
    for path in sorted((root / "aquaflow/config").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef) and node.bases:
                models[node.name] = {
                    each.target.id: ast.unparse(each.annotation)
                    for each in node.body
                    if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
                }
    return _keys_below(models, {"Config", "VehicleConfig"} & set(models))


def _keys_below(models: dict[str, dict[str, str]], tables: set[str]) -> int:
    keys, seen = 0, set[str]()
    while tables:
        table = tables.pop()
        seen.add(table)
        for annotation in models[table].values():
            if annotation.startswith(("Lab[", "ClassVar")):
                continue
            below = set(models) & set(re.findall(r"\w+", annotation))
            tables |= below - seen
            keys += not below
    return keys


def words_in(paths: list[Path]) -> int:
    """Of Markdown pages."""
    return sum(len(path.read_text().split()) for path in paths if path.is_file())


def figures_of(root: Path) -> dict[str, int]:
    """Everything that is counted, by name."""
    modules = modules_of(root)
    core = [module for module in modules if module.in_core]
    defined = [node for module in modules for node in module.defined]
    classes = sum(isinstance(node, ast.ClassDef) for node in defined)
    return {
        "lines": sum(module.lines for module in modules),
        "files": len(modules),
        "lines of the core": sum(module.lines for module in core),
        "files of the core": len(core),
        "classes": classes,
        "functions": len(defined) - classes,
        "class names used twice": len(repeated_classes_in(modules)),
        "functions named by a participle": len(participles_in(modules)),
        "modules of at most 90 lines with one importer": len(crumbs_in(modules)),
        "configuration keys": keys_of(root),
        "words of docs/": words_in(sorted((root / "docs").rglob("*.md"))),
        "words of README": words_in([root / "README.md"]),
    }


def main() -> None:
    """Print the figures of a checkout, and with ``--names`` what breaks a rule."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    here = Path(__file__).resolve().parents[1]
    parser.add_argument("checkout", type=Path, nargs="?", default=here)
    parser.add_argument("--names", action="store_true", help="also what breaks a rule")
    asked = parser.parse_args()
    for name, figure in figures_of(asked.checkout).items():
        print(f"{figure:>8,} {name}")
    if asked.names:
        modules = modules_of(asked.checkout)
        for find in (crumbs_in, repeated_classes_in, participles_in):
            print(f"\n{find.__name__}:", *find(modules), sep="\n    ")


if __name__ == "__main__":
    main()
