"""The robot as a ROS 2 node: a separate process that connects a client of the robot with ROS 2."""
