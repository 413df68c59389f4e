"""Dynamic maps: belief in free, static and dynamic, velocities, moving objects and their prediction."""
