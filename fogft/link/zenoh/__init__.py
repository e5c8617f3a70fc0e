"""Links over Zenoh: its settings and threads, and code that both ends share.

Not here: the two ends (`robot`, `replica`).
"""
