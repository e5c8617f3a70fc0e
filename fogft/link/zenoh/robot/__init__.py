"""The robot's end of a link: dial, probe, send attempts, receive answers.

Not here: choosing which replica to ask (`fogft.requests`).
"""
