"""``aquaflow bench`` and ``aquaflow ablate``: run time against error, and what parts are worth."""
