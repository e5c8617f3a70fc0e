"""Reverse connections: a replica that robots cannot reach connects to the robot instead.

Not here: the link that runs over the connection, which is an ordinary one (`fogft.link.zenoh`).
"""
