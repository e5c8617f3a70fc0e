"""The client proxy: offers the service on the robot and forwards requests to the replicas.

Not here: the replica's side (`fogft.proxy.replica`).
"""
