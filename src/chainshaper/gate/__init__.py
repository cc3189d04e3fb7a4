"""When a message may leave: the decision, and what a shaping node and its standby share."""
