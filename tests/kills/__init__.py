"""kill -9 of commands at random moments: nothing passes as finished that is not, and the same
command again gives the same bytes. ``python -m tests.kills`` does it at length."""
