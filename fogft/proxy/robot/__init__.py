"""The client proxy: offers the service on the robot and asks the replicas.

Not here: the replica's side (`fogft.proxy.replica`).
"""
