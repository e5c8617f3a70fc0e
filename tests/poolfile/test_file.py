"""Every mistake in a pool file gives one error, word for word, at its line."""

from __future__ import annotations

import datetime
import json
import re
import textwrap
from dataclasses import replace

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fogft.errors import SpecError
from fogft.model.keys import keys_of
from fogft.model.spec import HealthSpec, OnTimeout, PoolSpec, ServiceSpec
from fogft.poolfile import file, yaml_tree
from fogft.poolfile.pool import Checks
from fogft.poolfile.tree import plain
from tests.needs import needs
from tests.nightly import by_day

FOGFT_KEYS = [*(e.name for e in keys_of(PoolSpec) if not e.key.advanced), "advanced"]

GOOD = """\
name: perception
resources: {cpus: 16+, use_spot: true, any_of: [{infra: aws/us-west-1}, {infra: gcp/us-west1}]}
workdir: .
envs: {MODEL: large, THREADS: 4}
setup: colcon build
run: |
  exec ros2 run my_perception detect
fogft:
  services:
    - {name: detect, type: my_msgs/srv/Detect, timeout_s: 2, on_timeout: empty, ok_field: success}
    - name: /ns/segment
      type: my_msgs/srv/Segment
  replicas: 3
  max_surge: 0
  max_usd_per_hour: 1.5
  max_hours: 12
  health:
    suspect_after_s: 3
    replace_after_s: 20.5
    start_limit_s: 600
  unmanaged_max_hours: 2
"""


def pool(ours="", *, top="", services="[{name: /a, type: a/srv/A}]"):
    """Return a pool file: `top` in line 1 and on, then `fogft` with `ours` at its end."""
    lines = [*top.splitlines(), "run: x", "fogft:", f"  services: {services}"]
    return "\n".join([*lines, *textwrap.indent(ours, "  ").splitlines()]) + "\n"


def fault(source, folder=None, **checks):
    with pytest.raises(SpecError) as caught:
        file.parse(source, file="pool.yaml", checks=Checks(**checks), folder=folder)
    return caught.value.message, caught.value.hint


def test_a_whole_file():
    spec = file.parse(GOOD, file="x.yaml")
    task = yaml.safe_load(GOOD)
    del task["fogft"]
    assert spec == PoolSpec(
        name="perception",
        services=(
            ServiceSpec("/detect", "my_msgs/srv/Detect", 2.0, OnTimeout.EMPTY, "success"),
            ServiceSpec("/ns/segment", "my_msgs/srv/Segment"),
        ),
        replicas=3,
        max_surge=0,
        max_usd_per_hour=1.5,
        max_hours=12.0,
        health=HealthSpec(3.0, 20.5, 600.0),
        unmanaged_max_hours=2.0,
        task=task,
    )


# name of the test, file, message, hint
MISTAKES = {
    # keys
    "unknown key in fogft": (
        pool("replcas: 3"),
        "pool.yaml:4: fogft.replcas: unknown key",
        "did you mean `replicas`?",
    ),
    "unknown key in fogft, like nothing": (
        pool("zzz: 3"),
        "pool.yaml:4: fogft.zzz: unknown key",
        "known here: " + ", ".join(f"`{key}`" for key in sorted(FOGFT_KEYS)),
    ),
    "unknown key in a service": (
        pool(services="\n    - name: /a\n      typ: a/srv/A"),
        "pool.yaml:5: fogft.services[0].typ: unknown key",
        "did you mean `type`?",
    ),
    "unknown key in health": (
        pool("health:\n  suspect_s: 3"),
        "pool.yaml:5: fogft.health.suspect_s: unknown key",
        "did you mean `suspect_after_s`?",
    ),
    "unknown key at the top": (
        pool(top="file_mount: {}"),
        "pool.yaml:1: file_mount: unknown key",
        "did you mean `file_mounts`?",
    ),
    "unknown key in resources": (
        pool(top="resources: {infra: aws, use_spto: true}"),
        "pool.yaml:1: resources.use_spto: unknown key",
        "did you mean `use_spot`?",
    ),
    "unknown key in one of several resources": (
        pool(top="resources: {any_of: [{cpu: 4}]}"),
        "pool.yaml:1: resources.any_of[0].cpu: unknown key",
        "did you mean `cpus`?",
    ),
    "two lists of resources": (
        pool(top="resources: {any_of: [{}], ordered: [{}]}"),
        "pool.yaml:1: resources.ordered: cannot be combined with `any_of`",
        "keep one of them",
    ),
    "key of fogft at the top": (
        pool(top="name: a\nreplicas: 3"),
        "pool.yaml:2: replicas: unknown key",
        "`replicas` belongs under `fogft`",
    ),
    "key of a service in fogft": (
        pool("timeout_s: 3"),
        "pool.yaml:4: fogft.timeout_s: unknown key",
        "`timeout_s` belongs in a service, under `fogft.services`",
    ),
    "key of health in fogft": (
        pool("start_limit_s: 3"),
        "pool.yaml:4: fogft.start_limit_s: unknown key",
        "`start_limit_s` belongs under `fogft.health`",
    ),
    "key of the task in fogft": (
        pool("run: x"),
        "pool.yaml:4: fogft.run: unknown key",
        "`run` belongs at the top level of the file",
    ),
    "key that comes later": (
        pool("autoscale: true"),
        "pool.yaml:4: fogft.autoscale: is not supported yet",
        "remove it: set the number of replicas with `fogft scale` or `schedule`",
    ),
    "key that comes later, in a service": (
        pool(services="[{name: a, autoscale: 2}]"),
        "pool.yaml:3: fogft.services[0].autoscale: is not supported yet",
        "remove it: set the number of replicas with `fogft scale` or `schedule`",
    ),
    "SkyServe's section": (
        pool(top="service: {replicas: 2}"),
        "pool.yaml:1: service: is not allowed in a pool file",
        "it is SkyServe's; list what to replicate under `fogft.services` instead",
    ),
    "SkyPilot's pools": (
        pool(top="pool: {workers: 2}"),
        "pool.yaml:1: pool: is not allowed in a pool file",
        "it is for SkyPilot's own worker pools; the file is a pool by its `fogft` section",
    ),
    "several nodes": (
        pool(top="num_nodes: 2"),
        "pool.yaml:1: num_nodes: must be 1, not `2`: a replica is one machine",
        "remove it, and set `fogft.replicas` for more replicas",
    ),
    "duplicate key": (
        pool("replicas: 2\nreplicas: 3"),
        "pool.yaml:5: fogft.replicas: is given twice (first in line 4)",
        "keep one",
    ),
    "duplicate key in what is SkyPilot's": (
        pool(top="resources:\n  cpus: 1\n  cpus: 2"),
        "pool.yaml:3: resources.cpus: is given twice (first in line 2)",
        "keep one",
    ),
    "key that is no text": (
        pool(top="envs: {on: x}"),
        "pool.yaml:1: envs: the key `on` is not text in YAML",
        'put it in quotes: `"on":`',
    ),
    "list as a key": (
        "? [a]\n: b\n",
        "pool.yaml:1: a list or a map cannot be a key",
        "write text",
    ),
    # what must be there
    "no fogft": (
        "name: a\nrun: x\n",
        "pool.yaml:1: fogft: is missing",
        "add `fogft:` with `services:` below it",
    ),
    "empty fogft": (
        "run: x\nfogft:\n",
        "pool.yaml:2: fogft: must be a map of keys, not nothing",
        "write `fogft:` with `services:` below it",
    ),
    "empty services": (
        pool(services="[]"),
        "pool.yaml:3: fogft.services: is empty",
        "write a list, such as `services: [{name: /detect, type: my_msgs/srv/Detect}]`",
    ),
    "no run": (
        "fogft: {services: [{name: a, type: a/srv/A}]}\n",
        "pool.yaml:1: run: is missing",
        "write the command that starts your service, such as `run: exec python3 x.py`",
    ),
    "blank run": (
        "run: ' '\nfogft: {services: [{name: a, type: a/srv/A}]}\n",
        "pool.yaml:1: run: is empty",
        "write the command that starts your service, such as `run: exec python3 x.py`",
    ),
    "no name of a service": (
        pool(services="\n    - type: a/srv/A"),
        "pool.yaml:4: fogft.services[0].name: is missing",
        "write a name such as `/detect`",
    ),
    "no type": (
        pool(services="\n    - name: /a\n    - {name: /b, type: a/srv/A}"),
        "pool.yaml:4: fogft.services[0].type: is missing",
        "write `package/srv/Name`, such as `type: std_srvs/srv/SetBool`",
    ),
    # types
    "a tag on a text with a colon": (
        pool(top="envs: {a: !secret x:y}"),
        "pool.yaml:1: envs.a: the tag `!secret` is not allowed",
        "remove it",
    ),
    "percentage for a fraction": (
        pool("availability: 99.95"),
        "pool.yaml:4: fogft.availability: must be above 0 and at most 0.99999, not `99.95`",
        "write a fraction above 0 and at most 0.99999, such as `target: 0.99999`",
    ),
    "time for a number": (
        pool("max_hours: 1:30"),
        "pool.yaml:4: fogft.max_hours: must be a number, not the text `1:30`",
        "write a number of hours above 0 and at most 8000, such as `max_hours: 2.5`",
    ),
    "text for a whole number": (
        pool("replicas: two"),
        "pool.yaml:4: fogft.replicas: must be a whole number, not the text `two`",
        "write a whole number from 1 to 100; the default is 2",
    ),
    "fraction for a whole number": (
        pool("replicas: 2.0"),
        "pool.yaml:4: fogft.replicas: must be a whole number, not the number `2.0`",
        "write a whole number from 1 to 100; the default is 2",
    ),
    "truth value for a number": (
        pool("max_surge: yes"),
        "pool.yaml:4: fogft.max_surge: must be a whole number, not the boolean `true`",
        "write a whole number from 0 to 4; the default is 3",
    ),
    "nothing for a number": (
        pool("replicas:"),
        "pool.yaml:4: fogft.replicas: must be a whole number, not nothing",
        "write a whole number from 1 to 100; the default is 2",
    ),
    "text for a duration": (
        pool(services="[{name: a, type: a/srv/A, timeout_s: 2s}]"),
        "pool.yaml:3: fogft.services[0].timeout_s: must be a number, not the text `2s`",
        "write a number of seconds above 0 and at most 86400, such as `timeout_s: 2.5`",
    ),
    "list for a map": (
        pool("health: [1]"),
        "pool.yaml:4: fogft.health: must be a map of keys, not a list",
        "write `key: value` lines here",
    ),
    "map for a list": (
        pool(services="{/a: a/srv/A}"),
        "pool.yaml:3: fogft.services: must be a list, not a map",
        "write a list, such as `services: [{name: /detect, type: my_msgs/srv/Detect}]`",
    ),
    "text for a service": (
        pool(services="\n    - {name: /a, type: a/srv/A}\n    - /b"),
        "pool.yaml:5: fogft.services[1]: must be a map of keys, not the text `/b`",
        "write a list, such as `services: [{name: /detect, type: my_msgs/srv/Detect}]`",
    ),
    "list for the resources": (
        pool(top="resources: [a]"),
        "pool.yaml:1: resources: must be a map of keys, not a list",
        "write `key: value` lines here",
    ),
    "map without a repository for workdir": (
        pool(top="workdir: {x: {y: 1}}"),
        "pool.yaml:1: workdir: must be a folder or a repository, not `{'x': {'y': 1}}`",
        "write `workdir: .`, or `workdir: {url: ..., ref: ...}`",
    ),
    "list for use_spot": (
        pool(top="resources: {any_of: [{infra: aws}, {infra: gcp, use_spot: []}]}"),
        "pool.yaml:1: resources.any_of[1].use_spot: must be true or false, not a list",
        "write `use_spot: true` or `use_spot: false`",
    ),
    "time-out that is next to nothing": (
        pool(services="[{name: a, type: a/srv/A, timeout_s: 1.0e-320}]"),
        "pool.yaml:3: fogft.services[0].timeout_s: is too small: `1e-320`",
        "write a number of seconds above 0 and at most 86400, such as `timeout_s: 2.5`",
    ),
    "list for run": (
        "run: [a, b]\nfogft: {services: [{name: a, type: a/srv/A}]}\n",
        "pool.yaml:1: run: must be text, not a list",
        "write the command that starts your service, such as `run: exec python3 x.py`",
    ),
    "number for a name": (
        pool(top="name: 12"),
        "pool.yaml:1: name: must be text, not the number `12`",
        "use lower-case letters, digits and dashes, at most 40, such as `perception`; "
        "put it in quotes",
    ),
    "environment variable with no value": (
        pool(top="envs:\n  TOKEN:"),
        "pool.yaml:2: envs.TOKEN: must have a text as its value",
        'write `TOKEN: "..."`',
    ),
    "environment variable with no name": (
        pool(top="envs:\n  MY-TOKEN: x"),
        "pool.yaml:2: envs.MY-TOKEN: is not the name of an environment variable",
        "use letters, digits and `_`, and begin with no digit",
    ),
    "list instead of the file's map": (
        "- a\n",
        "pool.yaml:1: file: must be a map of keys, not a list",
        "write a SkyPilot task with a `fogft` section",
    ),
    # numbers
    "no replicas": (
        pool("replicas: 0"),
        "pool.yaml:4: fogft.replicas: must be from 1 to 100, not `0`",
        "write a whole number from 1 to 100; the default is 2",
    ),
    "too many replicas": (
        pool("replicas: 101"),
        "pool.yaml:4: fogft.replicas: must be from 1 to 100, not `101`",
        "write a whole number from 1 to 100; the default is 2",
    ),
    "too large a surge": (
        pool("max_surge: 5"),
        "pool.yaml:4: fogft.max_surge: must be from 0 to 4, not `5`",
        "write a whole number from 0 to 4; the default is 3",
    ),
    "negative time-out": (
        pool(services="[{name: a, type: a/srv/A, timeout_s: -1}]"),
        "pool.yaml:3: fogft.services[0].timeout_s: must be above 0 and at most 86400, not `-1`",
        "write a number of seconds above 0 and at most 86400, such as `timeout_s: 2.5`",
    ),
    "infinite time-out": (
        pool(services="[{name: a, type: a/srv/A, timeout_s: .inf}]"),
        "pool.yaml:3: fogft.services[0].timeout_s: must be finite, not `inf`",
        "write a number of seconds above 0 and at most 86400, such as `timeout_s: 2.5`",
    ),
    "time-out that is no number": (
        pool("health: {replace_after_s: .nan}"),
        "pool.yaml:4: fogft.health.replace_after_s: must be finite, not `nan`",
        "write a number of seconds above 0 and at most 86400, such as `replace_after_s: 2.5`",
    ),
    "no money": (
        pool("max_usd_per_hour: 0"),
        "pool.yaml:4: fogft.max_usd_per_hour: must be above 0 and at most 1e+06, not `0`",
        "write a number of US dollars per hour above 0 and at most 1e+06, "
        "such as `max_usd_per_hour: 2.5`",
    ),
    "money without an amount": (
        pool("max_usd_per_hour:"),
        "pool.yaml:4: fogft.max_usd_per_hour: must be a number, not nothing",
        "write a number of US dollars per hour above 0 and at most 1e+06, "
        "such as `max_usd_per_hour: 2.5`",
    ),
    # names
    "malformed type": (
        pool(services="[{name: a, type: nav_msgs/GetPlan}]"),
        "pool.yaml:3: fogft.services[0].type: `nav_msgs/GetPlan` is not a service type",
        "did you mean `nav_msgs/srv/GetPlan`?",
    ),
    "a message's type": (
        pool(services="[{name: a, type: nav_msgs/msg/Path}]"),
        "pool.yaml:3: fogft.services[0].type: `nav_msgs/msg/Path` is not a service type",
        "write `package/srv/Name`, such as `type: std_srvs/srv/SetBool`",
    ),
    "malformed name of a service": (
        pool(services="[{name: /de-tect, type: a/srv/A}]"),
        "pool.yaml:3: fogft.services[0].name: `/de-tect` is not a service name: "
        "only letters, digits, `_` and `/` are allowed",
        "write a name such as `/detect`",
    ),
    "private name of a service": (
        pool(services="[{name: ~/detect, type: a/srv/A}]"),
        "pool.yaml:3: fogft.services[0].name: `~/detect` is not a service name: "
        "private names and substitutions need a node; write the full name",
        "write a name such as `/detect`",
    ),
    "duplicate service": (
        pool(services="\n    - {name: /a, type: a/srv/A}\n    - {name: a, type: b/srv/B}"),
        "pool.yaml:5: fogft.services[1].name: `/a` is listed twice (first in line 4)",
        "give each only one entry",
    ),
    "malformed field": (
        pool(services="[{name: a, type: a/srv/A, ok_field: result.ok}]"),
        "pool.yaml:3: fogft.services[0].ok_field: `result.ok` is not the name of a field",
        "name a boolean field, such as `success`",
    ),
    "unknown choice": (
        pool(services="[{name: a, type: a/srv/A, on_timeout: emty}]"),
        "pool.yaml:3: fogft.services[0].on_timeout: must be `silent` or `empty` or "
        "`fallback`, not `emty`",
        "did you mean `empty`?",
    ),
    "unknown hedging": (
        pool(services="[{name: a, type: a/srv/A, hedging: failoer}]"),
        "pool.yaml:3: fogft.services[0].hedging: must be `auto` or `all` or `failover`, "
        "not `failoer`",
        "did you mean `failover`?",
    ),
    "hedging of another name now": (
        pool(services="[{name: a, type: a/srv/A, hedging: adaptive}]"),
        "pool.yaml:3: fogft.services[0].hedging: must be `auto` or `all` or `failover`, "
        "not `adaptive`",
        "is now called `auto`, which is the default",
    ),
    "key that is gone": (
        pool(services="[{name: a, type: a/srv/A, hedging_budget: 0.2}]"),
        "pool.yaml:3: fogft.services[0].hedging_budget: is no longer a key",
        "remove it: the default is right",
    ),
    "key with another name now": (
        pool(services="[{name: a, type: a/srv/A, replicas: 4}]"),
        "pool.yaml:3: fogft.services[0].replicas: is not a key of a service",
        "put this service into its own pool, with that many replicas",
    ),
    "advanced key beside the others": (
        pool(services="[{name: a, type: a/srv/A, trace: true}]"),
        "pool.yaml:3: fogft.services[0].trace: unknown key",
        "`trace` belongs in a service, under `fogft.services`, in `advanced`",
    ),
    "wrong value of an advanced key": (
        pool(services="[{name: a, type: a/srv/A, advanced: {trace: 1}}]"),
        "pool.yaml:3: fogft.services[0].advanced.trace: must be true or false, not the number `1`",
        "write `trace: true` or `trace: false`",
    ),
    "fallback without a service": (
        pool(services="[{name: a, type: a/srv/A, on_timeout: fallback}]"),
        "pool.yaml:3: fogft.services[0].fallback_service: is missing",
        "name a service of the same type on the robot, such as "
        "`fallback_service: {name: /a_onboard}`",
    ),
    "fallback that is not used": (
        pool(services="[{name: a, type: a/srv/A, fallback_service: {name: b}}]"),
        "pool.yaml:3: fogft.services[0].fallback_service: is not used: `on_timeout` is not "
        "`fallback`",
        "write `on_timeout: fallback`, or remove it",
    ),
    "fallback that is the service": (
        pool(
            services="[{name: a, type: a/srv/A, on_timeout: fallback, fallback_service: {name: a}}]"
        ),
        "pool.yaml:3: fogft.services[0].fallback_service.name: is the service itself",
        "write the name of a service on the robot, such as `fallback_service: {name: /a_onboard}`",
    ),
    "fallback after the deadline": (
        pool(
            services="[{name: a, type: a/srv/A, timeout_s: 2, on_timeout: fallback, "
            "fallback_service: {name: b, after_s: 2}}]"
        ),
        "pool.yaml:3: fogft.services[0].fallback_service.after_s: must be below `timeout_s`, "
        "which is 2",
        "make it shorter, or remove it: at the deadline the fallback is asked anyway",
    ),
    "cancel service and concurrency": (
        pool(services="[{name: a, type: a/srv/A, cancel: stop, concurrency: 4}]"),
        "pool.yaml:3: fogft.services[0].concurrency: must be 1 with a `cancel` service, "
        "which cannot tell requests apart",
        "remove one of the two",
    ),
    "cancel service that is the service": (
        pool(services="[{name: a, type: a/srv/A, cancel: /a}]"),
        "pool.yaml:3: fogft.services[0].cancel: is the service itself",
        "write the name of its cancel service, such as `cancel: /a_cancel`",
    ),
    "concurrency of nothing": (
        pool(services="[{name: a, type: a/srv/A, concurrency: 0}]"),
        "pool.yaml:3: fogft.services[0].concurrency: must be from 1 to 512, not `0`",
        "write a whole number from 1 to 512",
    ),
    "hedging for the whole pool": (
        pool("hedging: adaptive"),
        "pool.yaml:4: fogft.hedging: unknown key",
        "`hedging` belongs in a service, under `fogft.services`",
    ),
    "bad name of the pool": (
        pool(top="name: My Pool"),
        "pool.yaml:1: name: `My Pool` is not a pool name",
        "use lower-case letters, digits and dashes, at most 40, such as `my-pool`",
    ),
    # YAML
    "empty file": (
        "",
        "pool.yaml:1: the file is empty",
        "`fogft init` writes a working example",
    ),
    "only comments": (
        "# nothing\n",
        "pool.yaml:1: the file is empty",
        "`fogft init` writes a working example",
    ),
    "tabs": (
        "run: x\nfogft:\n\tservices: []\n",
        "pool.yaml:3: not YAML: found character '\\t' that cannot start any token, "
        "while scanning for the next token",
        "indent with spaces: YAML allows no tabs",
    ),
    "syntax": (
        "run: x\nfogft: {services: [\n",
        "pool.yaml:3: not YAML: expected the node content, but found '<stream end>', "
        "while parsing a flow node",
        "check this line's indentation, colons, quotes and brackets",
    ),
    "colon in a text": (
        "run: echo a: b\n",
        "pool.yaml:1: not YAML: mapping values are not allowed here",
        "put a text that contains `: ` in quotes, and check the indentation",
    ),
    "two documents": (
        "run: x\n---\nrun: y\n",
        "pool.yaml:2: not YAML: but found another document, "
        "expected a single document in the stream",
        "keep one document: remove the second `---`",
    ),
    "undefined alias": (
        "run: *x\n",
        "pool.yaml:1: not YAML: found undefined alias 'x'",
        "define it with `&` first, or put a text that begins with `*` in quotes",
    ),
    "tag that makes an object": (
        "run: !!python/object/apply:os.system [echo]\n",
        "pool.yaml:1: run: the tag `!!python/object/apply:os.system` is not allowed",
        "remove it",
    ),
    "tag that does not fit": (
        pool("replicas: !!int two"),
        "pool.yaml:4: fogft.replicas: `two` cannot be read as `int`",
        "remove the tag, or correct the value",
    ),
    "number without end": (
        pool("replicas: " + "9" * 5000),
        "pool.yaml:4: fogft.replicas: `" + "9" * 57 + "...` is too long a number",
        "shorten it",
    ),
    "control character": (
        "run: x\nsetup: 'a\x07'\n",
        "pool.yaml:2: not YAML: character \\x07 is not allowed",
        "remove it",
    ),
    "escape beyond Unicode": (
        'run: x\nsetup: "\\U7FFFFFFF"\n',
        "pool.yaml:2: not YAML: chr() arg not in range(0x110000)",
        "check this line's syntax",
    ),
    "half a character": (
        'run: x\nsetup: "\\uD800"\n',
        "pool.yaml:2: setup: holds a character that is not text",
        "remove it",
    ),
    "nested too deeply": (
        "run: " + "[" * 100_000,
        "pool.yaml:1: nested deeper than 40 levels",
        "flatten it",
    ),
    "alias of itself": (
        "envs: &a\n  b: *a\n",
        "pool.yaml:1: envs.b: contains itself through an alias",
        "write it out",
    ),
    "billion laughs": (
        "\n".join(["a0: &a0 [x]"] + [f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}]" for i in range(1, 9)]),
        "pool.yaml:1: the file holds more than 20000 values, aliases expanded",
        "a pool file is short; is this the right file?",
    ),
    "more values than a pool file has": (
        "run: x\nenvs: [" + "1," * 30_000 + "]\n",
        "pool.yaml:2: the file holds more than 20000 values, aliases expanded",
        "a pool file is short; is this the right file?",
    ),
}


@pytest.mark.parametrize(("source", "message", "hint"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_told_exactly(source, message, hint):
    """Each mistake has one message with file, line and key, and one hint."""
    assert fault(source) == (message, hint)


def test_a_type_that_cannot_be_loaded():
    def check(type_name):
        lacking = SpecError("`b/srv/B`; it has no module\n`b`", "install it")
        return lacking if type_name == "b/srv/B" else None

    source = pool(services="\n    - {name: a, type: a/srv/A}\n    - name: b\n      type: b/srv/B")
    assert fault(source, types=check) == (
        "pool.yaml:6: fogft.services[1].type: `b/srv/B`; it has no module\\n`b`",
        "install it",
    )


def test_a_field_that_the_response_lacks():
    def check(type_name, field):
        assert (type_name, field) == ("b/srv/B", "done")
        what = "the response of `b/srv/B` has no boolean field `done`"
        return SpecError(what, "its boolean fields: ok")

    source = pool(
        services="\n    - {name: a, type: a/srv/A}\n"
        "    - name: b\n      type: b/srv/B\n      ok_field: done"
    )
    assert fault(source, fields=check) == (
        "pool.yaml:7: fogft.services[1].ok_field: "
        "the response of `b/srv/B` has no boolean field `done`",
        "its boolean fields: ok",
    )


def test_a_workdir_that_does_not_exist(tmp_path):
    """`workdir` begins at the file's own folder, wherever the command is run."""
    (tmp_path / "src").mkdir()
    (tmp_path / "file").touch()
    for good in ("src", ".", str(tmp_path), "https://example.org/a.git", "{url: x}"):
        file.parse(pool(top=f"workdir: {good}"), file="p.yaml", folder=tmp_path)
    for bad in ("scr", "file", "src/../x"):
        assert fault(pool(top=f"workdir: {bad}"), folder=tmp_path) == (
            f"pool.yaml:1: workdir: there is no folder `{(tmp_path / bad).resolve()}`",
            "a relative path begins at the pool file's own folder",
        )


def test_the_files_stem_names_the_pool():
    assert file.parse(pool(), file="some/where/my-pool.yaml").name == "my-pool"


def test_a_stem_that_is_no_pool_name():
    with pytest.raises(SpecError) as caught:
        file.parse(pool(), file="My Pool.yaml")
    assert caught.value.message == (
        "My Pool.yaml:1: name: is missing, and the file's own name `My Pool` is not a pool name"
    )
    assert caught.value.hint == "add `name: my-pool`"


def test_what_is_skypilots_passes_untouched():
    """Dates stay text, merges are done, and nothing else of the task changes."""
    top = """\
resources: &r
  any_of: [{infra: aws}]
  cpus: 4+
config:
  <<: *r
  cpus: 8
  day: 2024-01-02
"""
    assert file.parse(pool(top=top), file="p.yaml").task == {
        "resources": {"any_of": [{"infra": "aws"}], "cpus": "4+"},
        "config": {"any_of": [{"infra": "aws"}], "cpus": 8, "day": "2024-01-02"},
        "run": "x",
    }


class TestReading:
    """Files that cannot be read at all."""

    def fault(self, path):
        with pytest.raises(SpecError) as caught:
            file.read(path)
        return caught.value.message, caught.value.hint

    def test_a_good_file(self, tmp_path):
        path = tmp_path / "echo.yaml"
        path.write_bytes(b"\xef\xbb\xbf" + pool().encode())
        assert file.read(path) == file.read(str(path))
        assert file.read(path).name == "echo"

    def test_no_such_file(self, tmp_path):
        assert self.fault(tmp_path / "a.yaml") == (
            f"{tmp_path}/a.yaml: no such file",
            "check the path, or run `fogft init` for a working example",
        )

    def test_a_folder(self, tmp_path):
        assert self.fault(tmp_path) == (
            f"{tmp_path}: is a folder, not a pool file",
            f"name the file in it, such as `{tmp_path}/pool.yaml`",
        )

    @needs("not-root")
    def test_no_permission(self, tmp_path):
        path = tmp_path / "a.yaml"
        path.touch(0)
        assert self.fault(path)[0] == f"{path}: cannot be read: Permission denied"

    def test_a_file_below_a_file(self, tmp_path):
        (tmp_path / "a").touch()
        path = tmp_path / "a" / "b.yaml"
        assert self.fault(path)[0] == f"{path}: cannot be read: Not a directory"

    def test_not_utf8(self, tmp_path):
        path = tmp_path / "a.yaml"
        path.write_bytes(b"run: x\nname: caf\xe9\n")
        assert self.fault(path) == (
            f"{path}:2: is not UTF-8 text: invalid continuation byte",
            "save it as UTF-8",
        )

    def test_without_end(self):
        """A device that never ends is read no further than the limit."""
        assert self.fault("/dev/zero") == (
            "/dev/zero: is larger than 1 MiB",
            "a pool file is short; is this the right file?",
        )


words = st.sampled_from(
    ["run", "fogft", "services", "name", "type", "replicas", "a/srv/A", "&a", "*a", "<<", "!!int"]
)
pieces = st.sampled_from([": ", "\n", "\n  ", "- ", "{", "}", "[", "]", ",", "|", '"', "#", "? "])
yaml_like = st.lists(words | pieces | st.text(max_size=3), max_size=40).map("".join)


@settings(max_examples=by_day(60, at_night=1000))
@given(source=yaml_like | st.text(max_size=60))
@example(source="!!bool x: 1")
@example(source="a: !!timestamp x")
@example(source="1:1:1:1: 2")
@example(source="? !!null\n: b")
@example(source='"\\U7FFFFFFF"')
def test_no_text_makes_anything_but_a_spec_error(source):
    """Whatever stands in the file, it is read or refused in one line that names the file."""
    try:
        message = f"p.yaml: {file.parse(source, file='p.yaml').services}"
    except SpecError as error:
        message = error.message + error.hint
    assert message.startswith("p.yaml:")
    assert "\n" not in message


printable = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=6)
whole = st.integers(-(10**40), 10**40)
documents = st.recursive(
    st.none() | st.booleans() | whole | st.floats() | printable | st.dates(),
    lambda child: st.lists(child, max_size=3) | st.dictionaries(printable, child),
    max_leaves=15,
)


def dates_as_text(value):
    if isinstance(value, dict):
        return {key: dates_as_text(child) for key, child in value.items()}
    if isinstance(value, list):
        return [dates_as_text(child) for child in value]
    return value.isoformat() if isinstance(value, datetime.date) else value


@given(document=documents)
def test_a_tree_holds_what_the_yaml_says(document):
    """Our own conversion agrees with PyYAML's, but for dates, which stay text."""
    source = yaml.safe_dump(document, allow_unicode=True)
    read_back = plain(yaml_tree.tree(source, "p.yaml"))
    assert repr(read_back) == repr(dates_as_text(yaml.safe_load(source)))


@given(source=st.binary(max_size=40))
def test_no_bytes_make_anything_but_a_spec_error(source, tmp_path_factory):
    """A file may hold anything at all; 40 bytes hold no pool."""
    path = tmp_path_factory.mktemp("fuzz") / "p.yaml"
    path.write_bytes(source)
    with pytest.raises(SpecError, match=rf"^{re.escape(str(path))}:"):
        file.read(path)


def test_a_file_without_services_leaves_it_to_what_run_offers():
    spec = file.parse("run: x\nfogft: {replicas: 2}\n", file="pool.yaml")
    assert spec.services == spec.proxied == ()
    found = replace(spec, discovered=(ServiceSpec("/a", "a/srv/A"),))
    assert found.proxied == found.discovered
    assert found.replica_hash == spec.replica_hash


def test_names_that_no_probe_could_tell_are_refused_before_anything_starts():
    def named(length):
        names = [f"/{number:0{length - 1}}x" for number in range(400)]
        services = [{"name": name.replace("/0", "/a"), "type": "a/srv/B"} for name in names]
        return f"run: x\nfogft: {json.dumps({'services': services})}\n"

    assert len(file.parse(named(120), file="pool.yaml").services) == 400
    with pytest.raises(SpecError, match="have names of 80400 bytes in total; the limit is 65536"):
        file.parse(named(200), file="pool.yaml")
