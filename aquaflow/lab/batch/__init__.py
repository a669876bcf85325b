"""Many recordings into many dives: on this machine or on a cluster (docs/batch.md)."""
