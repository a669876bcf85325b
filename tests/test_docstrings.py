"""Public methods say what they do, unless the protocol or base class that asks for them does.

ruff looks at modules, classes and functions (D100 to D106); it cannot know which methods fulfil a
documented protocol.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

from tests.statements import statements

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("aquaflow", "drivers", "sim_drivers")
FRAMEWORK = {
    *("forward", "do_GET", "do_POST", "emit"),  # torch, http.server, logging
    *("readable", "seekable"),  # io
    "get_next",  # onnxruntime
}
"""Methods that a library asks for; its documentation says what they do."""


@cache
def classes() -> list[tuple[Path, ast.ClassDef]]:
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            found += [(path, node) for node in statements(tree) if isinstance(node, ast.ClassDef)]
    return found


def methods(node: ast.ClassDef) -> list[ast.FunctionDef]:
    """Public methods and properties, without setters and pydantic's validators."""
    return [
        item
        for item in node.body
        if isinstance(item, ast.FunctionDef)
        and not item.name.startswith("_")
        and not any(ast.unparse(each).endswith(".setter") for each in item.decorator_list)
    ]


def base_names(node: ast.ClassDef) -> set[str]:
    return {ast.unparse(base).split("[")[0].rpartition(".")[2] for base in node.bases}


def documented_elsewhere(found: list[tuple[Path, ast.ClassDef]]) -> set[str]:
    """Methods that a protocol, or a class that others derive from, documents."""
    bases = {name for _, node in found for name in base_names(node)}
    return {
        item.name
        for _, node in found
        if "Protocol" in base_names(node) or node.name in bases
        for item in methods(node)
        if ast.get_docstring(item)
    }


def test_every_public_method_is_documented() -> None:
    found = classes()
    known = documented_elsewhere(found) | FRAMEWORK
    missing = [
        f"{path.relative_to(ROOT)}:{item.lineno} {node.name}.{item.name}"
        for path, node in found
        if not node.name.startswith("_")
        for item in methods(node)
        if not ast.get_docstring(item) and item.name not in known
    ]
    assert missing == []


def test_enough_is_looked_at_for_the_rule_to_mean_something() -> None:
    assert sum(len(methods(node)) for _, node in classes()) > 500
