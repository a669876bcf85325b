"""Joint adjustment of keyframe poses and depths of anchored points (docs/adjustment.md)."""
