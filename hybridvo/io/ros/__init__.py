"""What the nodes of ROS 1 and of ROS 2 share; it needs no ROS itself.

Messages are whatever has the fields of the ROS message: of ROS, of ``rosbags``, or a fake.
"""
