"""The keyframe pose graph: edges, loop admission, optimisation (Sec. 3.2)."""
