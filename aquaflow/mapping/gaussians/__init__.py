"""The Gaussians of a sub-map: parameters, insertion (Sec. 3.3.3), following keyframes."""
