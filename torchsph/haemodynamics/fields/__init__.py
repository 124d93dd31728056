"""Fields on a masked grid: their derivatives in space and time, and their values at points."""
