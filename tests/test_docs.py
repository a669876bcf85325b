"""The documentation names what is there: files, functions, settings, commands, pages."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

import aquaflow
from aquaflow.config.vehicle import VehicleConfig

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
NOTES = ROOT / "notes"
PAGES = sorted([*DOCS.glob("*.md"), *ROOT.glob("*.md"), ROOT / "deploy" / "README.md"])
FOLDERS = (
    "aquaflow",
    "drivers",
    "sim_drivers",
    "deploy",
    "tests",
    "docs",
    "notes",
    ".ci",
    ".github",
)
PACKAGES = ("aquaflow",)
SECTIONS = tuple(VehicleConfig.model_fields)

CODE = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
PAGE_REFERENCE = re.compile(r"((?:docs|notes)/[\w-]+\.md)(?:#([a-z0-9_-]+))?")
ENTRY_POINTS = re.compile(r'entry-points\."([\w.]+)"')
FILE_SUFFIXES = ("csv", "json", "jsonl", "yaml", "tum", "html", "png", "npz", "mp4")
MODULE_IN_PICTURE = re.compile(r'class="module"[^>]*>(\w+)<')
WITHOUT_CODE_BLOCKS = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)

ON_THE_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def code_in(page: Path) -> list[str]:
    """Everything between single backticks."""
    return CODE.findall(WITHOUT_CODE_BLOCKS.sub("", page.read_text(encoding="utf-8")))


def paths_in(page: Path) -> list[str]:
    """Paths from the repository's root, without options and patterns."""
    words = (word.partition("#")[0].strip(",;:") for text in code_in(page) for word in text.split())
    return [word for word in words if word.startswith(tuple(f"{name}/" for name in FOLDERS))]


def dotted_names_in(page: Path) -> list[str]:
    """Names such as ``aquaflow.slam.Slam.process``, without the groups of entry points."""
    groups = set(ENTRY_POINTS.findall((ROOT / "pyproject.toml").read_text(encoding="utf-8")))
    names = "|".join(PACKAGES)
    found = [text for text in code_in(page) if re.fullmatch(rf"({names})(\.\w+)+", text)]
    return [name for name in found if name not in groups]


def settings_in(page: Path) -> list[str]:
    """Keys of the configuration, such as ``mapping.loss.ssim``; a value may follow a colon."""
    keys = (text.split(":")[0] for text in code_in(page))
    sections = "|".join(SECTIONS)
    found = [key for key in keys if re.fullmatch(rf"({sections})(\.\w+)+", key)]
    return [key for key in found if key.rpartition(".")[2] not in FILE_SUFFIXES]


def module_file(name: str) -> Path | None:
    path = ROOT.joinpath(*name.split("."))
    found = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in found if file.is_file()), None)


@cache
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def names_of(node: ast.Module | ast.ClassDef) -> Iterator[tuple[str, ast.stmt]]:
    """What a module or class defines or imports, directly in its body."""
    for statement in node.body:
        if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield statement.name, statement
        elif isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            yield statement.target.id, statement
        elif isinstance(statement, ast.Assign):
            yield from ((t.id, statement) for t in statement.targets if isinstance(t, ast.Name))
        elif isinstance(statement, (ast.Import, ast.ImportFrom)):
            yield from ((alias.asname or alias.name, statement) for alias in statement.names)


def is_defined(name: str) -> bool:
    """True for a module, or something that a module or one of its classes defines."""
    if name.removeprefix("aquaflow.") in aquaflow.__all__:
        return True
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        file = module_file(".".join(parts[:length]))
        if file is None:
            continue
        node: Any = parsed(file)
        for i, part in enumerate(parts[length:], length):
            if isinstance(node, ast.ImportFrom):  # a package hands on what its module defines
                return is_defined(".".join([str(node.module), *parts[i - 1 :]]))
            if not isinstance(node, (ast.Module, ast.ClassDef)):
                return False
            found = dict(names_of(node))
            if part not in found:
                return False
            node = found[part]
        return True
    return (ROOT / Path(*parts)).is_dir()


def is_setting(key: str) -> bool:
    model: Any = VehicleConfig
    for part in key.split("."):
        if not (isinstance(model, type) and issubclass(model, BaseModel)):
            return False
        if part not in model.model_fields:
            return False
        model = model.model_fields[part].annotation
    return True


@cache
def anchors_of(page: str) -> frozenset[str]:
    """Explicit anchors of a page's headings, and those that mkdocs makes of the others."""
    found = set()
    for line in (ROOT / page).read_text(encoding="utf-8").splitlines():
        heading = re.fullmatch(r"#{1,6} (.*?)(?: \{#([\w-]+)\})?", line)
        if heading is not None:
            slug = re.sub(r"[^\w\s-]", "", heading[1]).strip().lower()
            found.add(heading[2] or re.sub(r"[-\s]+", "-", slug))
    return frozenset(found)


@ON_THE_PAGE
def test_every_file_that_a_page_names_exists(page: Path) -> None:
    made = (ROOT / ".gitignore").read_text(encoding="utf-8").split()  # not in a fresh checkout
    named = [path for path in paths_in(page) if path not in made]
    assert [path for path in named if not (ROOT / path).exists()] == []


@ON_THE_PAGE
def test_every_function_and_class_that_a_page_names_is_defined(page: Path) -> None:
    assert [name for name in dotted_names_in(page) if not is_defined(name)] == []


@ON_THE_PAGE
def test_every_setting_that_a_page_names_is_in_the_configuration(page: Path) -> None:
    assert [key for key in settings_in(page) if not is_setting(key)] == []


@ON_THE_PAGE
def test_every_file_that_a_page_links_to_exists(page: Path) -> None:
    targets = (link.partition("#")[0] for link in LINK.findall(page.read_text(encoding="utf-8")))
    local = [target for target in targets if target and "://" not in target]
    assert [target for target in local if not (page.parent / target).exists()] == []


def test_every_page_is_reached_from_the_first_one() -> None:
    linked = {link.partition("#")[0] for link in LINK.findall((DOCS / "index.md").read_text())}
    assert {page.name for page in DOCS.glob("*.md")} - linked == {"index.md"}


def test_every_page_and_anchor_that_code_and_pages_refer_to_exists() -> None:
    missing = []
    suffixes = (".py", ".h", ".cpp", ".yaml", ".sh", ".md")
    for folder in (*PACKAGES, "drivers", "sim_drivers", "tests", "deploy", "docs", "notes"):
        for file in (ROOT / folder).rglob("*"):
            if file.suffix not in suffixes or file == Path(__file__):
                continue
            for page, anchor in PAGE_REFERENCE.findall(file.read_text(encoding="utf-8")):
                known = (ROOT / page).is_file() and (not anchor or anchor in anchors_of(page))
                if not known:
                    missing.append(f"{file.relative_to(ROOT)}: {page}#{anchor}")
    assert missing == []


@pytest.mark.parametrize("note", sorted(NOTES.glob("*.md")), ids=lambda note: note.name)
def test_every_page_and_anchor_that_a_note_links_to_exists(note: Path) -> None:
    missing = []
    for link in LINK.findall(note.read_text(encoding="utf-8")):
        target, _, anchor = link.partition("#")
        page = (note.parent / target).resolve() if target else note
        if "://" in link or (page.is_file() and not anchor):
            continue
        if not page.is_file() or anchor not in anchors_of(str(page.relative_to(ROOT))):
            missing.append(link)
    assert missing == []


def test_the_picture_of_the_levels_shows_modules_that_exist() -> None:
    shown = MODULE_IN_PICTURE.findall((DOCS / "pictures" / "levels.svg").read_text())
    assert len(shown) > 20
    gone = [name for name in shown if not is_defined(f"aquaflow.{name}")]
    assert gone == []


def test_every_command_and_option_is_in_the_reference() -> None:
    import typer

    from aquaflow.cli import app

    reference = (DOCS / "commands.md").read_text(encoding="utf-8")
    sections = {text.partition(" {")[0]: text for text in re.split(r"\n##+ ", reference)[1:]}
    missing = []
    for path, command in leaves(typer.main.get_command(app)):
        shorter = (" ".join(path[:length]) for length in range(len(path), 0, -1))
        own = next((sections[name] for name in shorter if name in sections), "")
        for parameter in command.params:
            names = [*parameter.opts, *parameter.secondary_opts]
            options = [name for name in names if name.startswith("--") and name != "--help"]
            if options and not any(name in own for name in options):
                missing.append(f"{' '.join(path)} {options[0]}")
        if not own or " ".join(path) not in reference:
            missing.append(" ".join(path))
    assert missing == []


def test_every_command_that_a_page_or_a_sentence_names_is_there() -> None:
    from aquaflow.cli import COMMANDS

    files = [
        *PAGES,
        ROOT / "Makefile",
        *(ROOT / "deploy").rglob("*"),
        *(ROOT / "examples").glob("*.py"),
    ]
    files += [*(ROOT / "aquaflow").rglob("*.py"), *(ROOT / "aquaflow").rglob("*.html")]
    unknown = []
    for file in files:
        if file.is_file() and file.name != "CHANGELOG.md":
            text = file.read_text(encoding="utf-8", errors="replace")
            named = re.findall(r"(?:`|\bbin/|\(BIN\)/|<code>|')aquaflow ([a-z]+)", text)
            unknown += [
                f"{file.relative_to(ROOT)}: {name}" for name in named if name not in COMMANDS
            ]
    assert unknown == []


def leaves(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The commands that do something, with the words that call them."""
    children = getattr(command, "commands", None)
    if children is None:
        yield path, command
        return
    if hasattr(command, "default"):  # `aquaflow export DIVE` beside `aquaflow export video DIVE`
        yield path, command.default
    for name, child in children.items():
        yield from leaves(child, (*path, name))


@pytest.mark.parametrize(
    ("name", "defined"),
    [
        ("aquaflow.slam.Slam.process", True),
        ("aquaflow.slam", True),
        ("aquaflow.slam.Slam.no_such_method", False),
        ("aquaflow.slam.NoSuchClass", False),
        ("aquaflow.no_such_module", False),
    ],
)
def test_a_name_that_is_not_there_is_found_out(name: str, defined: bool) -> None:
    assert is_defined(name) is defined


@pytest.mark.parametrize(
    ("key", "known"),
    [("mapping.loss.ssim", True), ("mapping.loss.no_such", False), ("mapping.enabled.x", False)],
)
def test_a_setting_that_is_not_there_is_found_out(key: str, known: bool) -> None:
    assert is_setting(key) is known


# --- what users are told, who have no checkout ----------------------------------------------------

IN_THE_CHECKOUT = re.compile(r"\b(docs|tests|examples)/\w|\bnotes/\d|\b\w+/\w+\.py\b|README")


def messages(tree: ast.Module) -> Iterator[str]:
    """Texts of a module that are neither documentation nor descriptions of settings."""
    documentation = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr)
        or (isinstance(node, ast.keyword) and node.arg == "description")
    }
    for node in ast.walk(tree):
        is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if is_text and id(node) not in documentation:
            yield node.value


def test_no_message_sends_a_user_to_a_file_of_the_repository() -> None:
    cited = [
        f"{path.relative_to(ROOT)}: {text}"
        for path in sorted((ROOT / "aquaflow").rglob("*.py"))
        for text in messages(ast.parse(path.read_text(encoding="utf-8")))
        if IN_THE_CHECKOUT.search(text)
    ]
    assert not cited, "\n".join(cited)
