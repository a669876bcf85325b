"""Places seen before: retrieval, geometric verification, relocalisation."""
