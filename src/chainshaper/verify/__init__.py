"""What was measured: latency, its comparison, a plan's prediction beside it, overruns."""
