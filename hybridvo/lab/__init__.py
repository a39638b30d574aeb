"""Scenes, training, evaluation and pictures: nothing that estimates needs it."""
