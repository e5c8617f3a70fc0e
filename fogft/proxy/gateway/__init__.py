"""The gateway between a robot with a thin uplink and the replicas."""
