"""What no run of a command may do."""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from .child import Ended, home_of, temporary_of

DOCUMENTED = {
    0: "done",
    1: "refused or failed",
    2: "usage",
    3: "a poor dive",
    130: "stopped by Ctrl-C",
}
OUR_MISTAKE = 70
"""Documented as well, and what is looked for."""
MOST_MEMORY_MB = 3000.0
IGNORED_INTERRUPT = re.compile(
    r"Exception ignored in.*?^KeyboardInterrupt:?\s*$", re.DOTALL | re.MULTILINE
)
"""What Python itself prints where Ctrl-C falls into a destructor, and nobody can prevent."""
NOTICES = ("The public MASt3R weights", "note: ")
"""Sentences that a command rightly says before it fails."""
SILENT_FAILURES = frozenset({"site check", "run status", "lab stress"})
"""Commands whose exit code 1 is an answer, which stands on stdout."""

FRAME = re.compile(r'File "[^"]*?(aquaflow/[^"]+)", line (\d+)')


@dataclass(frozen=True)
class Find:
    """Something that a run did and must not do."""

    oracle: str
    detail: str

    @property
    def signature(self) -> str:
        """Equal for finds that are probably one and the same."""
        frames = FRAME.findall(self.detail)
        last = re.sub(r"[\d'\"].*", "", self.detail.strip().splitlines()[-1])[:60]
        return f"{self.oracle}: {':'.join(frames[-1]) if frames else ''} {last}"


Contents = dict[str, str]


def contents(folder: Path) -> Contents:
    """Hashes of all files below ``folder``."""
    return {
        str(path.relative_to(folder)): _hash(path)
        for path in folder.rglob("*")
        if path.is_file() and not path.is_symlink()
    }


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def finds(
    command: str,
    argv: list[str],
    outputs: frozenset[str],
    folder: Path,
    before: Contents,
    ended: Ended,
) -> list[Find]:
    """Everything that was wrong with a run that began with ``before`` in ``folder``."""
    found = [*_how_it_ended(command, argv, folder, ended)]
    after = contents(folder)
    found += _left(folder, before, after)
    if not ended.hung:
        found += _changed(before, after, outputs)
        found += _half_written(folder, before, after)
    return found


def _how_it_ended(command: str, argv: list[str], folder: Path, ended: Ended) -> list[Find]:
    if ended.hung:
        return [Find("hang", _program_lines(ended.err) or "no output")]
    said = ended.err + ended.out
    if ended.interrupted:
        said = IGNORED_INTERRUPT.sub("", said)
    found = []
    if "Traceback (most recent" in said or "Exception ignored" in said:
        found.append(Find("traceback", said[-6000:]))
    elif ended.code == OUR_MISTAKE:
        found.append(Find("mistake", f"{said}\n{_kept_traceback(folder)}"))
    elif ended.code not in DOCUMENTED:
        found.append(Find("exit code", f"{said[-3000:]}\nended with {ended.code}"))
    elif ended.code == 130 and not ended.interrupted:
        found.append(Find("exit code", "130 without Ctrl-C"))
    elif ended.code == 1:
        found += _not_one_sentence(command, ended)
    elif ended.code == 0 and "--json" in argv:
        found += _not_json(ended.out)
    if ended.memory_mb > MOST_MEMORY_MB:
        found.append(Find("memory", f"{ended.memory_mb:.0f} MB"))
    if ended.orphans and not ended.interrupted:
        found.append(Find("orphans", "processes were left behind"))
    return found


def _kept_traceback(folder: Path) -> str:
    """What aquaflow/base/errors/crash_report.py writes for a mistake of our own."""
    kept = sorted(home_of(folder).rglob("aquaflow-mistake-*.txt"))
    return kept[0].read_text(errors="replace") if kept else ""


def _program_lines(err: str) -> str:
    """Where a process hung, without the fuzzer's own frames."""
    own = ("/tests/fuzz/", "/hypothesis/", "<frozen ", "Extension modules", "Fatal Python error")
    frames = (line for line in err.splitlines() if not any(each in line for each in own))
    # faulthandler has the innermost frame first, a traceback last: as in a traceback.
    return "\n".join(reversed([line for line in frames if line.strip()]))


def _not_one_sentence(command: str, ended: Ended) -> list[Find]:
    lines = [line for line in ended.err.splitlines() if not line.startswith(NOTICES)]
    if not lines and command in SILENT_FAILURES:
        return []
    if len(lines) == 1 and lines[0].startswith("aquaflow: "):
        return []
    return [Find("sentence", "\n".join(lines)[-3000:] or "failed without a word")]


def _not_json(out: str) -> list[Find]:
    try:
        json.loads(out, parse_constant=_no_json)
    except ValueError as error:
        return [Find("json", f"{out[:300]}\n{error}")]
    return []


def _no_json(constant: str) -> Any:
    raise ValueError(f"{constant} is no JSON")


def _left(folder: Path, before: Contents, after: Contents) -> list[Find]:
    parts = [name for name in after if name.endswith(".part") and name not in before]
    found = [Find("part", f"left behind: {name}") for name in parts]
    left = [path.name for path in temporary_of(folder).iterdir()]
    return found + [Find("temporary", f"left behind: {name}") for name in left]


def _changed(before: Contents, after: Contents, outputs: frozenset[str]) -> list[Find]:
    """Inputs stay as they are, unless they are also named as an output."""
    tops = {Path(output).parts[0] if Path(output).parts else "." for output in outputs}
    foreign = (name for name in before if Path(name).parts[0] not in tops and "." not in tops)
    return [
        Find("changed", f"an input was changed or removed: {name}")
        for name in foreign
        if after.get(name) != before[name]
    ]


def _half_written(folder: Path, before: Contents, after: Contents) -> list[Find]:
    found = []
    for name in after:
        reader = READERS.get(Path(name).suffix)
        if reader is None or before.get(name) == after[name]:
            continue
        try:
            reader(folder / name)
        except Exception as error:
            found.append(Find("half-written", f"{name}: {type(error).__name__} {error}"[:300]))
    return found


def _read_json(path: Path) -> None:
    json.loads(path.read_text(), parse_constant=_no_json)


def _read_yaml(path: Path) -> None:
    yaml.safe_load(path.read_text())


def _read_zip(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None


def _read_picture(path: Path) -> None:
    from PIL import Image

    with Image.open(path) as picture:
        picture.load()


READERS: dict[str, Callable[[Path], None]] = {
    ".json": _read_json,
    ".yaml": _read_yaml,
    ".npz": _read_zip,
    ".png": _read_picture,
}
