"""Servers on a running system: scheduling classes, threads, and the gate of the shaping node."""
