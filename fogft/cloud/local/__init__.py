"""The local cloud: replicas are processes on this machine, in named regions with prices.

Not here: what they run (`fogft.proxy.replica`). See docs/design/local-cloud.md.
"""
