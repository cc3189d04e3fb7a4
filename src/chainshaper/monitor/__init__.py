"""Chains of what runs now: the watch, budgets, metrics for other programs."""
