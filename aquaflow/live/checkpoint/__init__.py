"""Checkpoints of a live dive: writing, reading, and resuming from them."""
