"""Statements of a program. Imports, functions and classes are statements: whoever looks for them
needs no look at every expression, which takes `ast.walk` ten times as long."""

from __future__ import annotations

import ast
from collections.abc import Iterator

STATEMENTS = (ast.stmt, ast.excepthandler, ast.match_case)


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Every statement below ``node``: at its top, in a class, in a function, in a branch."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, STATEMENTS):
            yield child
            yield from statements(child)
