"""Topics and actions between robot and replicas: queues, duplicates, goals. Pure.

Not here: publishing and subscribing (`fogft.ros`, `fogft.proxy`).
"""
