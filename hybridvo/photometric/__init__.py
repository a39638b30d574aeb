"""The images and depth maps of a pair as factors of its motion."""
