"""The gateway between a robot with a thin uplink and the replicas.

Not here: choosing a replica (`fogft.requests`), receiving requests (`fogft.link`).
"""
