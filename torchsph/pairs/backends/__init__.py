"""The backends of the pair interface: plain torch (the oracle), compiled code for CPUs, Triton for GPUs."""
