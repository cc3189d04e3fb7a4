"""Servers in the kernel: a sched_ext policy, its table and its loader."""
