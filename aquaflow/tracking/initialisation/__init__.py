"""Starting a map: two-view hypotheses, bundle adjustment, back-fill."""
