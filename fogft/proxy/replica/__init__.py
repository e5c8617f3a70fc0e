"""The server proxy: runs beside each replica of the service and passes requests to it.

Not here: the robot's side (`fogft.proxy.robot`).
"""
