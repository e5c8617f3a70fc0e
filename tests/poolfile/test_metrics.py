"""`metrics` in a pool file: where each kind of process answers Prometheus."""

from __future__ import annotations

import pytest

from fogft.errors import SpecError
from fogft.model.choices import MetricsSpec
from fogft.poolfile import file

FILE = """\
name: p
run: serve
fogft:
  services: [{name: /s, type: std_srvs/srv/SetBool}]
  metrics: %s
"""


def parse(metrics: str):
    return file.parse(FILE % metrics, file="p.yaml")


def test_each_process_has_its_endpoint_and_each_replica_its_port():
    spec = parse("{proxy: 127.0.0.1:9464, replica: '[::1]:9470'}")
    assert spec.metrics == MetricsSpec("127.0.0.1:9464", "", "[::1]:9470")
    assert [spec.metrics.of_replica(slot) for slot in (0, 3)] == ["[::1]:9470", "[::1]:9473"]
    assert MetricsSpec().of_replica(3) == ""


def test_it_replaces_no_replica():
    """Watching a pool must not disturb it."""
    asked = parse("{replica: 127.0.0.1:9470}")
    assert asked.replica_hash == parse("{proxy: 127.0.0.1:9464}").replica_hash


@pytest.mark.parametrize(
    ("metrics", "words"),
    [
        ("9464", "must be a map"),
        ("{proxy: 9464}", "must be text"),
        ("{robot: 127.0.0.1:9464}", "unknown key"),
        ("{proxy: 127.0.0.1:1, manager: 127.0.0.1:1}", "is used twice"),
        ("{replica: 127.0.0.1:65530}", "above 65535"),
    ],
)
def test_mistakes_are_told_with_line_and_remedy(metrics, words):
    with pytest.raises(SpecError, match=words) as found:
        parse(metrics)
    assert found.value.message.startswith("p.yaml:5: fogft.metrics")
    assert found.value.hint
