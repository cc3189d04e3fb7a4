"""Extending an application by the latency-shaping node, without touching its code."""
