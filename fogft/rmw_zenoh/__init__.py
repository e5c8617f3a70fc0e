"""A node that talks to ROS 2 over Zenoh (rmw_zenoh) without a ROS 2 installation.

Not here: links (`fogft.link.zenoh`), any other middleware (`fogft.ros`).
"""
