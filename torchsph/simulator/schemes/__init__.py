"""Options of the schemes and of their parts; imports nothing of the engine."""
