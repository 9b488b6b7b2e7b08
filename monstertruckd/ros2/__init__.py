"""The robot as a ROS 2 node: a separate process with a client of the robot on one side and ROS 2 on the other."""
