"""Methods beside each other: what ``tools/compare_methods.py`` runs, here and on other machines."""
