"""The replica's end of a link: admit robots, take requests, send replies.

Not here: running requests (`fogft.proxy.replica`).
"""
