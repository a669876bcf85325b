"""Films: containers, codecs, pixel shapes, scan, times, damage."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from aquaflow.geometry.camera import CameraModel, save_camera
from tests.recordings.inputs import RATE_HZ, Dive, Made, Picture, made, row, run_ffmpeg

FINE = {
    "libx264": ("-crf", "6"), "libx265": ("-crf", "6", "-x265-params", "log-level=none"),
    "mpeg2video": ("-q:v", "1", "-qmin", "1"), "mpeg4": ("-q:v", "1"), "mjpeg": ("-q:v", "1"),
    "libvpx": ("-b:v", "8M", "-qmin", "1", "-qmax", "6"), "flv": ("-q:v", "1"),
    "libvpx-vp9": ("-b:v", "0", "-crf", "6", "-deadline", "realtime", "-cpu-used", "8"),
    "libsvtav1": ("-crf", "8", "-preset", "12"), "wmv2": ("-q:v", "1"), "ffv1": (),
    "prores_ks": ("-profile:v", "3"), "dvvideo": (), "libtheora": ("-q:v", "10"),
    "msmpeg4v3": ("-q:v", "1"), "huffyuv": (), "utvideo": (), "png": (), "qtrle": (),
    "dnxhd": ("-profile:v", "dnxhr_hq"), "h263p": ("-q:v", "1"), "mpeg1video": ("-q:v", "1"),
    "rawvideo": (),
}  # fmt: skip
"""Encoders and their settings at which they lose little."""


def film(
    path: Path, pictures: Sequence[Picture], codec: str, *options: object, rate: float = RATE_HZ
) -> Path:
    """Write ``pictures`` by FFmpeg."""
    height, width = pictures[0].shape[:2]
    run_ffmpeg(
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", rate, "-i", "-"),
        *("-c:v", codec, *FINE[codec], *options, path),
        data=b"".join(picture.tobytes() for picture in pictures),
    )
    return path


def decode(path: Path, width: int, height: int, filters: str = "null") -> list[Picture]:
    """What the program FFmpeg makes of a film."""
    data = run_ffmpeg(
        *("-i", f"file:{path}", "-map", "0:v:0", "-vf", f"{filters},scale={width}:{height}"),
        *("-fps_mode", "passthrough", "-pix_fmt", "rgb24", "-f", "rawvideo", "-"),
    )
    return list(np.frombuffer(data, np.uint8).reshape(-1, height, width, 3))


def read_as(dive: Dive, path: Path, **changes: object) -> Made:
    """A film whose plain reading are the pictures that FFmpeg decodes."""
    height, width = dive.pictures[0].shape[:2]
    return made(dive, path, **({"plain": decode(path, width, height)} | changes))


CONTAINERS: list[tuple[str, str, tuple[object, ...]]] = [
    ("clip.mp4", "libx264", ("-pix_fmt", "yuv420p", "-bf", "0")),
    ("b-frames.mp4", "libx264", ("-pix_fmt", "yuv420p", "-bf", "3")),
    ("fragments.mp4", "libx264", ("-pix_fmt", "yuv420p", "-movflags", "frag_keyframe+empty_moov")),
    ("full-range.mp4", "libx264", ("-pix_fmt", "yuvj420p")),
    ("422.mov", "libx264", ("-pix_fmt", "yuv422p")),
    ("444.mkv", "libx264", ("-pix_fmt", "yuv444p")),
    ("10-bit.mp4", "libx264", ("-pix_fmt", "yuv420p10le")),
    ("clip.mts", "libx264", ("-pix_fmt", "yuv420p", "-f", "mpegts", "-mpegts_m2ts_mode", "1")),
    ("clip.m2ts", "libx264", ("-pix_fmt", "yuv420p")),
    ("clip.ts", "libx264", ("-pix_fmt", "yuv420p")),
    ("clip.flv", "libx264", ("-pix_fmt", "yuv420p")),
    ("clip.3gp", "libx264", ("-pix_fmt", "yuv420p")),
    ("clip.mp4", "libx265", ("-pix_fmt", "yuv420p", "-tag:v", "hvc1")),
    ("10-bit.mov", "libx265", ("-pix_fmt", "yuv420p10le")),
    ("clip.mkv", "libx265", ("-pix_fmt", "yuv420p")),
    ("clip.avi", "mjpeg", ("-pix_fmt", "yuvj420p")),
    ("clip.mov", "mjpeg", ("-pix_fmt", "yuvj422p")),
    ("clip.mkv", "ffv1", ()),
    ("clip.avi", "huffyuv", ()),
    ("clip.avi", "rawvideo", ("-pix_fmt", "bgr24")),
    ("clip.mov", "prores_ks", ("-pix_fmt", "yuv422p10le")),
    ("clip.mov", "qtrle", ()),
    ("clip.webm", "libvpx", ()),
    ("clip.webm", "libvpx-vp9", ()),
    ("clip.mpg", "mpeg2video", ("-r", "25")),
    ("clip.vob", "mpeg2video", ("-r", "25")),
    ("clip.avi", "mpeg4", ("-vtag", "DIVX")),
    ("clip.m4v", "mpeg4", ()),
    ("clip.avi", "msmpeg4v3", ()),
    ("clip.wmv", "wmv2", ()),
    ("clip.flv", "flv", ()),
    ("clip.ogv", "libtheora", ()),
    ("clip.mxf", "mpeg2video", ("-r", "25")),
]


def _container(name: str, codec: str, options: tuple[object, ...]) -> None:
    rate = float(str(options[options.index("-r") + 1])) if "-r" in options else RATE_HZ

    @row(f"film {codec} {name}", needs="ffmpeg", says="from the container", near=4.0)
    def _made(dive: Dive, folder: Path) -> Made:
        times_s = [index / rate for index in range(len(dive.pictures))]
        kept = [str(each) for each in options if each not in ("-r", "25")]
        path = film(folder / name, dive.pictures, codec, *kept, rate=rate)
        return read_as(dive, path, times_s=times_s)


for _each in CONTAINERS:
    _container(*_each)


H264 = ("-pix_fmt", "yuv420p")


@row("film interlaced H.264 .mts", needs="ffmpeg", says="is interlaced from frame 0 on", near=4.0)
def _interlaced(dive: Dive, folder: Path) -> Made:
    flags = ("-flags", "+ildct+ilme", "-x264-params", "tff=1")
    return read_as(dive, film(folder / "a.mts", dive.pictures, "libx264", *H264, *flags))


@row("film interlaced H.264 bottom first .mkv", needs="ffmpeg", says="is interlaced", near=4.0)
def _bottom_first(dive: Dive, folder: Path) -> Made:
    flags = ("-flags", "+ildct+ilme", "-x264-params", "bff=1")
    return read_as(dive, film(folder / "a.mkv", dive.pictures, "libx264", *H264, *flags))


@row("film interlaced MPEG-2 .mpg", needs="ffmpeg", says="is interlaced from frame 0", near=4.0)
def _interlaced_mpeg2(dive: Dive, folder: Path) -> Made:
    flags = ("-flags", "+ildct+ilme", "-vf", "setfield=tff")
    path = film(folder / "a.mpg", dive.pictures, "mpeg2video", *flags, rate=25.0)
    return read_as(dive, path, times_s=[index / 25.0 for index in range(len(dive.pictures))])


def _lines_of(field: npt.NDArray[np.float32], rows: npt.NDArray[np.float64]) -> Picture:
    """Those of a field, and between them what a spline makes of it."""
    at = np.broadcast_to(rows[:, None], (len(rows), field.shape[1])).astype(np.float32)
    across = np.broadcast_to(np.arange(field.shape[1]), at.shape).astype(np.float32)
    found = cv2.remap(field, across, at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(np.rint(found), 0, 255).astype(np.uint8)


@row(
    "film interlaced, fields of two moments", needs="ffmpeg", says="is interlaced", near=7.0,
    most_ratio=1.6,
)  # fmt: skip
def _fields(dive: Dive, folder: Path) -> Made:
    """A field has 60 lines: what stands between them is a matter of the filter's taste."""
    woven = [each.copy() for each in dive.fields[::2]]
    for each, later in zip(woven, dive.fields[1::2], strict=True):
        each[1::2] = later[1::2]
    flags = ("-flags", "+ildct+ilme", "-x264-params", "tff=1")
    path = film(folder / "a.mts", woven, "libx264", *H264, *flags, rate=RATE_HZ / 2)
    times_s = [index / RATE_HZ * 2 for index in range(len(woven))]
    rows = np.arange(len(woven[0])) / 2
    plain = [_lines_of(each[::2].astype(np.float32), rows) for each in dive.fields[::2]]
    return made(dive, path, pictures=dive.fields[::2], times_s=times_s, every=2, plain=plain)


@row("film interlaced in mid-stream .ts", needs="ffmpeg", says="interlaced from frame", near=4.0)
def _turns_interlaced(dive: Dive, folder: Path) -> Made:
    flags = ("-flags", "+ildct+ilme", "-x264-params", "tff=1")
    plain = film(folder / "1.ts", dive.pictures[:6], "libx264", *H264, "-bf", "0")
    after = film(
        folder / "2.ts", dive.pictures[6:], "libx264", *H264, *flags, "-bf", "0",
        "-output_ts_offset", "0.6",
    )  # fmt: skip
    path = folder / "a.ts"
    path.write_bytes(plain.read_bytes() + after.read_bytes())
    return read_as(dive, path)


def _narrow(dive: Dive, share: float) -> list[Picture]:
    """Pictures squeezed to ``share`` of their width, as anamorphic video stores them."""
    height, width = dive.pictures[0].shape[:2]
    size = (round(width * share), height)
    return [
        np.asarray(cv2.resize(each, size, interpolation=cv2.INTER_AREA), np.uint8)
        for each in dive.pictures
    ]


@row("film 4:3 pixels H.264", needs="ffmpeg", says="pixels: 1.333 wide", near=5.0)
def _wide_pixels(dive: Dive, folder: Path) -> Made:
    path = folder / "a.mp4"
    return read_as(
        dive, film(path, _narrow(dive, 0.75), "libx264", "-pix_fmt", "yuv444p", "-vf", "setsar=4/3")
    )


@row("film 5:4 pixels MPEG-2 .vob", needs="ffmpeg", says="pixels: 1.25 wide", near=5.0)
def _wide_pixels_mpeg2(dive: Dive, folder: Path) -> Made:
    path = film(
        folder / "a.vob", _narrow(dive, 0.8), "mpeg2video", "-aspect", "4:3", rate=25.0,
    )  # fmt: skip
    return read_as(dive, path, times_s=[index / 25.0 for index in range(len(dive.pictures))])


ONE = 1 << 16
"""Of fixed-point numbers in MP4."""


@row("film turned by 180 degrees .mp4", needs="ffmpeg")
def _turned(dive: Dive, folder: Path) -> Made:
    upside_down = [np.ascontiguousarray(each[::-1, ::-1]) for each in dive.pictures]
    path = film(folder / "a.mp4", upside_down, "libx264", *H264)
    height, width = dive.pictures[0].shape[:2]
    turn = struct.pack(">9i", -ONE, 0, 0, 0, -ONE, 0, width * ONE, height * ONE, 1 << 30)
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44  # the matrix (ISO 14496-12, 8.3.2)
    data[at : at + len(turn)] = turn
    path.write_bytes(data)
    return read_as(dive, path)


UNEVEN_S = [0.0, 0.1, 0.13, 0.3, 0.41, 0.5, 0.7, 0.72, 0.8, 0.9, 1.05, 1.1, 1.3, 1.5]
"""Times of pictures that are not evenly spread."""


def _uneven(path: Path, dive: Dive) -> Path:
    times = "".join(f"+{1000 * t:.0f}*eq(N,{index})" for index, t in enumerate(UNEVEN_S))
    return film(
        path, dive.pictures, "libx264", *H264, "-bf", "0", "-fps_mode", "passthrough",
        "-enc_time_base", "1:1000", "-vf", f"settb=1/1000,setpts='0{times}'",
    )  # fmt: skip


@row("film variable frame rate .mkv", needs="ffmpeg")
def _variable_mkv(dive: Dive, folder: Path) -> Made:
    return read_as(dive, _uneven(folder / "a.mkv", dive), times_s=UNEVEN_S)


@row("film variable frame rate .mp4", needs="ffmpeg")
def _variable_mp4(dive: Dive, folder: Path) -> Made:
    return read_as(dive, _uneven(folder / "a.mp4", dive), times_s=UNEVEN_S)


@row("film GoPro chapters", needs="ffmpeg", says="chapters of one recording: GX010042.MP4")
def _chapters(dive: Dive, folder: Path) -> Made:
    plain: list[Picture] = []
    for number, part in enumerate((slice(0, 5), slice(5, 10), slice(10, None)), start=1):
        path = film(folder / f"GX{number:02d}0042.MP4", dive.pictures[part], "libx264", *H264)
        plain += decode(path, 160, 120)
    return made(dive, folder / "GX010042.MP4", plain=plain)


@row("film with a colon in its name", needs="ffmpeg")
def _colon(dive: Dive, folder: Path) -> Made:
    plain = film(folder / "a.mkv", dive.pictures, "libx264", *H264)
    return read_as(dive, plain.rename(folder / "10:30:00.mkv"))


@row("film bare .h264", needs="ffmpeg", says="25 pictures a second was assumed")
def _bare_h264(dive: Dive, folder: Path) -> Made:
    path = film(folder / "a.h264", dive.pictures, "libx264", *H264, "-bf", "0")
    return read_as(dive, path, times_s=[index / 25.0 for index in range(len(dive.pictures))])


@row("film bare .mjpeg", needs="ffmpeg", says="25 pictures a second was assumed")
def _bare_mjpeg(dive: Dive, folder: Path) -> Made:
    path = film(folder / "a.mjpeg", dive.pictures, "mjpeg", "-pix_fmt", "yuvj420p")
    return read_as(dive, path, times_s=[index / 25.0 for index in range(len(dive.pictures))])


@row("film bare .mjpeg with --fps", needs="ffmpeg", says="10 pictures a second, from --fps")
def _bare_mjpeg_fps(dive: Dive, folder: Path) -> Made:
    path = film(folder / "a.mjpeg", dive.pictures, "mjpeg", "-pix_fmt", "yuvj420p")
    return read_as(dive, path, fps=RATE_HZ)


@row("film with --fps that its container contradicts", needs="ffmpeg", says="--fps is not used")
def _fps_and_container(dive: Dive, folder: Path) -> Made:
    path = film(folder / "a.mp4", dive.pictures, "libx264", *H264)
    return read_as(dive, path, fps=5.0)


@row("film that begins late in its container", needs="ffmpeg")
def _late(dive: Dive, folder: Path) -> Made:
    path = folder / "a.mkv"
    return read_as(dive, film(path, dive.pictures, "libx264", *H264, "-output_ts_offset", "7.25"))


@row("film with sound and subtitles before its pictures", needs="ffmpeg")
def _with_sound(dive: Dive, folder: Path) -> Made:
    pictures = film(folder / "p.mkv", dive.pictures, "libx264", *H264)
    (folder / "s.srt").write_text("1\n00:00:00,000 --> 00:00:01,000\nDepth 3 m\n")
    path = folder / "a.mkv"
    run_ffmpeg(
        *("-f", "lavfi", "-i", "sine=d=1.4", "-i", folder / "s.srt", "-i", pictures),
        *("-map", "0", "-map", "1", "-map", "2", "-c:v", "copy", "-c:a", "aac", path),
    )
    return read_as(dive, path)


@row("film with its camera.yaml", needs="ffmpeg", says="the calibration is ")
def _with_camera(dive: Dive, folder: Path) -> Made:
    save_camera(dive.camera, folder / "camera.yaml")
    path = film(folder / "a.mp4", dive.pictures, "libx264", *H264)
    return read_as(dive, path, camera=dive.camera)


@row("film with a camera.yaml of another shape", needs="ffmpeg", says="camera.yaml is not used: ")
def _other_camera(dive: Dive, folder: Path) -> Made:
    save_camera(CameraModel(160, 90, 140.0, 140.0, 80.0, 45.0), folder / "camera.yaml")
    return read_as(dive, film(folder / "a.mp4", dive.pictures, "libx264", *H264))


@row("film BT.709", needs="ffmpeg")
def _bt709(dive: Dive, folder: Path) -> Made:
    path = film(
        folder / "a.mp4", dive.pictures, "libx264", *H264, "-vf", "scale=out_color_matrix=bt709",
        "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709",
    )  # fmt: skip
    return read_as(dive, path)


@row(
    "film with a damaged picture", needs="ffmpeg", near=4.0, says="cannot be decoded without errors"
)
def _damaged(dive: Dive, folder: Path) -> Made:
    path = film(folder / "a.avi", dive.pictures, "mpeg4", "-g", "5", "-bf", "0")
    plain: list[Picture | None] = [*decode(path, 160, 120)]
    data = bytearray(path.read_bytes())
    starts = [found.start() for found in re.finditer(rb"\x00\x00\x01\xb6", data)]
    middle = (starts[6] + starts[7]) // 2
    data[middle : middle + 60] = bytes(reversed(range(60)))
    path.write_bytes(data)
    pictures: list[Picture | None] = list(dive.pictures)
    pictures[6:10] = plain[6:10] = [None] * 4  # the next whole picture is the tenth
    return made(dive, path, pictures=pictures, plain=plain)


@row("film cut off .ts", needs="ffmpeg", says="2 frames of a.ts were left out")
def _cut(dive: Dive, folder: Path) -> Made:
    path = film(folder / "a.ts", dive.pictures, "mpeg2video", "-g", "1", rate=25.0)
    plain = [*decode(path, 160, 120)[:-2], None, None]
    path.write_bytes(path.read_bytes()[: -188 * 4])
    times_s = [index / 25.0 for index in range(len(dive.pictures))]
    pictures = [*dive.pictures[:-2], None, None]
    return made(dive, path, times_s=times_s, pictures=pictures, plain=plain)


@row("film without its index .mp4", needs="ffmpeg", refuses="has no index: it was cut off")
def _no_index(dive: Dive, folder: Path) -> Made:
    path = film(folder / "a.mp4", dive.pictures, "libx264", *H264)
    path.write_bytes(path.read_bytes()[:-2000])
    return made(dive, path)


@row("film AV1 .mkv", needs="ffmpeg", refuses="cannot be read as a video: .*AV1")
def _av1(dive: Dive, folder: Path) -> Made:
    return made(dive, film(folder / "a.mkv", dive.pictures, "libsvtav1"))


@row("film that is empty", refuses="cannot be read as a video")
def _empty(dive: Dive, folder: Path) -> Made:
    (folder / "a.mp4").touch()
    return made(dive, folder / "a.mp4")


@row("sound without pictures .mp4", needs="ffmpeg", refuses="cannot be read as a video")
def _sound(dive: Dive, folder: Path) -> Made:
    run_ffmpeg("-f", "lavfi", "-i", "sine=d=1", "-c:a", "aac", folder / "a.mp4")
    return made(dive, folder / "a.mp4")
