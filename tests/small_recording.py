"""The small recording's size, and what tests do with it."""

from __future__ import annotations

from pathlib import Path

GIVE_UP_S = 300.0
"""Longest wait for what takes milliseconds on an idle machine; only a failing test waits for it."""
FRAMES = 24
WIDTH, HEIGHT = 160, 120
QUICK = ("--refine-steps", "60")
"""A map good enough to look at the files; its quality is the bars' business."""
HASTY = ("--config", str(Path(__file__).with_name("hasty.yaml")))
"""A map that is there, for half the time."""
