"""``report.html``: one file that explains a dive and opens without a network."""
