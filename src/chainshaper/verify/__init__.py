"""A plan held against what was measured: predictions and overruns."""
