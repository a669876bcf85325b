"""Several dives of one place: recognised in each other, and brought into one frame."""
