"""``aquaflow lab prior bench``: what a frame costs each prior, and how many matches it finds."""
