"""A learned prior's ranges in tracking: in the keyframe's unit, fused, and as the first map."""
