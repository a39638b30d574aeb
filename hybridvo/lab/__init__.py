"""Scenes, training, evaluation, baselines and pictures: nothing that estimates needs it."""
