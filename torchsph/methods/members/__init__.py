"""The members of an ensemble's analyses: frame by frame to whoever reads quantities out of them, or keeps them."""
