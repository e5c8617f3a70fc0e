"""One link for each replica: its port, its window, and the bytes on the wire.

Not here: Zenoh (`zenoh`), and which replica is asked (`fogft.requests`).
"""
