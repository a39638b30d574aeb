"""Weights of the six networks of the PWVO paper, which hybridvo finds by their names."""
