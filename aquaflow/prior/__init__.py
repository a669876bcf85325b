"""The two-view prior: what two pictures say about matches and geometry."""
