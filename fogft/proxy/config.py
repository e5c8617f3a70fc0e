"""Read the proxies' configuration files, overridden by command-line options.

Each function raises StateError if the file cannot be read or a key is missing or of a wrong type.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from fogft.model.proxy_config import ClientProxyConfig, ServerProxyConfig
from fogft.poolfile import config_file


def read_client(path: Path, **override: Any) -> ClientProxyConfig:
    """Read the configuration of a client proxy or gateway; options that are not None override."""
    return config_file.read(ClientProxyConfig, path, override)


def read_server(path: Path, **override: Any) -> ServerProxyConfig:
    """Read a server proxy's configuration; options that are not None override it."""
    config = config_file.read(ServerProxyConfig, path, override)
    kind, _, file = config.notice.partition(":")
    if kind != "file":
        return config
    return replace(config, notice=f"file:{path.resolve().parent / file}")
