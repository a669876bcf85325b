"""Meshes as binary glTF files with their texture inside.

Format: Khronos, "glTF 2.0 Specification" (ISO/IEC 12113), with KHR_materials_unlit, as the scene's
light is in the colours. y is up there, and z to the viewer: x, y, z here become x, z, -y.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow import __version__
from aquaflow.base.storage.atomic import atomic_write
from aquaflow.dive.png import encoded_png
from aquaflow.survey.export.mesh.placed_mesh import PlacedMesh, Texture
from aquaflow.survey.export.spz import RIGHT_UP_BACK

MAGIC, VERSION = b"glTF", 2
JSON_CHUNK, BINARY_CHUNK = b"JSON", b"BIN\0"
FLOAT, UNSIGNED_INT = 5126, 5125
VERTICES, INDICES = 34962, 34963
"""What a part of the buffer is for."""
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071
"""How a texture is sampled."""
ALIGNMENT = 4
"""Bytes to a multiple of which every part is filled up."""


def write_glb(path: Path, mesh: PlacedMesh, texture: Texture) -> None:
    """Write the mesh, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    layout = texture.layout
    parts = [
        _float32(mesh.positions[layout.source] @ RIGHT_UP_BACK.T),
        _float32(mesh.normals[layout.source] @ RIGHT_UP_BACK.T),
        _float32(layout.uv()),
        np.ascontiguousarray(layout.faces, "<u4"),
    ]
    data = [*(part.tobytes() for part in parts), encoded_png(texture.picture)]
    described = json.dumps(_describe(mesh, parts, data), separators=(",", ":"), allow_nan=False)
    text = _fill(described.encode(), b" ")
    sizes = [len(_fill(each, b"\0")) for each in data]
    whole = 12 + 8 + len(text) + 8 + sum(sizes)
    with atomic_write(path) as stream:
        stream.write(struct.pack("<4sII", MAGIC, VERSION, whole))
        stream.write(struct.pack("<I4s", len(text), JSON_CHUNK) + text)
        stream.write(struct.pack("<I4s", sum(sizes), BINARY_CHUNK))
        for each in data:
            stream.write(_fill(each, b"\0"))


def _float32(
    values: npt.NDArray[np.floating],  # [N, C]
) -> npt.NDArray[np.float32]:
    return np.ascontiguousarray(values, "<f4")


def _fill(data: bytes, filler: bytes) -> bytes:
    return data + filler * (-len(data) % ALIGNMENT)


def _describe(
    mesh: PlacedMesh,
    parts: list[npt.NDArray[Any]],  # [K, C] positions, normals, texture places; [M, 3] triangles
    data: list[bytes],
) -> dict[str, Any]:
    """The JSON of a file: one mesh, one material, one picture, and what coordinates mean."""
    starts = np.cumsum([0, *(len(_fill(each, b"\0")) for each in data)]).tolist()
    targets = [VERTICES, VERTICES, VERTICES, INDICES, None]
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(each)}
        | ({} if target is None else {"target": target})
        for start, each, target in zip(starts, data, targets, strict=False)
    ]
    return {
        "asset": {
            "version": "2.0", "generator": f"AquaFlow {__version__}",
            "extras": mesh.facts(y_up=True),
        },
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "surface"}],
        "meshes": [{"primitives": [_primitive()]}],
        "materials": [_material()],
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [
            {
                "magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR,
                "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE,
            }
        ],
        "images": [{"bufferView": 4, "mimeType": "image/png"}],
        "accessors": _accessors(parts),
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }  # fmt: skip


def _primitive() -> dict[str, Any]:
    attributes = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}
    return {"attributes": attributes, "indices": 3, "material": 0}


def _material() -> dict[str, Any]:
    return {
        "name": "surface",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0,
        },
        "extensions": {"KHR_materials_unlit": {}},
    }  # fmt: skip


def _accessors(
    parts: list[npt.NDArray[Any]],  # [K, C] positions, normals, texture places; [M, 3] triangles
) -> list[dict[str, Any]]:
    positions, normals, places, faces = parts
    return [
        {
            "bufferView": 0, "componentType": FLOAT, "count": len(positions), "type": "VEC3",
            "min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist(),
        },
        {"bufferView": 1, "componentType": FLOAT, "count": len(normals), "type": "VEC3"},
        {"bufferView": 2, "componentType": FLOAT, "count": len(places), "type": "VEC2"},
        {"bufferView": 3, "componentType": UNSIGNED_INT, "count": faces.size, "type": "SCALAR"},
    ]  # fmt: skip
