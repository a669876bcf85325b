"""Real hardware behind the source protocols of :mod:`aquaflow.sources`."""
