"""``aquaflow lab bench growth``: what a frame costs at the end of dives of several lengths."""
