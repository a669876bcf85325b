"""One dive: from a recording or a live run to its folder, with results and report."""
