"""eBPF: the events of `libtracetools.so` by uprobes, without LTTng."""
