"""Servers by `cgroup.freeze`: threads stopped outside their slots by a dispatcher per core."""
