"""Cases of the golden figures; ``tools/golden.py`` measures them."""
