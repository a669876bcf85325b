"""What changed at a site between two dives: distances, colours, and patches of both."""
