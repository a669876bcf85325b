"""What each deliverable of a big finished dive costs, each in a process of its own:

    python -m tests.survey.long_deliverables DIVE [NAME ...]

DIVE: of :mod:`tests.survey.long_dive`. Prints a JSON line for each NAME: CPU and wall seconds, the
most memory, with and without pages of files, the size of what was written, and the last line of
what was said.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

EXPORTS = {
    "ortho": "ortho", "dem": "dem", "laz": "points.laz", "e57": "points.e57", "spz": "map.spz",
    "mcap": "dive.mcap", "ply": "mesh.ply", "obj": "mesh.obj", "glb": "mesh.glb",
    "colmap": "colmap", "nerfstudio": "nerfstudio", "restored": "restored",
    "geotags": "geotags.csv",
}  # fmt: skip
"""Of each format of ``aquaflow export``, the file or folder that is written."""
VIDEO = "video"
NAMES = (*EXPORTS, VIDEO)
MOST_S = 3600.0
"""A deliverable that takes longer is given up."""


def command(dive: Path, name: str, out: Path) -> list[str]:
    """The command line that makes the deliverable."""
    start = [sys.executable, "-m", "aquaflow"]
    if name == VIDEO:
        said = ["export", "video", str(dive), "--kind", "fly-through"]
        return [*start, *said, "--out", str(out / "flight.mp4")]
    return [*start, "export", str(dive), "--format", name, "--out", str(out / EXPORTS[name])]


def measure(dive: Path, name: str, work: Path) -> dict[str, object]:
    """What the deliverable costs."""
    work.mkdir()
    began = time.monotonic()
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command(dive, name, work), stdout=said, stderr=subprocess.STDOUT)
        timer, own_kb = time.monotonic() + MOST_S, 0
        while True:
            own_kb = max(own_kb, _own_kb(process.pid))
            pid, status, used = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            if time.monotonic() > timer:
                process.kill()
            time.sleep(0.2)
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines()
    return {
        "name": name, "exit": process.returncode,
        "cpu_s": round(used.ru_utime + used.ru_stime, 1),
        "wall_s": round(time.monotonic() - began, 1),
        "peak_mb": round(used.ru_maxrss / 1024.0),
        "own_mb": round(own_kb / 1024.0),
        "out_mb": round(sum(f.stat().st_size for f in work.rglob("*") if f.is_file()) / 1e6, 1),
        "said": lines[-1][-200:] if lines else "",
    }  # fmt: skip


def _own_kb(pid: int) -> int:
    """What the process holds now, without pages of files, which the kernel takes back."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("RssAnon:")), 0)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition(":")[0])
    parser.add_argument("dive", type=Path)
    parser.add_argument("names", nargs="*", choices=[*NAMES, []], help="all, if none is given")
    parser.add_argument("--keep", type=Path, help="folder that keeps what is written")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.dive.parent) as folder:
        for name in given.names or NAMES:
            work = Path(folder) / name
            print(json.dumps(measure(given.dive, name, work)), flush=True)
            if given.keep is not None:
                shutil.copytree(work, given.keep / name, dirs_exist_ok=True)
            shutil.rmtree(work)


if __name__ == "__main__":
    main()
