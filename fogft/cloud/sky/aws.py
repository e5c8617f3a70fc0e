"""AWS through its own API (boto3, which comes with SkyPilot's AWS support). See `provider`."""

import contextlib
import datetime
import hashlib
import importlib
import json
import os
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from fogft.cloud.notice_formats import moment
from fogft.cloud.sky import naming
from fogft.cloud.sky.failures import classify, plain
from fogft.cloud.sky.provider import Instance, NotAllowedError
from fogft.errors import CloudError, CloudUnreachable
from fogft.model.reason import Cause
from fogft.model.replica import Placement

_ALIVE = ["pending", "running", "stopping", "stopped"]  # a stopped machine's disk still costs money
_FORBIDDEN = ("UnauthorizedOperation", "AccessDenied", "AccessDeniedException")
_HOME = "us-east-1"  # any region lists the others
ROLE = "skypilot-v1"
_ENDS_IN_ENVIRONMENT = ("AWS_CREDENTIAL_EXPIRATION", "AWS_SESSION_EXPIRATION")
_ENDS_IN_PROFILE = ("aws_expiration", "expiration", "x_security_token_expires")  # by login tools
_MIGHTY = ("AdministratorAccess", "PowerUserAccess")


class Aws:
    """AWS's own API; see `fogft.cloud.sky.provider.Provider`."""

    cloud = "aws"

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._session: Any = None
        # By service and region: thread-safe, and each takes megabytes.
        self.clients: dict[tuple[str, str], Any] = {}

    def instances(self, regions: Iterable[str] | None, pool_uid: str = "") -> Sequence[Instance]:
        """See `Provider`. Queries regions in parallel.

        Without `regions` some may refuse: many accounts are barred from most and run nothing there.
        """
        where = sorted(set(self.regions() if regions is None else regions))
        if not where:
            return []
        refused: list[NotAllowedError] = []

        def ask(region: str) -> Sequence[Instance]:
            try:
                return self._instances_in(region, pool_uid)
            except NotAllowedError as error:
                refused.append(error)
                return []

        with ThreadPoolExecutor(min(8, len(where)), "aws") as pool:
            found = [instance for answer in pool.map(ask, where) for instance in answer]
        if refused and (regions is not None or len(refused) == len(where)):
            raise refused[0]
        return sorted(found, key=lambda i: (i.id, i.key))

    def terminate(self, instance: Instance) -> None:
        """See `Provider`."""
        with self._asked(instance.placement.region) as ec2, _unless("InvalidInstanceID.NotFound"):
            ec2.terminate_instances(InstanceIds=[instance.key])

    def end_when_shut_down(self, instance: Instance) -> None:
        """See `Provider`."""
        attribute = "instanceInitiatedShutdownBehavior"
        with self._asked(instance.placement.region) as ec2:
            ec2.modify_instance_attribute(
                InstanceId=instance.key, Attribute=attribute, Value="terminate"
            )

    def firewall(self, region: str, ports: Iterable[int], sources: Iterable[str]) -> str:
        """See `Provider`. Creates a security group in each VPC, as SkyPilot chooses the VPC.

        It is named by a hash of its rules, shared by all pools with these rules, and never changed.
        """
        rules = {(port, source) for port in ports for source in sources}
        name = f"fogft-{hashlib.sha256(repr(sorted(rules)).encode()).hexdigest()[:16]}"
        with self._asked(region) as ec2:
            changed = _firewalls(name, rules, ec2)
        if changed:
            raise CloudError(
                f"the security group `{name}` ({changed[0]}) in `aws/{region}` was changed: it no "
                "longer matches `fogft.allow_from`",
                "delete it, and fogft creates a new one",
            )
        return name

    def credentials_end_at(self) -> float | None:
        """See `Provider`. A login that renews itself counts as having no expiry."""
        try:
            session = importlib.import_module("botocore.session").Session()
            told = dict(session.get_scoped_config())
        except Exception:  # not installed, or no such profile: `check` reports it
            return None
        found = [os.environ.get(name, "") for name in _ENDS_IN_ENVIRONMENT]
        found += [str(told.get(name, "")) for name in _ENDS_IN_PROFILE]
        login = told.get("sso_session") or told.get("sso_start_url")
        if login and "AWS_ACCESS_KEY_ID" not in os.environ:
            name = hashlib.sha1(str(login).encode(), usedforsecurity=False).hexdigest()
            with contextlib.suppress(OSError, ValueError, AttributeError):
                cache = Path("~/.aws/sso/cache").expanduser() / f"{name}.json"
                token = json.loads(cache.read_text())
                found.append("" if token.get("refreshToken") else str(token.get("expiresAt", "")))
        return min((at for at in map(moment, found) if at), default=None)

    def quota(self, region: str, code: str) -> float | None:
        """See `Provider`. `code` is one of AWS's Service Quotas."""
        with self._asked(region, "service-quotas") as quotas:
            try:
                found = quotas.get_service_quota(ServiceCode="ec2", QuotaCode=code)
            except quotas.exceptions.NoSuchResourceException:
                return None
            return float(found["Quota"]["Value"])

    def spot_prices(self, region: str, instances: Iterable[str]) -> Mapping[tuple[str, str], float]:
        """See `Provider`."""
        with self._asked(region) as ec2:
            pages = ec2.get_paginator("describe_spot_price_history").paginate(
                InstanceTypes=sorted(set(instances)),
                ProductDescriptions=["Linux/UNIX"],
                # Only the current price in each zone.
                StartTime=datetime.datetime.now(datetime.timezone.utc),
            )
            found = [entry for page in pages for entry in page["SpotPriceHistory"]]
        found.sort(key=lambda entry: entry["Timestamp"])
        return {(p["AvailabilityZone"], p["InstanceType"]): float(p["SpotPrice"]) for p in found}

    def _instances_in(self, region: str, pool_uid: str) -> list[Instance]:
        ours = {"Name": "tag-key", "Values": [naming.POOL]}
        if pool_uid:
            ours = {"Name": f"tag:{naming.POOL}", "Values": [pool_uid]}
        alive = {"Name": "instance-state-name", "Values": _ALIVE}
        with self._asked(region) as ec2:
            pages = ec2.get_paginator("describe_instances").paginate(Filters=[ours, alive])
            found = pages.search("Reservations[].Instances[]")
            listed = [_instance(region, raw) for raw in found]
        return [instance for instance in listed if instance is not None]

    def regions(self) -> list[str]:
        """Return every region's name."""
        with self._asked(_HOME) as ec2:
            return [str(region["RegionName"]) for region in ec2.describe_regions()["Regions"]]

    def warning(self) -> str:
        """See `Provider`. Reads the policies of SkyPilot's role, if the account may."""
        try:
            with self._asked(_HOME, "iam") as iam:
                mighty = _mighty(iam)
        except NotAllowedError as error:
            return f"cannot read the permissions of AWS role `{ROLE}`, which every VM has: {error}"
        except CloudUnreachable:
            return ""
        if mighty is None:
            return (
                f"AWS has no role `{ROLE}`: at the first launch SkyPilot creates one for every VM, "
                "with full access to EC2 and S3. Create the one in docs/how-to/clouds.md first"
            )
        if not mighty:
            return ""
        return (
            f"AWS's role `{ROLE}`, which every VM has and your `run` can use, has "
            f"{', '.join(f'`{name}`' for name in mighty)}: give it only what "
            "docs/how-to/clouds.md lists"
        )

    def _client(self, service: str, region: str) -> Any:
        with self._lock:
            if (service, region) not in self.clients:
                if self._session is None:
                    self._session = importlib.import_module("boto3").session.Session()
                retries = {"max_attempts": 2, "mode": "standard"}
                config = importlib.import_module("botocore.config").Config(
                    connect_timeout=5, read_timeout=10, retries=retries
                )
                self.clients[service, region] = self._session.client(
                    service, region_name=region, config=config
                )
            return self.clients[service, region]

    @contextlib.contextmanager
    def _asked(self, region: str, service: str = "ec2") -> Iterator[Any]:
        """Yield a client, and convert the errors of its calls."""
        try:
            yield self._client(service, region)
        except ImportError as error:
            raise NotAllowedError("boto3 is not installed") from error
        except Exception as error:
            told = getattr(error, "response", None) or {}
            code = str(told.get("Error", {}).get("Code", "")) or type(error).__name__
            if code in _FORBIDDEN or code == "NoCredentialsError":
                raise NotAllowedError(f"{code}: {plain(str(error))}") from error
            hint = ""
            if classify(code, [str(error)]).cause is Cause.CREDENTIALS:
                with self._lock:  # only a new session reads renewed ones
                    self._session = None
                    self.clients.clear()
                hint = "renew the AWS credentials; `sky check aws` tests them"
            raise CloudUnreachable(f"AWS did not answer about `{region}`: {error}", hint) from error


def _mighty(iam: Any) -> list[str] | None:
    """Return the names of the role's policies that allow all of a service; None: no such role."""
    try:
        attached = iam.list_attached_role_policies(RoleName=ROLE)["AttachedPolicies"]
    except iam.exceptions.NoSuchEntityException:
        return None
    names = [str(policy["PolicyName"]) for policy in attached]
    mighty = {name for name in names if name.endswith("FullAccess") or name in _MIGHTY}
    for name in iam.list_role_policies(RoleName=ROLE)["PolicyNames"]:
        inline = iam.get_role_policy(RoleName=ROLE, PolicyName=name)["PolicyDocument"]
        if any(map(_allows_all, _listed(inline.get("Statement")))):
            mighty.add(str(name))
    return sorted(mighty)


def _allows_all(statement: Mapping[str, Any]) -> bool:
    """Whether a policy statement allows every action of a service on every resource."""
    if statement.get("Effect") != "Allow" or statement.get("Condition"):
        return False
    everything = any(one == "*" or one.endswith(":*") for one in _listed(statement.get("Action")))
    everywhere = "*" in _listed(statement.get("Resource"))
    return everywhere and (everything or "NotAction" in statement)


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def _firewalls(name: str, rules: Set[tuple[int, str]], ec2: Any) -> list[str]:
    """Create the group in each VPC that has none; return the ids of groups with other rules."""

    def groups() -> list[Any]:
        by_name = [{"Name": "group-name", "Values": [name]}]
        return list(ec2.describe_security_groups(Filters=by_name)["SecurityGroups"])

    missing = {vpc["VpcId"] for vpc in ec2.describe_vpcs()["Vpcs"]}
    for vpc in sorted(missing - {group["VpcId"] for group in groups()}):
        with _unless("InvalidGroup.Duplicate"):
            ec2.create_security_group(GroupName=name, Description="fogft", VpcId=vpc)
    wanted = [_permission(port, source) for port, source in sorted(rules)]
    changed = []
    for group in groups():
        if not group["IpPermissions"]:  # its creation was interrupted
            with _unless("InvalidPermission.Duplicate"):
                ec2.authorize_security_group_ingress(GroupId=group["GroupId"], IpPermissions=wanted)
        by_group = [{"Name": "group-id", "Values": [group["GroupId"]]}]
        listed = ec2.describe_security_group_rules(Filters=by_group)["SecurityGroupRules"]
        found = {
            (
                *(one["IpProtocol"], one["FromPort"], one["ToPort"]),
                one.get("CidrIpv4") or one.get("CidrIpv6") or "others",
            )
            for one in listed
            if not one["IsEgress"]
        }
        if found != {("tcp", port, port, source) for port, source in rules}:
            changed.append(str(group["GroupId"]))
    return changed


def _permission(port: int, source: str) -> dict[str, Any]:
    ranges, key = ("Ipv6Ranges", "CidrIpv6") if ":" in source else ("IpRanges", "CidrIp")
    return {"IpProtocol": "tcp", "FromPort": port, "ToPort": port, ranges: [{key: source}]}


@contextlib.contextmanager
def _unless(code: str) -> Iterator[None]:
    """Ignore an AWS error that says that the change has already been made."""
    try:
        yield
    except Exception as error:
        if code not in str(error):
            raise


def _instance(region: str, raw: Mapping[str, Any]) -> Instance | None:
    labels = {tag["Key"]: tag["Value"] for tag in raw.get("Tags", ())}
    id = naming.replica_of_labels(labels)
    if id is None:
        return None
    placement = Placement(
        "aws",
        region,
        raw.get("Placement", {}).get("AvailabilityZone", ""),
        raw.get("InstanceType", ""),
        raw.get("InstanceLifecycle") == "spot",
    )
    launched = raw.get("LaunchTime")
    return Instance(
        id=id,
        key=raw["InstanceId"],
        placement=placement,
        labels=labels,
        public_ip=raw.get("PublicIpAddress", ""),
        launched_at=launched.timestamp() if launched else 0.0,
        running=raw.get("State", {}).get("Name") in ("pending", "running"),
    )
