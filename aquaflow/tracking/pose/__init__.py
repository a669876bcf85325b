"""Pose of a frame against a keyframe's pointmap, and depth fusion (Sec. 3.2)."""
