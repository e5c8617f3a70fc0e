"""The common names of certificates, as tests write them."""

from __future__ import annotations

from fogft.model.credentials import Holder, Role, manager_of


def robot(pool_uid: str, name: str, generation: int = 1) -> str:
    return Holder(Role.ROBOT, name, generation, pool_uid).common_name


def gateway(pool_uid: str, name: str, generation: int = 1) -> str:
    return Holder(Role.GATEWAY, name, generation, pool_uid).common_name


def rendezvous(pool_uid: str, name: str) -> str:
    return Holder(Role.RENDEZVOUS, name, 1, pool_uid).common_name


def manager(pool_uid: str) -> str:
    return manager_of(pool_uid).common_name
