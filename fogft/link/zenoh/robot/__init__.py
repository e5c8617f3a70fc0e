"""The robot's end of a link: dial, probe, send attempts, take answers.

Not here: which replica is asked (`fogft.requests`).
"""
