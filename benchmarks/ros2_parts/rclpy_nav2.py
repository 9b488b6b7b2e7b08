"""Nodes of ``rclpy`` that replace Nav2 and slam_toolbox: they map, localise, and drive 0.8 m.

    PYTHON benchmarks/ros2_parts/rclpy_nav2.py

Odom is at (5, 3) in map, which only these nodes know. They drive straight ahead until they have arrived, and exit.
"""

import math

import rclpy
from geometry_msgs.msg import TransformStamped, Twist
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

DISTANCE = 0.8


def main() -> None:
    """Drive, and exit."""
    rclpy.init()
    node, mapper = rclpy.create_node("nav2"), rclpy.create_node("slam_toolbox")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    maps = mapper.create_publisher(OccupancyGrid, "map", latched)
    transforms = mapper.create_publisher(TFMessage, "/tf", 10)
    twists = node.create_publisher(Twist, "cmd_vel", 1)
    places: list[tuple[float, float]] = []

    def take(message: Odometry) -> None:
        places.append((message.pose.pose.position.x, message.pose.pose.position.y))

    def act() -> None:
        row = TransformStamped()
        row.header.frame_id, row.child_frame_id = "map", "odom"
        row.header.stamp = node.get_clock().now().to_msg()
        row.transform.translation.x, row.transform.translation.y = 5.0, 3.0
        transforms.publish(TFMessage(transforms=[row]))
        if places:
            order = Twist()
            order.linear.x = 0.2
            twists.publish(order)

    grid = OccupancyGrid(data=[0] * 120_000)
    grid.header.frame_id = "map"
    grid.info.resolution, grid.info.width, grid.info.height = 0.05, 400, 300
    maps.publish(grid)
    node.create_subscription(Odometry, "odom", take, 10)
    node.create_timer(0.05, act)
    while not places or math.dist(places[0], places[-1]) < DISTANCE:
        rclpy.spin_once(node)


if __name__ == "__main__":
    main()
