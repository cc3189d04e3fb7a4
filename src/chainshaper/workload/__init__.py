"""One application description, and the ways to run it."""
