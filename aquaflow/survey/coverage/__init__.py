"""What the camera has seen, in a plan view: how well each place, along which lines, what next."""
