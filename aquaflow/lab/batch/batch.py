"""`aquaflow batch`: from a folder of recordings and settings to a site of dives."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from aquaflow.base.errors import InputError
from aquaflow.base.errors.regular_file import read_regular
from aquaflow.base.storage.folder_lock import FolderLock
from aquaflow.base.storage.whole_folder import remove_abandoned
from aquaflow.config import Config
from aquaflow.config.batch import BatchConfig
from aquaflow.lab.batch.estimate import memory_mb
from aquaflow.lab.batch.examine import Examiner
from aquaflow.lab.batch.job import WRITTEN, Job
from aquaflow.lab.batch.journal import JOURNAL, Journal
from aquaflow.lab.batch.machine import core_count, memory_for_dives_mb
from aquaflow.lab.batch.membership import Sites, add_members, make_site
from aquaflow.lab.batch.object_store import ObjectStore, is_url
from aquaflow.lab.batch.ray_workers import RayWorkers
from aquaflow.lab.batch.recordings import Recording, find_recordings
from aquaflow.lab.batch.season import Season, run_season
from aquaflow.lab.batch.site import DIVES
from aquaflow.lab.batch.workers import LocalWorkers, Workers

Progress = Callable[[str, int, int | None], None]
"""Called with the stage, the steps done and, where known, the steps there are."""
GIGABYTE_MB = 1000.0


@dataclass(frozen=True)
class Batched:
    """A batch that is over."""

    jobs: list[Job]
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
    with _held(site, cache) as folder:
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


@contextlib.contextmanager
def _held(site: str, cache: Path) -> Iterator[Path]:
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
) -> list[Job]:
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
                Job(
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
