"""The registry of sources: who opens a path, and what the user hears when nobody does."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from aquaflow import sources
from aquaflow.base.errors import InputError
from aquaflow.sources import CameraSource, open_recording
from aquaflow.types import CameraModel, Dropped, Frame


class AnyFolder:
    """Recognises every folder."""

    specificity = 1

    def __init__(self, path: Path, fps: float | None) -> None:
        self.path, self.fps = path, fps
        self.camera: CameraModel | None = None
        self.frame_count: int | None = 0
        self.notes: list[str] = []

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.is_dir()

    @classmethod
    def open(cls, path: Path, fps: float | None = None) -> AnyFolder:
        return cls(path, fps)

    def name_of(self, index: int) -> str:
        return str(index)

    def frames(
        self, every: int = 1, start: int = 0, stop: int | None = None
    ) -> Iterator[Frame | Dropped]:
        yield from ()

    def close(self) -> None: ...


class FolderWithTruth(AnyFolder):
    """Recognises only folders with a truth file."""

    specificity = 5

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return (path / "truth.csv").exists()


class LiveCamera:
    """Opens devices, not paths: has no ``recognises``."""


def install(monkeypatch: pytest.MonkeyPatch, *classes: type) -> None:
    """Make ``classes`` the installed camera sources."""
    entries = []
    for cls in classes:
        monkeypatch.setitem(globals(), cls.__name__, cls)
        entries.append(EntryPoint(cls.__name__, f"{__name__}:{cls.__name__}", sources.CAMERAS))
    by_group = {sources.CAMERAS: entries}
    monkeypatch.setattr(sources, "entry_points", lambda *, group: by_group[group])


def test_nothing_at_the_path_is_said_before_anything_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(sources, "entry_points")
    with pytest.raises(InputError, match=r"there is nothing at .*gone; give a folder of images"):
        open_recording(tmp_path / "gone")


def test_a_path_that_nobody_reads_lists_who_is_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("hello")
    install(monkeypatch, FolderWithTruth, AnyFolder)
    with pytest.raises(InputError) as caught:
        open_recording(path)
    assert str(caught.value) == (
        f"no installed source reads {path}; installed sources are: AnyFolder, FolderWithTruth"
    )


def test_no_source_at_all_says_reinstall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch)
    with pytest.raises(InputError, match="none; reinstall aquaflow"):
        open_recording(tmp_path)


@pytest.mark.parametrize("order", [(AnyFolder, FolderWithTruth), (FolderWithTruth, AnyFolder)])
def test_the_most_specific_source_that_recognises_the_path_wins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: tuple[type, ...]
) -> None:
    install(monkeypatch, *order)
    assert type(open_recording(tmp_path)) is AnyFolder
    (tmp_path / "truth.csv").write_text("")
    assert type(open_recording(tmp_path)) is FolderWithTruth


def test_path_and_frame_rate_reach_the_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, AnyFolder)
    source = open_recording(tmp_path, fps=12.5)
    assert isinstance(source, AnyFolder)
    assert (source.path, source.fps) == (tmp_path, 12.5)
    assert isinstance(source, CameraSource)


def test_sources_that_open_no_paths_are_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, LiveCamera, AnyFolder)
    assert type(open_recording(tmp_path)) is AnyFolder
    install(monkeypatch, LiveCamera)
    with pytest.raises(InputError, match="installed sources are: LiveCamera"):
        open_recording(tmp_path)
