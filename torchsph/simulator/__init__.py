"""SPH: a scene and a scheme become a running batch of members."""
