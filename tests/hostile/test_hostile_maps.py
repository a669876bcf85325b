"""Maps that claim, unpack or nest more than a machine holds: refused before the memory is gone."""

from __future__ import annotations

import io
import json
import resource
import struct
import subprocess
import sys
import zipfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import Cli, refused

GIB = 1 << 30
ROOM_BYTES = 6 * GIB
"""Of addresses, for a command that reads a hostile map; torch alone maps three."""


def array_of(shape: int, data: bytes, kind: str = "|u1") -> bytes:
    """An ``.npy`` that claims ``shape`` numbers, whatever it holds."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape},), }}".encode()
    header += b" " * (117 - len(header)) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def facts_of(text: bytes) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.frombuffer(text, np.uint8))
    return stream.getvalue()


def claims_120_gb(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("facts.npy", array_of(30_000_000_000, b"\0" * 16, "<f4"))


@cache
def packed_8_gb() -> bytes:
    """Eight times the same GiB of zeros, compressed once: entries that share their bytes."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("facts.npy", "w", force_zip64=True) as stream:
            stream.write(array_of(GIB, b""))
            for _ in range(GIB >> 24):
                stream.write(bytes(1 << 24))
        (info,) = archive.infolist()
        for i in range(7):
            again = zipfile.ZipInfo(f"more{i}.npy")
            for name in ("CRC", "compress_size", "file_size", "header_offset", "compress_type"):
                setattr(again, name, getattr(info, name))
            archive.filelist.append(again)
            archive.NameToInfo[again.filename] = again
    return packed.getvalue()


def unpacks_to_8_gb(path: Path) -> None:
    path.write_bytes(packed_8_gb())


def has_a_million_cameras(path: Path) -> None:
    camera = {"width": 8, "height": 8, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 4.0}
    each = json.dumps(camera).encode()
    text = b'{"kind": "aquaflow map", "format": 1, "cameras": [' + b",".join([each] * 10**6) + b"]}"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("facts.npy", facts_of(text))


def has_deep_facts(path: Path) -> None:
    text = b'{"kind": "aquaflow map", "format": 1, "config": ' + b"[" * 100_000
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("facts.npy", facts_of(text))


def has_a_long_integer(path: Path) -> None:
    text = b'{"kind": "aquaflow map", "format": ' + b"9" * 5000 + b"}"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("facts.npy", facts_of(text))


def is_a_list(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("facts.npy", facts_of(b"[1, 2]"))


def is_encrypted(path: Path) -> None:
    is_a_list(path)
    content = bytearray(path.read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(mark) + offset] |= 1
    path.write_bytes(content)


def is_empty(path: Path) -> None:
    path.touch()


MAKERS = [
    claims_120_gb, unpacks_to_8_gb, has_a_million_cameras, has_deep_facts, has_a_long_integer,
    is_a_list, is_encrypted, is_empty,
]  # fmt: skip


@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)
def test_a_hostile_map_is_refused(command: Cli, tmp_path: Path, make: object) -> None:
    (tmp_path / "config.yaml").touch()
    assert callable(make)
    make(tmp_path / "map.aqf")
    ran = command("export", tmp_path, "--format", "restored")
    refused(ran, tmp_path / "map.aqf")
    assert not (tmp_path / "restored").exists()


def test_a_bomb_is_refused_before_it_takes_the_memory(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").touch()
    unpacks_to_8_gb(tmp_path / "map.aqf")
    command = [str(Path(sys.executable).with_name("aquaflow")), "export", str(tmp_path)]
    done = subprocess.run(
        [*command, "--format", "restored"],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (ROOM_BYTES, ROOM_BYTES)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "compressed" in done.stderr
