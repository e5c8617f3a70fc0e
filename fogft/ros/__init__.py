"""ROS 2 through rclpy: serialised services, clients and topics of any type.

Not here: handling requests (`fogft.proxy`).
"""
