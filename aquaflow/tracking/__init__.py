"""Tracking: pose of every frame against its keyframe, and the keyframes' fused pointmaps."""
