"""Values for parameters: what fits, what is at the edge, and what is absurd."""

from __future__ import annotations

from hypothesis import strategies as st

RECORDINGS = (
    *("recording", "recording", "pictures", "clip.mp4", "logged", "recorded", "bag"),
    *("tiff", "clip.avi"),
)
DIVES = ("dive", "dive", "dive", "killed")

FITTING: dict[str, tuple[str, ...]] = {
    "source": RECORDINGS,
    "recording": RECORDINGS,
    "dives": (*DIVES, *RECORDINGS, "README.md"),
    "pictures": ("pictures", "recording"),
    "dive": DIVES,
    "site": ("site",),
    "out": ("dive", "killed", "recording", "recorded", "README.md"),
    "csv": ("positions.csv", "README.md"),
    "truth": ("recording", "poses.tum", "positions.csv", "dive"),
    "clean": RECORDINGS,
    "calib": ("camera.yaml", "fisheye.yaml"),
    "config": ("config.yaml", "vehicle.yaml"),
    "file": ("config.yaml", "vehicle.yaml"),
    "folder": ("prior",),
    "checkpoint": ("weights.pth",),
    "token_file": ("token",),
    "readme": ("README.md",),
    "scene": ("recording",),
}
"""Exemplars that suit a parameter, by its name; for others any does."""

USUAL = frozenset({"source"})
"""Options that are nearly always given: without them, `run` and `record` look for devices."""

ABSURD_PATHS = (
    *("", ".", "..", "/", "missing", "missing/deep", "x" * 300, "a" * 5000, "é\udcff", "new\n"),
    *("null", "full", "null/x", "/proc/self/mem", "/proc/1/environ", "/proc/new", "/sys/new"),
    *("zero/x", "loop", "~", "$HOME", "-", "--", "*", "http://127.0.0.1/x", "file:///etc", "%s"),
)
"""``null``, ``full`` and ``loop`` are links in the folder where a command runs."""

ONLY: dict[str, tuple[str, ...]] = {
    "cluster": ("127.0.0.1:9", "", "é", "-1", "ray://127.0.0.1:9"),
    "url": (
        *("http://127.0.0.1:1", "http://[::1]:1", "127.0.0.1", "", "http://", "http://127.0.0.1:x"),
        *("http://127.0.0.1:99999", "http://127.0.0.1:-1", "http://[::1", "ftp://127.0.0.1"),
        *("file:///etc/passwd", "http://127.0.0.1:1/" + "x" * 70_000, "http://127.0.0.1:1/\n"),
        *("http://127.0.0.1:1\udcff", "http://é@127.0.0.1:1", "http:127.0.0.1", "//127.0.0.1"),
    ),
    "host": ("127.0.0.1", "::1", "localhost", "", "127.0.0.999", "x" * 300, "é", "\udcff", "-1"),
    "device": ("cpu", "cpu", "cuda", "tensorrt", "auto", "", "cuda:99", "meta", "é"),
    "data": (
        *("tartanair=recording", "colmap=missing", "=", "x=y", "tartanair=", "uwstereo=.", "", "é"),
    ),
    "suite": ("real", "real", "", "none"),
}
"""All that these parameters get: they name programs, hosts, or work of many minutes."""

TEXTS = (
    *("", " ", "fast", "balanced", "accurate", "reef", "wall", "pipe", "flat_sand", "coastal_1C"),
    *("left", "right", "0,0,40,30", "0,0,1,1", "1e9,0,1,1", "0,0,nan,4", "-1,-1,9,9", "9" * 5000),
    *("jpeg", "png", "raw", "images", "solvers", "é\udcff", "[bold]", "[/]", "{}", "%s", "\x1b[0m"),
    *("\n", "x" * 5000, "../..", "None", "nan", "0", "𝔘", "\u202e"),
)

HUGE = ("9" * 400, "1e999", "99999999999999999999", "2147483648", "-2147483649", "1e308")
ODD = ("", "nan", "inf", "-inf", "-0.0", "1e-320", "0x10", "1_0", " 5", "٣", "1,5", "None", "é")

QUICK: dict[str, dict[str, str]] = {
    "map": {"--refine-steps": "2", "--out": "new"},
    "run": {"--seconds": "1", "--speed": "20", "--out": "new"},
    "record": {"--seconds": "0.5", "--out": "new"},
    "view": {"--port": "0"},
    "lab synth": {"--frames": "2", "--width": "64", "--height": "48"},
    "lab bench": {"--no-peers": "", "--preset": "fast", "--out": "new"},
    "lab bench render": {"--repeats": "1", "--out": "new"},
    "lab bench growth": {"--frames": "50", "--preset": "fast", "--out": "new"},
    "lab ablate": {"--out": "new"},
    "lab prior bench": {"--repeats": "1"},
    "lab prior train compact": {"--steps": "1", "--scenes": "8", "--batch": "2", "--out": "new"},
    "lab stress": {"--family": "solvers"},
    "export report": {"--pdf": "new.pdf"},
    "export video": {"--out": "new.mp4"},
    "change": {"--out": "new"},
    "lab batch": {"--out": "new", "--retries": "0"},
}
"""Given where nothing else was drawn, so that a run that works is over soon."""

INTERRUPTED = frozenset(
    {
        *QUICK,
        *("lab prior train mast3r", "lab prior verify"),
        *("lab prior export", "lab prior compare"),
        *("export", "doctor", "site merge"),
    }
)
"""Commands that may rightly work for minutes, or until Ctrl-C; they get a Ctrl-C after a while."""


def numbers(kind: type) -> st.SearchStrategy[str]:
    """Numbers as text: small ones mostly, and what is none."""
    small = st.integers(-1, 12).map(str)
    sane = small if kind is int else small | st.floats(0.0, 4.0).map(str)
    absurd = st.sampled_from((*HUGE, *ODD)) | st.integers().map(str)
    return st.integers(0, 3).flatmap(lambda chance: sane if chance else absurd)
