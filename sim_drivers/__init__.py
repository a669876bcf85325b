"""The drivers' doubles: the same interfaces fed from recordings and synthetic dives."""
