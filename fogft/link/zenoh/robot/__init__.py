"""The robot's end of a link: dial, probe, send attempts, take answers.

Not here: which link a request takes (`fogft.proxy.robot`).
"""
