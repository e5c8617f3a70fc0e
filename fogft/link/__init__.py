"""One link for each replica: its port, its window, and the bytes on the wire.

Not here: Zenoh (`zenoh`), and which link a request takes (`fogft.proxy.robot`).
"""
