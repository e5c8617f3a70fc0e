"""Replicas as processes on this machine. Not here: what they run (`fogft.proxy.replica`)."""
