"""The verbs as functions: each joins rooms of the library, so that none knows another."""
