"""Tiny trees in the true layouts of the data sets: a tilted plane, seen by a camera that moves."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 64, 48, 32.0
STEP_M = 0.15
"""Between pictures, to the right."""
K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])


def depth_at(x: float, width: int = WIDTH, height: int = HEIGHT) -> npt.NDArray[np.float32]:
    """[H, W] z of the plane z = 3 + 0.2 X seen by the camera at (x, 0, 0)."""
    u = (np.arange(width) + 0.5 - width / 2) / (FOCAL * width / WIDTH)
    z = (3.0 + 0.2 * x) / (1.0 - 0.2 * u)
    return np.tile(z, (height, 1)).astype(np.float32)


def picture_at(x: float, width: int = WIDTH, height: int = HEIGHT) -> npt.NDArray[np.uint8]:
    """[H, W, 3] BGR: a pattern fixed to the plane."""
    z = depth_at(x, width, height)
    focal = FOCAL * width / WIDTH
    X = x + (np.arange(width) + 0.5 - width / 2) / focal * z
    Y = (np.arange(height)[:, None] + 0.5 - height / 2) / focal * z
    cells = 24
    column = np.floor(X * cells / 6.0).astype(int) % 64
    row = np.floor(Y * cells / 6.0).astype(int) % 64
    pattern = np.random.default_rng(0).integers(30, 220, (64, 64, 3)).astype(np.uint8)
    return pattern[row, column]


def places(count: int) -> list[float]:
    return [STEP_M * number for number in range(count)]


def write_tartanair(root: Path, count: int = 4, version: int = 1) -> None:
    side = "left" if version == 1 else "lcam_front"
    folder = root / ("ocean/Easy/P000" if version == 1 else "Ocean/Data_easy/P000")
    images, depths = folder / f"image_{side}", folder / f"depth_{side}"
    images.mkdir(parents=True)
    depths.mkdir()
    for number, x in enumerate(places(count)):
        stem = f"{number:06d}_{side}"
        cv2.imwrite(str(images / f"{stem}.png"), picture_at(x))
        if version == 1:
            np.save(depths / f"{stem}_depth.npy", depth_at(x))
        else:
            packed = depth_at(x)[..., None].view(np.uint8)
            cv2.imwrite(str(depths / f"{stem}_depth.png"), packed)
    # x forward, y right, z down: to the camera's right is y. No turn: qx qy qz qw.
    rows = [f"5 {x} 7 0 0 0 1" for x in places(count)]
    (folder / f"pose_{side}.txt").write_text("\n".join(rows) + "\n")


SENSOR = """{
    "sensor_type": "front_left",
    "T_BS": [[1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0],
             [0.0, 0.0, 0.0, 1.0]],
    "resolution": [64, 48],
    "intrinsics": [[32.0, 0.0, 32.0], [0.0, 32.0, 24.0], [0.0, 0.0, 1.0]]
}
"""


def write_mimir(root: Path, count: int = 4) -> None:
    track = root / "SeaFloor" / "auv0" / "track0"
    for kind in ("rgb", "depth"):
        (track / kind / "cam0" / "data").mkdir(parents=True)
        (track / kind / "cam0" / "sensor.yaml").write_text(SENSOR)
    rows = ["#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z"]
    for number, x in enumerate(places(count)):
        moment = 1_600_000_000_000_000_000 + 33_000_000 * number
        cv2.imwrite(str(track / "rgb" / "cam0" / "data" / f"{moment}.png"), picture_at(x))
        write_exr(track / "depth" / "cam0" / "data" / f"{moment}.exr", depth_at(x))
        rows.append(f"{moment + 1_000_000},4.5,{x},7,1,0,0,0")
    (track / "pose_groundtruth").mkdir()
    (track / "pose_groundtruth" / "data.csv").write_text("\n".join(rows) + "\n")


def write_exr(path: Path, values: npt.NDArray[np.float32], compression: int = 3) -> None:
    """One channel of 32-bit floats, as AirSim writes them: zip, sixteen lines a block."""
    height, width = values.shape
    attributes = [
        ("channels", "chlist", b"R\0" + struct.pack("<iiii", 2, 0, 1, 1) + b"\0"),
        ("compression", "compression", bytes([compression])),
        ("dataWindow", "box2i", struct.pack("<4i", 0, 0, width - 1, height - 1)),
        ("displayWindow", "box2i", struct.pack("<4i", 0, 0, width - 1, height - 1)),
        ("lineOrder", "lineOrder", b"\0"),
    ]
    header = struct.pack("<II", 20000630, 2)
    for name, kind, value in attributes:
        header += name.encode() + b"\0" + kind.encode() + b"\0"
        header += struct.pack("<i", len(value)) + value
    header += b"\0"
    lines = {0: 1, 2: 1, 3: 16}[compression]
    blocks, offsets = b"", []
    first = len(header) + 8 * (-(-height // lines))
    for row in range(0, height, lines):
        raw = values[row : row + lines].astype("<f4").tobytes()
        packed = _deflated(raw) if compression else raw
        packed = packed if len(packed) < len(raw) else raw
        offsets.append(first + len(blocks))
        blocks += struct.pack("<ii", row, len(packed)) + packed
    path.write_bytes(header + struct.pack(f"<{len(offsets)}Q", *offsets) + blocks)


def _deflated(raw: bytes) -> bytes:
    halves = np.frombuffer(raw[0::2] + raw[1::2], np.uint8).astype(np.int64)
    halves[1:] = (np.diff(halves) + 128) % 256
    return zlib.compress(halves.astype(np.uint8).tobytes())


def write_uwstereo(root: Path, count: int = 2) -> None:
    folder = root / "coral reef" / "coral"
    for name in ("images/left", "images/right", "disparity"):
        (folder / name).mkdir(parents=True)
    for number in range(count):
        x = 10 * STEP_M * number
        stem = f"{number:05d}"
        cv2.imwrite(str(folder / "images" / "left" / f"{stem}.png"), picture_at(x))
        cv2.imwrite(str(folder / "images" / "right" / f"{stem}.png"), picture_at(x + STEP_M))
        disparity = FOCAL * STEP_M / depth_at(x)
        cv2.imwrite(str(folder / "disparity" / f"{stem}.pfm"), disparity.astype(np.float32))
    rig = {"fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "baseline_m": STEP_M}
    (root / "stereo.yaml").write_text("".join(f"{k}: {v}\n" for k, v in rig.items()))


LARGE = 4
"""Keypoints need more pixels: FLSea's pictures are so many times larger here."""


def write_flsea(root: Path, count: int = 3) -> None:
    folder = root / "rock_garden1"
    images, depths = folder / "imgs" / "LFT", folder / "depth" / "LFT"
    images.mkdir(parents=True)
    depths.mkdir(parents=True)
    size = (LARGE * WIDTH, LARGE * HEIGHT)
    for number, x in enumerate(places(count)):
        stem = f"1623305186{number:04d}"
        cv2.imwrite(str(images / f"{stem}.tiff"), picture_at(x, *size))
        cv2.imwrite(str(depths / f"{stem}_abs_depth.tif"), depth_at(x, *size))
    camera = {"width": size[0], "height": size[1], "fx": LARGE * FOCAL, "fy": LARGE * FOCAL,
              "cx": size[0] / 2, "cy": size[1] / 2}  # fmt: skip
    (root / "camera.yaml").write_text("".join(f"{k}: {v}\n" for k, v in camera.items()))


def write_colmap(root: Path, count: int = 4) -> None:
    folder = root / "reef" / "dense"
    for name in ("images", "sparse", "stereo/depth_maps"):
        (folder / name).mkdir(parents=True)
    cameras = struct.pack("<Q", 1) + struct.pack("<iiQQ", 1, 1, WIDTH, HEIGHT)
    cameras += struct.pack("<4d", FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    (folder / "sparse" / "cameras.bin").write_bytes(cameras)
    images = struct.pack("<Q", count)
    for number, x in enumerate(places(count)):
        name = f"IMG_{number:04d}.png"
        cv2.imwrite(str(folder / "images" / name), picture_at(x))
        images += struct.pack("<i7di", number + 1, 1.0, 0.0, 0.0, 0.0, -x, 0.0, 0.0, 1)
        images += name.encode() + b"\0" + struct.pack("<Q", 1) + struct.pack("<ddq", 1.0, 2.0, -1)
        depth = f"{WIDTH}&{HEIGHT}&1&".encode() + depth_at(x).tobytes()
        (folder / "stereo" / "depth_maps" / f"{name}.geometric.bin").write_bytes(depth)
    (folder / "sparse" / "images.bin").write_bytes(images)
