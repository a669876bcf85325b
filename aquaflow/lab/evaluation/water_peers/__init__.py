"""Published ways to take water off pictures: what restored held-out views are compared with."""
