"""From echoes to velocities; knows no simulated scanner."""
