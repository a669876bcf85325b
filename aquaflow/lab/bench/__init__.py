"""``aquaflow lab bench`` and ``lab ablate``: run time against error, and what parts are worth."""
