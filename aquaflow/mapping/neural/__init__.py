"""The Local Gaussian Parameter Decoder and its voxel groups (Sec. 3.3.1)."""
