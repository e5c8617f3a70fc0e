"""Links over Zenoh: its settings and threads, and what both ends have in common.

Not here: the two ends (`robot`, `replica`).
"""
