"""Least-squares solvers: direct and iterative."""
