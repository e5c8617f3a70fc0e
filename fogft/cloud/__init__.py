"""Where replicas run: the port `Cloud`, the clouds behind it, and their preemption notices.

Not here: which offer is bought (`fogft.planning`).
"""
