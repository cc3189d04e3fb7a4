"""What the kernel shows and takes: processes, threads, scheduling, cgroups."""
