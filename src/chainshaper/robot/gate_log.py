"""The columns of a gate's log: comma-separated, one row (`gate_release`) for each message."""

LOG_COLUMNS = (
    *("time", "pid", "tid", "cpu", "source_timestamp", "arrival", "origin", "release", "slot"),
    *("cycles_waited", "anchor", "overrun", "mode", "published", "stalled", "dropped", "lost"),
    *("row", "moved"),
)
