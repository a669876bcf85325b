"""The two-view prior: matches and geometry from two pictures."""
