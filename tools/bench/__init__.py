"""What is measured of the package; ``tools/benchmark.py`` is the entry."""
