"""`aquaflow lab batch`: from a folder of recordings and settings to a site of dives."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_regular
from aquaflow.base.storage.whole_folder import FolderLock, remove_abandoned
from aquaflow.config import Config
from aquaflow.config.mapping import BYTES_PER_GAUSSIAN
from aquaflow.lab.batch.job import WRITTEN, BatchConfig, BatchJob, CallJob
from aquaflow.lab.batch.object_store import ObjectStore, is_url
from aquaflow.lab.batch.ray_workers import RayWorkers
from aquaflow.lab.batch.recordings import Recording, find_recordings
from aquaflow.lab.batch.run_job import KILOBYTE, MEGABYTE
from aquaflow.lab.batch.season import JOURNAL, End, Journal, Season, failed_jobs, run_season
from aquaflow.lab.batch.site import DIVES, Sites, add_members, make_site
from aquaflow.lab.batch.workers import LocalWorkers, Workers

Progress = Callable[[str, int, int | None], None]
"""Called with the stage, the steps done and, where known, the steps there are."""
GIGABYTE_MB = 1000.0


@dataclass(frozen=True)
class Batched:
    """A batch that is over."""

    jobs: list[BatchJob]
    season: Season
    notes: list[str]
    """Sentences about dives that are there, but are no members of the site."""


def run_batch(
    dives: str,
    site: str,
    settings: Config,
    calibration: str | None,
    batch: BatchConfig,
    progress: Progress,
    sites: Sites,
) -> Batched:
    """Make a dive in ``site`` of every recording in ``dives``; those that are there stay.

    ``calibration``: content of a camera.yaml for all of them.

    Raises:
        InputError: there are no recordings, the site cannot be written or is held by another
            batch, or there is no cluster.
    """
    cache = batch.cache or _cache_for(site)
    recordings = find_recordings(dives)
    make_site(site, sites)
    with _hold_journal(site, cache) as folder:
        jobs = _jobs(recordings, site, settings, calibration, str(cache), progress)
        journal = Journal(folder / JOURNAL)
        try:
            journal.write("begun", recordings=dives, dives=len(jobs), cluster=batch.cluster)
            workers = _workers(batch)
            season = run_season(
                jobs, workers, journal, batch.retries,
                lambda done, total: progress("dives", done, total),
            )  # fmt: skip
        finally:
            journal.close()
        if is_url(site):
            with contextlib.suppress(InputError):  # the dives are there; the journal is a record
                ObjectStore(site).write(JOURNAL, read_regular(folder / JOURNAL))
    written = [n for n, outcome in season.outcomes.items() if outcome.state in WRITTEN]
    return Batched(jobs, season, add_members(site, sorted(written), sites))


def run_calls(
    jobs: Sequence[CallJob], folder: Path, what: str, batch: BatchConfig, progress: Progress
) -> dict[str, str]:
    """Call the functions of all ``jobs``, of which the journal is in ``folder``; why one came to
    nothing, by name.

    Raises:
        InputError: the journal cannot be written, or there is no cluster any more.
        KeyboardInterrupt: so it was stopped.
    """
    journal = Journal(folder / JOURNAL)
    try:
        journal.write("begun", calls=len(jobs), cluster=batch.cluster)
        season = run_season(
            jobs, _workers(batch), journal, batch.retries,
            lambda done, total: progress(what, done, total),
        )  # fmt: skip
    finally:
        journal.close()
    if season.end is End.STOPPED:
        raise KeyboardInterrupt
    if season.end is End.NO_WORKERS:
        raise InputError(season.reason)
    undone = "it was not begun"
    failed = [job.name for job in failed_jobs(season, jobs)]
    return {n: season.outcomes[n].sentence if n in season.outcomes else undone for n in failed}


@contextlib.contextmanager
def _hold_journal(site: str, cache: Path) -> Iterator[Path]:
    """The local folder of the journal, which no other batch gets meanwhile."""
    folder = cache if is_url(site) else Path(site)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {folder}: {error.strerror}; give another --out") from error
    lock = FolderLock(folder)
    works = folder if is_url(site) else folder / DIVES
    try:
        remove_abandoned(works)
        yield folder
    finally:
        remove_abandoned(works)  # of killed attempts
        lock.release()


def _cache_for(site: str) -> Path:
    """A folder of its own for every site in an object store."""
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "aquaflow" / "batch" / hashlib.sha256(site.encode()).hexdigest()[:16]


def _jobs(
    recordings: list[Recording],
    site: str,
    settings: Config,
    calibration: str | None,
    cache: str,
    progress: Progress,
) -> list[BatchJob]:
    """The jobs, with the number of threads fixed: another number gives other bytes."""
    fixed = settings.model_copy(update={"threads": settings.threads or 1})
    content = fixed.model_dump(mode="json")
    where = site if is_url(site) else str(Path(site).resolve())
    jobs = []
    with Examiner() as examiner:
        for done, each in enumerate(recordings, 1):
            source = each.source if is_url(each.source) else str(Path(each.source).resolve())
            memory = memory_mb(examiner.look(source), each.size_bytes, fixed)
            jobs.append(
                BatchJob(
                    each.name, source, each.size_bytes, where, cache, content, calibration,
                    content["threads"], memory,
                )
            )  # fmt: skip
            progress("look", done, len(recordings))
    return jobs


def _workers(batch: BatchConfig) -> Workers:
    if batch.cluster is not None:
        return RayWorkers(batch.cluster, batch.jobs)
    lent = memory_for_dives_mb() if batch.memory_gb is None else batch.memory_gb * GIGABYTE_MB
    return LocalWorkers(core_count(), round(lent), batch.jobs)


# --------------------------------------------------------------------------------------------------
# What this machine can lend to a batch: cores, and memory that is free.

SHARE_OF_FREE = 0.8
"""Of the free memory that a batch takes by itself: the rest is for files and for what others do."""
LEAST_MB = 512
"""Where the free memory cannot be found out."""


def core_count() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def memory_for_dives_mb(root: Path = Path("/")) -> int:
    """Memory that dives may take together, 1e6 bytes: a share of what is free now."""
    free = [each for each in (_of_machine(root), _of_control_group(root)) if each is not None]
    return round(SHARE_OF_FREE * min(free)) if free else LEAST_MB


def _of_machine(root: Path) -> float | None:
    try:
        lines = (root / "proc/meminfo").read_text().splitlines()
        fields = (line.split() for line in lines if line.startswith("MemAvailable:"))
        return int(next(fields)[1]) * KILOBYTE / MEGABYTE
    except (OSError, ValueError, StopIteration):
        return None


def _of_control_group(root: Path) -> float | None:
    """Of a container, or of a unit with MemoryMax."""
    try:
        group = (root / "proc/self/cgroup").read_text().rpartition("::")[2].strip()
        folder = root / "sys/fs/cgroup" / group.lstrip("/")
        limit = int((folder / "memory.max").read_text())
        used = int((folder / "memory.current").read_text())
    except (OSError, ValueError):
        return None  # no limit ("max"), or no control groups of version 2
    return max(limit - used, 0) / MEGABYTE


# --------------------------------------------------------------------------------------------------
# A look at every recording before the first is mapped, in a process that one of them may crash.

PROGRAM = "aquaflow.lab.batch.examining_process"
PATIENCE_S = 120.0
"""For one recording; a video's index takes well under a second, a long bag's several."""


class Examiner:
    """Looks at one recording after the other."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Examiner:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end()

    def look(self, source: str) -> Examined:
        """What can be known of the recording at ``source``; nothing of one in an object store,
        or one that crashes who looks at it."""
        if is_url(source):
            return Examined()
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        alarm = threading.Timer(PATIENCE_S, process.kill)
        alarm.start()
        try:
            process.stdin.write(json.dumps(source).encode() + b"\n")
            process.stdin.flush()
            return Examined(**json.loads(process.stdout.readline()))
        except (OSError, ValueError, TypeError):
            self._end()
            return Examined()
        finally:
            alarm.cancel()

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


# --------------------------------------------------------------------------------------------------
# How much memory a dive will take: from its pictures' size, their number and the map's Gaussians.
#
# Fitted to resident sets that were measured (notes/2026-11-speed.md#memory), and on the safe side.

BASE_MAP_MB = 325.0
"""`aquaflow map` before its first frame."""
BASE_TRACKING_MB = 161.0
"""The same with ``--tracking-only``, which loads no torch."""
VIEWS_BYTES_PER_PIXEL = 128 * 11.1
"""128 views in memory; one takes 0.85 MB at 320 x 240 px."""
KEYFRAMES_BYTES_PER_PIXEL = 32 * 33.9
"""32 keyframes in memory; one takes 0.65 MB at 160 x 120 px."""
MB_PER_FRAME = 0.058
"""At the end of a dive all keyframes are adjusted: 0.48 MB each, at 120 in 1,000 frames."""
MARGIN = 1.4
"""Over the sum of the above: measured peaks are at most 1.38 of it (320 px, 20,000 Gaussians)."""
DEFAULT_WIDTH = 480
"""px that a recording is mapped at where nothing is asked."""
USUAL_ASPECT = 0.75
"""Height over width; wider pictures have fewer pixels."""
BYTES_PER_FRAME = 20_000
"""Of a recording whose frames are not counted: 1080p video at 4.8 Mbit/s, 30 frames/s. Pictures in
files take ten times as much, so that this errs to the safe side."""


@dataclass(frozen=True)
class Examined:
    """What is known of a recording before it is mapped."""

    frames: int | None = None
    width: int | None = None
    """px"""
    height: int | None = None
    """px"""


def memory_mb(seen: Examined, size_bytes: int, config: Config) -> int:
    """Estimate of a dive's peak, 1e6 bytes; ``size_bytes`` of the recording."""
    pixels = _pixels(seen, config)
    per_pixel, fixed_mb = KEYFRAMES_BYTES_PER_PIXEL, BASE_TRACKING_MB
    if config.mapping.enabled:
        per_pixel += VIEWS_BYTES_PER_PIXEL
        fixed_mb = BASE_MAP_MB + BYTES_PER_GAUSSIAN * config.mapping.max_gaussians / MEGABYTE
    frames = _frames(seen, size_bytes, config)
    return round(MARGIN * (fixed_mb + per_pixel * pixels / MEGABYTE + MB_PER_FRAME * frames))


def _pixels(seen: Examined, config: Config) -> float:
    """Of a mapped picture."""
    width = config.source.width or min(DEFAULT_WIDTH, seen.width or DEFAULT_WIDTH)
    if seen.width and seen.height:
        return width * width * seen.height / seen.width
    return width * width * USUAL_ASPECT


def _frames(seen: Examined, size_bytes: int, config: Config) -> int:
    """Frames that are mapped."""
    source = config.source
    there = seen.frames if seen.frames is not None else size_bytes // BYTES_PER_FRAME
    stop = there if source.stop is None else min(source.stop, there)
    return len(range(source.start, stop, source.every))
