"""Every parameter that takes an array says on its line which shape it has.

``points: Array,  # [N, 3] world, m``. The comment on a mapping says whose arrays it holds. What a
callable takes has no line of its own, and a function inside another one reads with it.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import chain
from pathlib import Path

from tests.statements import STATEMENTS, statements

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("aquaflow", "drivers", "sim_drivers")
ARRAYS = frozenset({"ndarray", "NDArray", "Tensor"})
MAPPINGS = frozenset({"Mapping", "dict"})
SHAPE = re.compile(r"# .*\[.*\]")
COMMENT = re.compile(r"# ")
FOR_TOOLS = re.compile(r"# (type: ignore|noqa).*")


@dataclass(frozen=True)
class Module:
    path: Path
    lines: list[str]
    tree: ast.Module

    @cached_property
    def imported(self) -> list[tuple[str, str, str]]:
        """Name here, module it comes from, name there."""
        return [
            (each.asname or each.name, node.module, each.name)
            for node in statements(self.tree)
            if isinstance(node, ast.ImportFrom) and node.module
            for each in node.names
        ]

    @cached_property
    def assigned(self) -> list[tuple[str, set[str]]]:
        """What may be an alias at the module's top, and the types that stand in it."""
        found = []
        for node in self.tree.body:
            match node:
                case (
                    ast.Assign(targets=[ast.Name(id=name)], value=value)
                    | ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value)
                ) if isinstance(value, ast.Subscript | ast.BinOp | ast.Name | ast.Attribute):
                    found.append((name, set(named_types(value))))
        return found


@cache
def modules() -> dict[str, Module]:
    found = {}
    for path in chain.from_iterable((ROOT / package).rglob("*.py") for package in PACKAGES):
        parts = path.relative_to(ROOT).with_suffix("").parts
        text = path.read_text(encoding="utf-8")
        parts = parts if parts[0] == "aquaflow" else ("aquaflow", *parts)  # linked into it
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = Module(path, text.splitlines(), ast.parse(text))
    return found


def named_types(annotation: ast.AST) -> Iterator[str]:
    """Every type in an annotation by its last name, but for what a callable takes and gives."""
    match annotation:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            yield name
        case ast.Subscript(value=ast.Name(id="Callable") | ast.Attribute(attr="Callable")):
            pass
        case _:
            for child in ast.iter_child_nodes(annotation):
                yield from named_types(child)


@cache
def aliases(types: frozenset[str]) -> dict[str, set[str]]:
    """By module: the names that stand for one of ``types``, or for something made of them."""
    known = {name: set(types) for name in modules()}
    size = 0
    while size < (size := sum(map(len, known.values()))):
        for name, module in modules().items():
            known[name] |= {
                here for here, source, there in module.imported if there in known.get(source, ())
            }
            known[name] |= {here for here, types_of in module.assigned if known[name] & types_of}
    return known


def functions(node: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Functions and methods, but not those inside of another function."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield child
        elif isinstance(child, STATEMENTS):
            yield from functions(child)


def parameters(module: Module, arrays: set[str]) -> Iterator[tuple[str, ast.arg, set[str]]]:
    """Those that take arrays: function, parameter, and the types that its annotation names."""
    for function in functions(module.tree):
        each = function.args
        several = [one for one in (each.vararg, each.kwarg) if one]
        for argument in [*each.posonlyargs, *each.args, *each.kwonlyargs, *several]:
            types = set(named_types(argument.annotation)) if argument.annotation else set()
            if types & arrays:
                yield function.name, argument, types


@cache
def looked_at() -> list[tuple[str, int, bool]]:
    """Every parameter that takes arrays, its line, and whether that says of which shape."""
    found = []
    for name, module in modules().items():
        mappings = aliases(MAPPINGS)[name]
        for function, argument, types in parameters(module, aliases(ARRAYS)[name]):
            comment = FOR_TOOLS.sub("", module.lines[argument.lineno - 1])
            wanted = COMMENT if types & mappings else SHAPE
            where = f"{module.path.relative_to(ROOT)} {function} {argument.arg}"
            found.append((where, argument.lineno, bool(wanted.search(comment))))
    return found


def test_every_array_parameter_says_its_shape() -> None:
    missing = [(where, line) for where, line, says in looked_at() if not says]
    assert missing == []


def test_each_has_a_line_of_its_own() -> None:
    lines = Counter((where.split()[0], line) for where, line, _ in looked_at())
    assert [(path, line) for (path, line), count in lines.items() if count > 1] == []


def test_aliases_of_arrays_are_looked_at_too() -> None:
    assert len(looked_at()) > 1000
