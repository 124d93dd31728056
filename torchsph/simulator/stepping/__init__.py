"""One time step: its sums, its order, its length."""
