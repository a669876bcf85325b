"""The commands that are killed, what each leaves behind, and how it is judged."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from aquaflow.base.storage.dive_status import CHECKPOINT, FRAMES, DiveState, read_status
from aquaflow.base.storage.dive_status import NAME as STATUS
from aquaflow.base.storage.whole_folder import MARK, WORK
from aquaflow.survey.site.merged_file import read_merged
from tests.command_line import Ran, run_aquaflow
from tests.lab.batch.seasons import contents, season
from tests.live.killed_dives import CONFIG
from tests.small_recording import HASTY
from tests.survey.site.site_dives import Scene, stated_dive

OF_A_DIVE = ("*.ply", "*.aqf", "*.tum", "trajectory.csv", "medium.json", "places.npz", "frames.csv")
"""Files of a dive that are the same in every run; the others hold times."""
EXPORTS = ("colmap", "nerfstudio", "restored", "ortho", "dem", "obj", "glb", "laz", "spz", "mcap")
RESTORED = ("colmap", "nerfstudio")
"""Formats that draw their pictures here, for want of a recording."""
SPEED = "8"
"""Of the recording in ``run``."""

Files = TypeVar("Files")


class WrongError(AssertionError):
    """What passed as finished, or came out differently."""


@dataclass
class Case:
    """One command, ready to be run and killed."""

    words: tuple[object, ...]
    out: Path
    """Changes in it count as moments."""
    check: Callable[[], str]
    """After a kill: what was found, in a word; raises WrongError."""
    again: Callable[[], None]
    """The same once more, to its end; raises WrongError."""


def digests(folder: Path, patterns: Iterable[str] = ("*",)) -> dict[str, str]:
    """SHA-256 of the files, by their paths."""
    found = (path for pattern in patterns for path in folder.rglob(pattern) if path.is_file())
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(found)
    }


def differing(found: Mapping[str, object], expected: Mapping[str, object]) -> list[str]:
    """The names of files that are not the same in both."""
    names = found.keys() | expected.keys()
    return sorted(name for name in names if found.get(name) != expected.get(name))


def require(holds: bool, what: str) -> None:
    """Raise WrongError, unless it holds."""
    if not holds:
        raise WrongError(what)


def to_its_end(*words: object) -> Ran:
    """Run a command that must not fail."""
    ran = run_aquaflow(*words)
    require(ran.code in (0, 3), f"{words[0]} failed: {ran.code} {ran.err}")
    return ran


def refused(*words: object) -> None:
    """A reader of a dive that is not finished says so."""
    ran = run_aquaflow(*words)
    lines = ran.err.splitlines()
    require(ran.code == 1 and len(lines) == 1, f"{words}: {ran.code} {ran.out} {ran.err}")
    said = ("is not finished", "holds no finished dive", "has no places.npz")
    require(any(each in lines[0] for each in said), f"{words} said: {lines[0]}")


READERS: tuple[Callable[[Path, Path], tuple[object, ...]], ...] = (
    lambda dive, out: ("export", dive, "--format", "spz", "--out", out / "x.spz"),
    lambda dive, out: ("export", "video", dive, "--kind", "fly-through", "--out", out / "x.mp4"),
    lambda dive, out: ("export", "report", dive, "--pdf", out / "x.pdf"),
    lambda dive, _: ("lab", "evaluate", dive),
    lambda dive, _: ("measure", dive, "--notes"),
    lambda dive, out: ("change", "--from", dive, "--to", dive, "--out", out / "change"),
    lambda dive, out: ("site", "add", out / "site", dive),
)
"""Commands that read a dive."""


def not_finished(dive: Path, number: int, out: Path) -> str:
    """One of the readers refuses what is left of a dive; in a word."""
    if not any((dive / name).exists() for name in (STATUS, FRAMES)):
        return "not begun"
    refused(*READERS[number % len(READERS)](dive, out))
    return "not finished"


def exported(dive: Path, out: Path) -> None:
    """A finished live dive gives a file, or had too few frames for a map: it takes the newest."""
    ran = run_aquaflow("export", dive, "--format", "spz", "--out", out / "x.spz")
    said = ("could be mapped", "map.aqf is missing")
    require(ran.code == 0 or any(each in ran.err for each in said), f"export: {ran.err}")


class Bench:
    """The inputs, made once in ``folder``, and the files of undisturbed runs."""

    def __init__(self, folder: Path, recording: Path) -> None:
        self.folder, self.recording, self.count = folder, recording, 0
        self.dive = folder / "dive"
        to_its_end("map", recording, "--out", self.dive, *HASTY)
        self._finished: dict[str, Any] = {}
        (folder / "vehicle.yaml").write_text(CONFIG.replace("every_s: 1.0", "every_s: 0.05"))

    def fresh(self) -> Path:
        """A folder of its own for one case."""
        self.count += 1
        folder = self.folder / f"case-{self.count}"
        folder.mkdir()
        return folder

    def reference(self, name: str, make: Callable[[], Files]) -> Files:
        """The files of the undisturbed run ``name``."""
        if name not in self._finished:
            self._finished[name] = make()
        files: Files = self._finished[name]
        return files

    # --- map -----------------------------------------------------------------------------------

    def map(self, number: int) -> Case:
        """Of every second case, the folder holds a finished dive already."""
        folder = self.fresh()
        dive, reference = folder / "dive", digests(self.dive, OF_A_DIVE)
        words = ("map", self.recording, "--out", dive, "--overwrite", *HASTY)
        if number % 2:
            shutil.copytree(self.dive, dive)

        def check() -> str:
            status = read_status(dive)
            if status is not None and status.state is DiveState.FINISHED:
                require(digests(dive, OF_A_DIVE) == reference, "a finished dive with other bytes")
                return "finished"
            return not_finished(dive, number, folder)

        def again() -> None:
            to_its_end(*words)
            require(digests(dive, OF_A_DIVE) == reference, "mapped again, other bytes")

        return Case(words, dive, check, again)

    # --- run -----------------------------------------------------------------------------------

    def run(self, number: int) -> Case:
        """A live dive; from one checkpoint, ``dive finish`` makes the same bytes each time."""
        folder = self.fresh()
        dive, config = folder / "dive", self.folder / "vehicle.yaml"
        words = (
            "run", "--source", self.recording, "--config", config, "--out", dive, "--speed", SPEED,
        )  # fmt: skip

        def check() -> str:
            status = read_status(dive)
            if status is not None and status.state.is_complete:
                exported(dive, folder)
                return "finished"
            return not_finished(dive, number, folder)

        def again() -> None:
            if not any((dive / CHECKPOINT).glob("*.npz")):
                status = read_status(dive)
                if status is not None and status.state.is_complete:  # the kill came too late
                    ran = run_aquaflow(*words)
                    require(ran.code == 1 and "already holds a dive" in ran.err, ran.err)
                else:
                    to_its_end(*words)
                return
            ends = [folder / name for name in ("dive", "other")]
            shutil.copytree(*ends)
            for end in ends:
                to_its_end("run", "finish", end)
            one, other = (digests(end, OF_A_DIVE) for end in ends)
            require(one == other, f"finished twice: {differing(one, other)}")
            exported(dive, folder)

        return Case(words, dive, check, again)

    # --- site merge ----------------------------------------------------------------------------

    def site_merge(self, number: int) -> Case:
        """Of every second case, the site was merged with fewer dives before."""
        folder = self.fresh()
        site, scene = folder / "site", Scene(0)
        dives = [
            stated_dive(folder / name, scene, start, seed=k)
            for k, (name, start) in enumerate((("a", 0.0), ("b", 0.5), ("c", 1.0)))
        ]
        if number % 2:
            to_its_end("site", "add", site, *dives[:2])
            to_its_end("site", "merge", site)
        to_its_end("site", "add", site, *dives)
        words, merged = ("site", "merge", site), ("merged.*", "*.tum")

        def whole() -> dict[str, str]:
            other = self.fresh() / "site"
            shutil.copytree(folder, other.parent, dirs_exist_ok=True)
            to_its_end("site", "merge", other)
            return digests(other, merged)

        reference = self.reference("site merge", whole)
        before = digests(site, merged)

        def check() -> str:
            found = digests(site, merged)
            if found == before and before:
                return "as before"
            if read_merged(site) is None:
                ran = run_aquaflow("site", "map", site)
                require(ran.code == 1 and "never merged" in ran.err, f"site map: {ran.err}")
                return "not finished"
            require(found == reference, f"a merge with other bytes: {differing(found, reference)}")
            return "finished"

        def again() -> None:
            to_its_end(*words)
            require(digests(site, merged) == reference, "merged again, other bytes")

        return Case(words, site, check, again)

    # --- export --------------------------------------------------------------------------------

    def export(self, number: int) -> Case:
        """Each format in turn; later an export of other settings is there already."""
        folder, kind = self.fresh(), EXPORTS[number % len(EXPORTS)]
        target = folder / "out" / f"x.{kind}"
        target.parent.mkdir()
        options: tuple[str, ...] = ("--restored",) if kind in RESTORED else ()
        if kind in ("ortho", "dem", "obj", "glb"):
            options = ("--resolution", "0.3")
        words = ("export", self.dive, "--format", kind, *options, "--out", target)

        def whole() -> dict[str, str]:
            other = self.fresh() / "out"
            to_its_end(*words[:-1], other / target.name)
            return digests(other)

        reference = self.reference(kind, whole)
        if number >= len(EXPORTS):
            _make_older(target, reference)
        before = digests(target.parent)

        def check() -> str:
            found = {n: d for n, d in digests(target.parent).items() if not n.startswith(".")}
            if found == before:
                return "as before"
            if any(Path(name).name == MARK for name in found):
                return "marked"
            main = target.name
            if main in reference and main not in found:  # one file with others beside it
                return "not finished"
            whole_now = {n: d for n, d in found.items() if n in reference}
            require(whole_now == reference, f"{kind}: neither whole nor as before: {found}")
            return "finished"

        def again() -> None:
            to_its_end(*words)
            found = {n: d for n, d in digests(target.parent).items() if n in reference}
            require(found == reference, f"{kind} again, other bytes")
            left = [*target.parent.glob(f".*{WORK}"), *target.parent.rglob(MARK)]
            require(not left, f"{kind} left {left}")

        return Case(words, target.parent, check, again)

    # --- batch ---------------------------------------------------------------------------------

    def batch(self, number: int) -> Case:
        """Two recordings, side by side."""
        del number
        folder = self.fresh()
        recordings = season(folder / "recordings", self.recording, dives=2)
        site = folder / "site"
        words = ("lab", "batch", recordings, "--out", site, *HASTY, "--jobs", "2")

        def dives(of: Path = site) -> dict[str, bytes]:
            return {name: text for name, text in contents(of).items() if not name.startswith(".")}

        def whole() -> dict[str, bytes]:
            other = self.fresh() / "site"
            to_its_end("lab", "batch", recordings, "--out", other, *words[5:])
            return dives(other)

        reference = self.reference("batch", whole)

        def check() -> str:
            found = dives()
            names = {Path(name).parts[0] for name in found}
            complete = {n: text for n, text in reference.items() if Path(n).parts[0] in names}
            require(found == complete, "a dive that is not whole, or has other bytes")
            return f"with {len(names)} dives"

        def again() -> None:
            to_its_end(*words)
            require(dives() == reference, "batched again, other bytes")
            left = list((site / "dives").glob(f".*{WORK}"))
            require(not left, f"batch left {left}")

        return Case(words, site, check, again)


def _make_older(target: Path, reference: dict[str, str]) -> None:
    """What an export of other settings would have left: the same files with other content."""
    for name in reference:
        file = target.parent / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"older")
