"""A simulated scanner: scatterers in a flow become echoes."""
