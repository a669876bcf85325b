"""Decoders: one protocol per file, bytes in, samples in DESIGN's units and frames out."""
