"""ROS 2 through rclpy: serialised services, clients and topics of any type.

Not here: what becomes of a request (`fogft.proxy`).
"""
