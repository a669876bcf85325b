"""Numerical stability as a table: input that no sane dive has, and what must happen all the same.

One file per family; a case registers itself, draws its input from one seed, and names the guard
that has to catch it. ``tests/lab/stress`` takes guards away and sees the named cases fail.
"""
