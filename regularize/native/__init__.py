"""Compiled assembly and band algebra, on CPU and GPU."""
