"""The paper's two-view prior: a full-size MASt3R-class network, written from its published design.

No line and no weight of the reference implementation is in here: parameters only carry the names
that the public checkpoint uses, so that a user who has accepted its licence can load it.
"""
