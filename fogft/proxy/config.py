"""Read the proxies' configuration files, overridden by command-line options.

Each function raises StateError if the file cannot be read or a key is missing or of a wrong type.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from fogft.errors import StateError
from fogft.model.choices import Speaks
from fogft.model.proxy_config import ClientProxyConfig, ProxyConfig, ServerProxyConfig
from fogft.poolfile import config_file

DEFAULT_GATEWAY_LISTEN = "0.0.0.0:7470"


def read_client(path: Path, metrics: str | None = None) -> ClientProxyConfig:
    """Read a client proxy's configuration; `metrics` overrides it."""
    config = config_file.read(ClientProxyConfig, path, {"metrics": metrics})
    _check(path, config)
    return config


def read_gateway(
    path: Path, listen: str | None = None, metrics: str | None = None
) -> ClientProxyConfig:
    """Read a gateway's configuration; `listen` and `metrics` override it."""
    config = read_client(path, metrics)
    return replace(config, listen=listen or config.listen or DEFAULT_GATEWAY_LISTEN)


def read_server(path: Path, **override: Any) -> ServerProxyConfig:
    """Read a server proxy's configuration; options that are not None override it."""
    config = config_file.read(ServerProxyConfig, path, override)
    _check(path, config)
    kind, _, file = config.notice.partition(":")
    if kind != "file":
        return config
    return replace(config, notice=f"file:{path.resolve().parent / file}")


def _check(path: Path, config: ProxyConfig) -> None:
    if config.rmw is Speaks.ZENOH and config.topics:
        raise StateError(f"`{path}` cannot be used: `rmw: zenoh` supports only services, no topics")
