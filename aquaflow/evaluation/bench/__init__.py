"""``aquaflow bench`` and ``aquaflow ablate``: run time against error, and what each part is worth."""
