"""The server proxy: runs on each replica and passes robots' requests to its local services.

Not here: the robot's side (`fogft.proxy.robot`).
"""
