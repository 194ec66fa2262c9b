"""The controllers of triform on ROS 2: scans in, commands out."""
