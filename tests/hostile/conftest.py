"""What those against hostile parties may use: certificates, replicas as processes, links."""

from tests.link.conftest import authority, dial, owner, start_replica

__all__ = ["authority", "dial", "owner", "start_replica"]
