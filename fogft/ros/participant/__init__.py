"""A process in a ROS domain, below its nodes: how it comes to be known there, and how it goes.

Not here: nodes, and what they offer (`fogft.ros.node`).
"""
