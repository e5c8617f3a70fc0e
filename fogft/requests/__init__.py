"""What becomes of one request: hedging, the first success, votes, fallback, admission. Pure.

Not here: sending (`fogft.proxy.robot`).
"""
