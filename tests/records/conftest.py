"""Rendezvous tests use the certificates and links of the link tests."""

from __future__ import annotations

from tests.link.conftest import authority, dial, owner, start_replica

__all__ = ["authority", "dial", "owner", "start_replica"]
