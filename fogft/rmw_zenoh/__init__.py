"""A node that talks to ROS 2 over Zenoh (rmw_zenoh) where no ROS 2 is installed.

Not here: links (`fogft.link.zenoh`), any other middleware (`fogft.ros`).
"""
