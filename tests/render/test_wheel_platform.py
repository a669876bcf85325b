"""The tag of a wheel by the versions that its libraries ask of the C and the C++ library."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.render.native.wheel_platform import needed_glibc, platform_tag


def library(*versions: str) -> bytes:
    """The part of a shared library that counts: its table of strings."""
    return b"\x7fELF\0" + b"\0".join(version.encode() for version in ("memcpy", *versions)) + b"\0"


@pytest.mark.parametrize(
    ("versions", "glibc"),
    [
        (("GLIBC_2.2.5", "GLIBC_2.14"), 17),
        (("GLIBC_2.14", "GLIBC_2.34"), 34),
        (("GLIBC_2.17", "GLIBCXX_3.4"), 17),
        (("GLIBC_2.17", "GLIBCXX_3.4.21"), 24),
        (("GLIBC_2.34", "GLIBCXX_3.4.30"), 35),
        (("GLIBC_2.38", "GLIBCXX_3.4.29"), 38),
        (("GCC_3.0",), None),
    ],
)
def test_the_oldest_glibc_is_that_of_the_newest_symbol(
    versions: tuple[str, ...], glibc: int | None
) -> None:
    assert needed_glibc(library(*versions)) == glibc


def test_a_libstdcxx_that_no_tag_admits_is_refused() -> None:
    with pytest.raises(ValueError, match=r"GLIBCXX_3\.4\.99"):
        needed_glibc(library("GLIBC_2.17", "GLIBCXX_3.4.99"))


@pytest.mark.parametrize(
    ("libraries", "tag"),
    [
        ([("GLIBC_2.17",), ("GLIBC_2.28",)], "manylinux_2_28_aarch64"),
        ([("GLIBC_2.17",), ("GLIBC_2.17", "GLIBCXX_3.4.99")], "linux_aarch64"),
        ([("GLIBC_2.17",), ("GCC_3.0",)], "linux_aarch64"),
        ([], "linux_aarch64"),
    ],
)
def test_a_tag_covers_every_library_or_promises_nothing(
    tmp_path: Path, libraries: list[tuple[str, ...]], tag: str
) -> None:
    paths = [tmp_path / f"{number}.so" for number in range(len(libraries))]
    for path, versions in zip(paths, libraries, strict=True):
        path.write_bytes(library(*versions))
    assert platform_tag("aarch64", paths) == tag
