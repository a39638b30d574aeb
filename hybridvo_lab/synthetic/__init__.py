"""Synthetic pairs and scenes with exact ground truth."""
