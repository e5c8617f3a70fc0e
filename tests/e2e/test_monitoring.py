"""A real Prometheus scrapes a pool under faults: every expression that we ship gives data."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import urllib.parse
import urllib.request
from pathlib import Path

import pytest
import yaml

from tests.docs.documents import ROOT
from tests.e2e.pool import Pool
from tests.needs import needs
from tests.ports import free_port

pytestmark = [pytest.mark.e2e, pytest.mark.ros, pytest.mark.timeout(240), needs("prometheus")]
FOLDER = ROOT / "templates" / "monitoring"


def expressions() -> list[str]:
    """Return those of the dashboard, and those of the alerts without what they are held against."""
    panels = json.loads((FOLDER / "dashboard.json").read_text())["panels"]
    found = [target["expr"] for panel in panels for target in panel["targets"]]
    groups = yaml.safe_load((FOLDER / "alerts.yaml").read_text())["groups"]
    for rule in (rule for group in groups for rule in group["rules"]):
        found += [re.sub(r" (==|<|>) [\d.]+$", "", part) for part in rule["expr"].split(" and ")]
    short = [re.sub(r"\[(\$__rate_interval|5m|1h|1d)\]", "[20s]", one) for one in found]
    return sorted({one.replace(" < ", " - ") for one in short})


class Prometheus:
    """Prometheus on loopback, which looks each second."""

    def __init__(self, folder: Path, targets: list[str]) -> None:
        self.port = free_port()
        config = yaml.safe_load((FOLDER / "prometheus.yaml").read_text())
        config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
        config["rule_files"] = [str(FOLDER / "alerts.yaml")]
        config["scrape_configs"][0]["static_configs"][0]["targets"] = targets
        (folder / "prometheus.yaml").write_text(yaml.safe_dump(config))
        self.process = subprocess.Popen(
            [
                *("prometheus", f"--config.file={folder}/prometheus.yaml"),
                f"--storage.tsdb.path={folder}/data",
                f"--web.listen-address=127.0.0.1:{self.port}",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def get(self, path: str, **query: str) -> dict[str, object]:
        """Return what the HTTP interface answers; empty while it starts."""
        url = f"http://127.0.0.1:{self.port}/api/v1/{path}?{urllib.parse.urlencode(query)}"
        try:
            with urllib.request.urlopen(url, timeout=10) as answer:
                return json.load(answer)["data"]
        except OSError:
            return {}

    def has(self, expression: str) -> bool:
        """Return whether an expression gives any sample."""
        return bool(self.get("query", query=expression).get("result"))


def test_every_expression_gives_data_while_a_pool_is_under_faults(tmp_path, ros_domain):
    pool = Pool(tmp_path, ros_domain)
    targets = [f"127.0.0.1:{free_port()}" for _ in range(2)]
    metrics = f"  metrics: {{proxy: '{targets[0]}', manager: '{targets[1]}'}}\n"
    pool.write(replicas=2, more=metrics)
    prometheus = Prometheus(tmp_path, targets)
    try:
        pool.up()
        client = pool.client(40, 10.0)
        pool.wait(lambda: prometheus.has("fogft_requests_total > 0"))
        pool.fogft("chaos", "capacity", "local/us-west-1", "0")
        pool.fogft("chaos", "kill", "0")
        pool.wait(lambda: prometheus.has("fogft_pool_lost_replicas_total > 0"))
        pool.wait(lambda: pool.ready() == 2)  # on a busy machine that takes longer than a deadline
        pool.fogft("chaos", "freeze", "1")
        missing = expressions()

        def all_have() -> bool:
            missing[:] = [one for one in missing if not prometheus.has(one)]
            return not missing

        # Nothing is refused, nor fails, in a pool that copes: these are about worse days.
        worse = {e for e in missing if "failed_launches" in e or "refusals" in e}
        missing[:] = [one for one in missing if one not in worse]
        pool.wait(all_have, limit_s=60)
        rules = prometheus.get("rules")["groups"][0]["rules"]
        assert [rule["health"] for rule in rules] == ["ok"] * len(rules), rules
        assert client.finish()["failed"] == 0
    finally:
        prometheus.process.send_signal(signal.SIGTERM)
        prometheus.process.wait(20)
        pool.close()
