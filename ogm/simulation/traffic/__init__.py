"""Traffic participants: bodies, where they park, how they move."""
