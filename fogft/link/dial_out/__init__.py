"""Replicas that no robot can reach open the connection to the robot themselves.

Not here: what flows through it afterwards, which is a link as any other (`fogft.link.zenoh`).
"""
