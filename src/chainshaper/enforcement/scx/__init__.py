"""Servers in the kernel's own scheduler: a sched_ext policy, its table and its loader."""
