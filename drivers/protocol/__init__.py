"""Decoders: one protocol per file, bytes in, samples in our units out (docs/conventions.md)."""
