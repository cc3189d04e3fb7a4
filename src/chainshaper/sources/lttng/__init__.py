"""LTTng: sessions that record, and reading and writing its traces as event tables."""
