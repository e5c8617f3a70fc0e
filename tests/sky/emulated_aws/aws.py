"""An emulated AWS: moto's EC2, IAM and STS, whose instances are VMs that really answer ssh.

Three servers, all inside a network namespace of the test's own:

* port 5566: AWS's interface. An instance that runs is a `vm.sh`; terminating kills it.
* 169.254.169.254:80: instance metadata (version 2, with token), each VM by its own address.
* port 5567: what a test does to the cloud, and what it may look at.
    GET  /instances                     all of them, of all regions
    GET  /log                           what happened, with times
    POST /capacity?place=P&has=0|1      P: a region or a zone; without capacity for spot
    POST /notice?id=I&in_s=S            a preemption notice: taken in S seconds (AWS: 120)
    POST /rebalance?id=I                a rebalance recommendation
    POST /late?s=S                      new instances are listed only S seconds after they are made
    POST /preempt?id=I                  taken now
    POST /quota?region=R&code=C&vcpus=N  a quota of the account
    POST /deny?action=A                 A is not allowed any more; without A all is again

With `ENFORCED` set, who launches may do what the policy of docs/how-to/clouds.md allows, and a VM
what its role allows (`policy`).
"""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.parse
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import boto3
import flask
import yaml
from moto.core.exceptions import ServiceException
from moto.core.responses import ActionResult, BaseResponse
from moto.ec2.exceptions import EC2ClientError
from moto.ec2.models import ec2_backends, elastic_network_interfaces, instances
from moto.ec2.responses import spot_instances
from moto.server import ThreadedMotoServer
from moto.servicequotas.exceptions import NoSuchResource
from moto.servicequotas.models import ServiceQuotasBackend

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[2]))
from tests.sky.emulated_aws.http_answers import Answers  # noqa: E402
from tests.sky.emulated_aws.policy import OF_VMS, PAGE, Policy, statements  # noqa: E402

IMAGE = Path(os.environ["EMULATION"])
HIDDEN = [folder for folder in os.environ.get("HIDDEN", "").split(":") if folder]
SPOT = {"us-east-1": 0.019, "us-west-2": 0.024, "eu-west-1": 0.039}
REGIONS = tuple(SPOT)
EACH_BOOT = "for one in /var/lib/cloud/scripts/per-boot/*; do $one; done"  # as cloud-init does
METADATA = "169.254.169.254"


class World:
    """What is not in moto: the VMs, capacity and notices."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.full: set[str] = set()
        self.late_s = 0.0
        self.made_at: dict[str, float] = {}
        self.quotas: dict[tuple[str, str], float] = {}
        self.vms: dict[str, subprocess.Popen[bytes]] = {}
        self.notices: dict[str, str] = {}
        self.rebalance: dict[str, str] = {}
        self.log: list[dict[str, Any]] = []
        self._addresses = (f"10.66.{n // 250}.{n % 250 + 1}" for n in itertools.count(2))

    def address(self, *_: Any, **__: Any) -> str:
        return next(self._addresses)

    def say(self, event: str, **what: Any) -> None:
        self.log.append({"event": event, "at": time.time(), **what})
        print(json.dumps(self.log[-1]), flush=True)

    def boot(self, instance: Any, *, again: bool = False) -> None:
        """Start an instance's VM; `again` with the disk that it had when it was stopped."""
        cloud_config = config_of(instance)
        account = cloud_config["users"][0]
        user, key = account["name"], account["ssh_authorized_keys"][0]
        first = EACH_BOOT if again else "\n".join(cloud_config.get("runcmd") or [])
        name = "f" + instance.id[-8:]
        with (IMAGE / f"{instance.id}.log").open("wb") as log:
            self.vms[instance.id] = subprocess.Popen(
                ["bash", HERE / "vm.sh", name, instance.public_ip, IMAGE, IMAGE / "host", user, key,
                 first, *HIDDEN],
                stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        threading.Thread(target=self.watch, args=(instance,), daemon=True).start()
        spot = getattr(instance, "lifecycle", None) == "spot"
        self.say(
            "boot", id=instance.id, ip=instance.public_ip, zone=instance.placement.zone, spot=spot
        )

    def watch(self, instance: Any) -> None:
        """Notice when a VM has shut itself down: then it has ended, or is stopped."""
        with self.lock:
            vm = self.vms.get(instance.id)
        if vm is None:
            return
        vm.wait()
        with self.lock:
            by_itself = instance.id in self.vms
        if by_itself:
            self.say("shutdown", id=instance.id)
            spot = getattr(instance, "lifecycle", None) == "spot"
            ends = spot or instance.instance_initiated_shutdown_behavior == "terminate"
            self.end(instance.id) if ends else instance.stop()

    def kill(self, id: str, *, keeps_disk: bool = False) -> None:
        with self.lock:
            vm = self.vms.pop(id, None)
        if vm is None:
            return
        # Its network first: a machine that is taken away says goodbye to nobody.
        subprocess.run(
            ["ip", "link", "set", f"vf{id[-8:]}", "down"], check=False, capture_output=True
        )
        with contextlib.suppress(ProcessLookupError):  # it has shut itself down
            os.killpg(vm.pid, signal.SIGKILL)
        vm.wait()
        name = "f" + id[-8:]
        subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)
        if not keeps_disk:
            subprocess.run(["rm", "-rf", IMAGE / "vm" / name], check=False)
        self.say("kill", id=id)

    def preempt(self, id: str) -> None:
        self.say("preempt", id=id)
        self.end(id)

    def end(self, id: str) -> None:
        for _, backend, instance in all_instances():
            if instance.id == id and instance.state != "terminated":
                backend.terminate_instances([id])


def let_in(instance: Any) -> str:
    """Return the rules of a VM's security groups, as nftables reads them."""
    rules = []
    for group in instance.security_groups:
        for rule in group.ingress_rules:
            ports = f"{rule.from_port}-{rule.to_port}" if rule.ip_protocol == "tcp" else "0-65535"
            source = (rule.ip_range or {}).get("CidrIp")
            if source:
                rules.append(f"ip saddr {source} tcp dport {ports} accept")
    return "\n".join(
        (
            "flush ruleset", "table inet groups {", "chain input {",
            "type filter hook input priority 0; policy drop;",
            "ct state established,related accept", "iif lo accept", *sorted(rules), "}", "}\n",
        )
    )  # fmt: skip


def hold_groups() -> None:
    """See to it that every VM lets in what its security groups say, as they change."""
    held: dict[str, str] = {}
    while True:
        for _, _, instance in list(all_instances()):
            rules = let_in(instance)
            if instance.id in WORLD.vms and held.get(instance.id) != rules:
                words = ["ip", "netns", "exec", f"f{instance.id[-8:]}", "nft", "-f", "-"]
                done = subprocess.run(words, input=rules.encode(), check=False, capture_output=True)
                if done.returncode == 0:  # else its network is not there yet
                    held[instance.id] = rules
                elif b"syntax" in done.stderr:
                    raise AssertionError(f"nftables does not understand: {rules}")
        time.sleep(0.2)


WORLD = World()


def config_of(instance: Any) -> dict[str, Any]:
    """Return what SkyPilot asks cloud-init for: an account with a key, and commands to run."""
    text = str(instance.user_data or "")
    for _ in range(3):  # encoded by boto3, and kept encoded by moto
        if text.startswith("#cloud-config"):
            break
        text = base64.b64decode(text).decode()
    return dict(yaml.safe_load(text))


def all_instances() -> Iterator[tuple[str, Any, Any]]:
    for account in list(ec2_backends.values()):
        for region, backend in list(account.items()):
            for reservation in list(backend.reservations.values()):
                for instance in reservation.instances:
                    yield region, backend, instance


def patch_moto() -> None:
    elastic_network_interfaces.random_public_ip = WORLD.address
    run = instances.InstanceBackend.run_instances
    describe = instances.InstanceBackend.describe_instances

    def describe_instances(self: Any, filters: Any = None) -> Any:
        since = time.time() - WORLD.late_s
        found = describe(self, filters)
        return [one for one in found if WORLD.made_at[one.instances[0].id] <= since]

    def run_instances(self: Any, image: str, count: int, data: Any, groups: Any, **kw: Any) -> Any:
        zone = kw.get("placement") or ""
        for card in kw.get("nics") or []:
            if card.get("SubnetId"):
                zone = self.get_subnet(card["SubnetId"]).availability_zone
        if kw.get("instance_market_options") and WORLD.full & {zone, self.region_name}:
            WORLD.say("refused", zone=zone)
            raise EC2ClientError(
                "InsufficientInstanceCapacity",
                f"There is no Spot capacity available that matches your request in {zone}.",
            )
        made = run(self, image, count, data, groups, **kw)
        named = [id for card in kw.get("nics") or [] for id in card.get("Groups") or []]
        for instance in made.instances:
            # moto keeps these with the network interface only.
            instance.security_groups = list(map(self.get_security_group_from_id, named))
            WORLD.made_at[instance.id] = time.time()
            WORLD.boot(instance)
        return made

    instances.InstanceBackend.run_instances = run_instances
    instances.InstanceBackend.describe_instances = describe_instances
    spot_instances.SpotInstances.describe_spot_price_history = price_history
    ServiceQuotasBackend.get_service_quota = quota_of
    for name in ("terminate", "stop"):
        setattr(instances.Instance, name, killing(getattr(instances.Instance, name)))
    instances.Instance.start = starting(instances.Instance.start)


# As somebody is called who has logged in by SSO.
LOGIN = (
    "arn:aws:sts::123456789012:assumed-role/AWSReservedSSO_RoboticsLabPowerUsers_0123456789abcdef/"
    "firstname.lastname@robotics.example.com"
)
LAUNCHER, VM = Policy(statements(PAGE.read_text())), Policy(OF_VMS)


def enforce() -> None:
    """Refuse what the policies do not allow, in AWS's words."""
    call = BaseResponse.call_action

    def call_action(self: Any) -> Any:
        action = f"{self.service_name.replace('-', '')}:{self._get_action()}"
        mine = flask.request.remote_addr == "127.0.0.1"

        def tags() -> list[dict[str, str]]:
            one = self._get_param("InstanceId", None)
            wanted = set(self._get_param("InstanceIds", None) or [one])
            found = [i for _, _, i in all_instances() if i.id in wanted]
            return [{tag["key"]: tag["value"] for tag in one.get_tags()} for one in found]

        policy = LAUNCHER if mine else VM
        if policy.allows(action, tags):
            tagged = self._get_param("TagSpecifications", None)
            tagged = tagged or self._get_param("TagSpecification", None) or []
            kinds = {str(one["ResourceType"]) for one in tagged}
            if not all(policy.allows("ec2:CreateTags", tags, kind) for kind in kinds):
                action = "ec2:CreateTags"
            elif self._get_param("IamInstanceProfile", None) and not policy.allows(
                "iam:PassRole", tags
            ):
                action = "iam:PassRole"
            else:
                return call(self)
        who = LOGIN if mine else "arn:aws:iam::123456789012:role/skypilot-v1"
        WORLD.say("denied", action=action, by=who)
        code, does = "AccessDenied", ""
        if self.service_name == "ec2":
            code, does = (
                "UnauthorizedOperation",
                "You are not authorized to perform this operation. ",
            )
        subject = "arn:aws:iam::123456789012:role/skypilot-v1"
        if not action.startswith("iam:"):
            subject = f"arn:aws:ec2:{self.region}:123456789012:instance/*"
        words = (
            f"{does}User: {who} is not authorized to perform: {action} on resource: {subject} "
            f"because no identity-based policy allows the {action} action."
        )
        if self.service_name == "ec2":
            words += f" Encoded authorization failure message: {'Zm9nZnQ' * 120}"
        # moto tells by an exception's module in which service's words it is.
        denied = type("Denied", (ServiceException,), {"__module__": type(self).__module__})
        error = denied(words)
        error.code = code
        return self.serialized(ActionResult(error))

    BaseResponse.call_action = call_action


def price_history(self: Any) -> ActionResult:
    """Answer with prices a little below the catalogue's, so that a test can tell them apart."""
    kinds = self._get_param("InstanceTypes", [])
    region = self.ec2_backend.region_name
    found = self.ec2_backend.describe_spot_price_history(kinds, {})
    cpus = {"m6i.large": 2, "m6i.xlarge": 4}
    return ActionResult(
        {
            "SpotPriceHistory": [
                {
                    "InstanceType": p["InstanceType"],
                    "ProductDescription": "Linux/UNIX",
                    "SpotPrice": f"{SPOT[region] * cpus.get(p['InstanceType'], 2) / 2:.6f}",
                    "AvailabilityZone": p["Location"],
                    "Timestamp": f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ}",
                }
                for p in found
            ]
        }
    )


def quota_of(self: Any, service_code: str, quota_code: str) -> dict[str, Any]:
    """Answer with what a test has set; moto knows none of EC2's."""
    value = WORLD.quotas.get((self.region_name, quota_code)) if service_code == "ec2" else None
    if value is None:
        raise NoSuchResource
    return {"QuotaCode": quota_code, "Value": value}


def killing(method: Any) -> Any:
    def wrapped(self: Any, *args: Any, **kw: Any) -> Any:
        WORLD.kill(self.id, keeps_disk=method.__name__ == "stop")
        return method(self, *args, **kw)

    return wrapped


def starting(method: Any) -> Any:
    """Boot a stopped instance; moto gives it another address, as AWS does."""

    def wrapped(self: Any, *args: Any, **kw: Any) -> Any:
        found = method(self, *args, **kw)
        WORLD.boot(self, again=True)
        return found

    return wrapped


class Control(Answers, BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        if self.path == "/log":
            return self.answer(WORLD.log)
        return self.answer(
            [
                {
                    "id": i.id, "region": region, "zone": i.placement.zone, "state": i.state,
                    "ip": i.public_ip, "spot": getattr(i, "lifecycle", None) == "spot",
                    "labels": {tag["key"]: tag["value"] for tag in i.get_tags()},
                }
                for region, _, i in all_instances()
            ]
        )  # fmt: skip

    def do_POST(self) -> None:
        url = urllib.parse.urlparse(self.path)
        asked = dict(urllib.parse.parse_qsl(url.query))
        now = datetime.now(timezone.utc)
        if url.path == "/capacity":
            (WORLD.full.discard if asked["has"] == "1" else WORLD.full.add)(asked["place"])
        elif url.path == "/preempt":
            WORLD.preempt(asked["id"])
        elif url.path == "/notice":
            in_s = float(asked["in_s"])
            WORLD.notices[asked["id"]] = f"{now + timedelta(seconds=in_s):%Y-%m-%dT%H:%M:%SZ}"
            WORLD.say("notice", id=asked["id"], in_s=in_s)
            timer = threading.Timer(in_s, WORLD.preempt, [asked["id"]])
            timer.daemon = True
            timer.start()
        elif url.path == "/quota":
            WORLD.quotas[asked["region"], asked["code"]] = float(asked["vcpus"])
        elif url.path == "/deny":
            LAUNCHER.taken = {asked["action"]} if "action" in asked else set()
        elif url.path == "/late":
            WORLD.late_s = float(asked["s"])
        elif url.path == "/rebalance":
            WORLD.rebalance[asked["id"]] = f"{now:%Y-%m-%dT%H:%M:%SZ}"
        else:
            return self.answer({"error": "not found"}, 404)
        return self.answer({})


class Metadata(Answers, BaseHTTPRequestHandler):
    """Instance metadata, version 2 only: a request without a token is refused."""

    def do_PUT(self) -> None:
        ttl = self.headers.get("X-aws-ec2-metadata-token-ttl-seconds")
        self.answer("t0k3n" if ttl else "", 200 if ttl else 400)

    def do_GET(self) -> None:
        if self.headers.get("X-aws-ec2-metadata-token") != "t0k3n":
            return self.answer("", 401)
        found = next(
            (i for _, _, i in all_instances()
             if i.public_ip == self.client_address[0] and i.state == "running"), None,
        )  # fmt: skip
        if found is None:
            return self.answer("", 404)
        credentials = {
            "Code": "Success", "Type": "AWS-HMAC", "AccessKeyId": "test", "Token": "test",
            "SecretAccessKey": "test", "LastUpdated": "2024-01-01T00:00:00Z",
            "Expiration": "2099-01-01T00:00:00Z",
        }  # fmt: skip
        taken = WORLD.notices.get(found.id)
        recommended = WORLD.rebalance.get(found.id)
        answers: dict[str, Any] = {
            "instance-id": found.id,
            "placement/availability-zone": found.placement.zone,
            "iam/security-credentials/": "skypilot-v1",
            "iam/security-credentials/skypilot-v1": credentials,
            "spot/instance-action": taken and {"action": "terminate", "time": taken},
            "events/recommendations/rebalance": recommended and {"noticeTime": recommended},
        }
        body = answers.get(self.path.removeprefix("/latest/meta-data/"))
        return self.answer(body, 200) if body else self.answer("", 404)


def prepare_account() -> None:
    """Make what an account has: subnets that lead somewhere, and SkyPilot's role.

    SkyPilot would make the role itself, and then sleep 30 s for it to spread.
    """
    access = {"aws_access_key_id": "test", "aws_secret_access_key": "test",
              "endpoint_url": "http://127.0.0.1:5566"}  # fmt: skip
    iam = boto3.client("iam", region_name="us-east-1", **access)
    iam.create_instance_profile(InstanceProfileName="skypilot-v1")
    iam.create_role(RoleName="skypilot-v1", AssumeRolePolicyDocument="{}")
    of_vms = json.dumps({"Version": "2012-10-17", "Statement": OF_VMS})
    iam.put_role_policy(RoleName="skypilot-v1", PolicyName="lab", PolicyDocument=of_vms)
    iam.add_role_to_instance_profile(InstanceProfileName="skypilot-v1", RoleName="skypilot-v1")
    for region in REGIONS:
        ec2 = boto3.client("ec2", region_name=region, **access)
        default = [{"Name": "is-default", "Values": ["true"]}]
        vpc = ec2.describe_vpcs(Filters=default)["Vpcs"][0]["VpcId"]
        gateway = ec2.create_internet_gateway()["InternetGateway"]["InternetGatewayId"]
        ec2.attach_internet_gateway(InternetGatewayId=gateway, VpcId=vpc)
        of_vpc = [{"Name": "vpc-id", "Values": [vpc]}]
        table = ec2.describe_route_tables(Filters=of_vpc)["RouteTables"][0]["RouteTableId"]
        ec2.create_route(RouteTableId=table, DestinationCidrBlock="0.0.0.0/0", GatewayId=gateway)


def main() -> None:
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    patch_moto()
    ThreadedMotoServer(ip_address="0.0.0.0", port=5566, verbose=False).start()
    prepare_account()
    if os.environ.get("ENFORCED"):
        enforce()

    def stop(*_: Any) -> None:
        for id in list(WORLD.vms):
            WORLD.kill(id)
        os._exit(0)

    signal.signal(signal.SIGTERM, stop)
    threading.Thread(target=hold_groups, daemon=True).start()
    metadata = ThreadingHTTPServer((METADATA, 80), Metadata)
    threading.Thread(target=metadata.serve_forever, daemon=True).start()
    ThreadingHTTPServer(("127.0.0.1", 5567), Control).serve_forever()


if __name__ == "__main__":
    sys.exit(main())
