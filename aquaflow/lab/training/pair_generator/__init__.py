"""Procedural pairs of underwater pictures with exact depths and cameras, on a CPU or a GPU.

Geometry costs most and is kept in a pool on disk; water, light, the camera's behaviour and the
window that is looked at are drawn anew each time a pair is used
(notes/measurements.md#compact-prior).
"""
