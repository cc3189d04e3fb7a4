"""Results for people: terminal tables and figures, and the same as JSON."""
