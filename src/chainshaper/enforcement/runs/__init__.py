"""Plans in force: what a run changed, on disk before it is changed, and how it is undone."""
