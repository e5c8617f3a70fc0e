"""The replica's end of a link: admit robots, receive requests, send replies.

Not here: running requests (`fogft.proxy.replica`).
"""
