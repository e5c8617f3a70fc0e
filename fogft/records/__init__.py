"""Signed records (memberships, leases, revocations), and the rendezvous that passes them on.

Not here: application data, which goes over links only (`fogft.link`).
"""
