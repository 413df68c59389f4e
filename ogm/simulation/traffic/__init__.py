"""Traffic participants: bodies, parked vehicles, and motion."""
