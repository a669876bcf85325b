"""Our modules as they are, but every call in a function goes through the watch."""

from __future__ import annotations

import ast
import builtins
import importlib.machinery
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
OWN = ("aquaflow",)

CALLED, OPERATED = "__watched_call__", "__watched_operator__"
"""Names that the rewritten code finds among the builtins."""

SEE_THEIR_CALLER = {"super", "locals", "globals", "vars", "dir", "eval", "exec"}
"""Builtins that mean the function which calls them; they are left alone."""


class _Rewriter(ast.NodeTransformer):
    """Module level is left alone: it runs before any dive."""

    def __init__(self, file: str) -> None:
        self._file, self._functions = file, list[str]()

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        return self._named(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        return self._named(node)

    def _named(self, node: Any) -> ast.AST:
        self._functions.append(node.name)
        node.body = [self.visit(statement) for statement in node.body]
        self._functions.pop()
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        by_name = node.func.id if isinstance(node.func, ast.Name) else ""
        if not self._functions or by_name in SEE_THEIR_CALLER:
            return node
        return self._through(CALLED, node, [node.func, *node.args], node.keywords)

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        if not self._functions:
            return node
        operator = ast.Constant(type(node.op).__name__)
        return self._through(OPERATED, node, [operator, node.left, node.right], [])

    def _through(
        self, name: str, node: ast.expr, arguments: list[ast.expr], keywords: list[ast.keyword]
    ) -> ast.AST:
        place = ast.Constant((self._file, ".".join(self._functions)))
        call = ast.Call(ast.Name(name, ast.Load()), [place, *arguments], keywords)
        return ast.copy_location(call, node)


class _Loader(importlib.machinery.SourceFileLoader):
    def get_code(self, fullname: str) -> CodeType:
        path = Path(self.get_filename(fullname))
        tree = ast.parse(path.read_bytes(), str(path))
        rewritten = _Rewriter(str(path.relative_to(ROOT))).visit(tree)
        return compile(ast.fix_missing_locations(rewritten), str(path), "exec")


class _Finder:
    @staticmethod
    def find_spec(
        fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname.partition(".")[0] not in OWN:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


def install(called: Callable[..., Any], operated: Callable[..., Any]) -> None:
    """From here on our modules are imported rewritten; none may have been imported before."""
    already = [name for name in sys.modules if name.partition(".")[0] in OWN]
    assert not already, f"imported before it could be rewritten: {already}"
    setattr(builtins, CALLED, called)
    setattr(builtins, OPERATED, operated)
    sys.meta_path.insert(0, _Finder)  # type: ignore[arg-type]
