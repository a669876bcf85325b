"""Files and memory: atomic writes, arrays on disk, caches that spill to disk."""
