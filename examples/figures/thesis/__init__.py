"""A script for each experiment: `make(material)` measures and says how it is drawn."""
