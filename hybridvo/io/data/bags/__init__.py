"""Recordings of ROS 1, ROS 2 and RealSense, read without ROS through ``rosbags``."""
