"""Whether an ensemble tells the truth: scores, their record, its figure."""
