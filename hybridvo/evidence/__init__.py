"""What can be measured of a pair, and what the sources found in it."""
