"""What a robot saw, kept and played again: recordings as folders, and ROS 2 bags read the same way."""
