"""What every room may know: errors, durations, files, the application, events, recordings."""
