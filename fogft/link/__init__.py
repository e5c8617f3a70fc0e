"""Links, one per replica: the port (interface), the send window, and the wire format.

Not here: Zenoh (`zenoh`), choosing which replica to ask (`fogft.requests`).
"""
