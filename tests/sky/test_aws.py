"""AWS asked directly: only what carries our labels is seen, and errors say what is known."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest

from fogft.cloud.sky import naming
from fogft.cloud.sky.aws import Aws
from fogft.cloud.sky.provider import NotAllowedError
from fogft.errors import CloudError, CloudUnreachable
from tests.fakes.sky import labels, replica
from tests.needs import needs

IMAGE = "ami-1e749f67"
OTHER = replica(uid="00000000000000bb")


def launch(region: str, labels: dict[str, str], **more: Any) -> str:
    import boto3

    ec2 = boto3.client("ec2", region_name=region)
    tags = [{"Key": k, "Value": v} for k, v in labels.items()]
    made = ec2.run_instances(
        ImageId=IMAGE, MinCount=1, MaxCount=1, InstanceType="m6i.large",
        TagSpecifications=[{"ResourceType": "instance", "Tags": tags}], **more,
    )  # fmt: skip
    return str(made["Instances"][0]["InstanceId"])


@pytest.fixture
def account(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    from moto import mock_aws

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN"):
        monkeypatch.setenv(name, "test")
    monkeypatch.delenv("AWS_ENDPOINT_URL", raising=False)
    with mock_aws():
        yield


@needs("moto")
def test_machines_of_ours_are_found_in_every_region_and_nothing_else_is(account: None):
    spot = {"InstanceMarketOptions": {"MarketType": "spot"}}
    mine = launch("us-east-1", labels(replica(0)), **spot)
    launch("us-west-2", labels(replica(1)))
    launch("us-west-2", labels(OTHER))
    launch("us-east-1", {"Name": "somebody else"})
    launch("us-east-1", {naming.POOL: "not-a-uid", naming.SLOT: "0", naming.GENERATION: "1"})
    aws = Aws()
    found = aws.instances(None, replica().pool_uid)
    assert [i.id for i in found] == [replica(0), replica(1)]
    assert found[0].key == mine
    assert found[0].placement.region == "us-east-1"
    assert (found[0].placement.spot, found[1].placement.spot) == (True, False)
    assert naming.usd_per_hour(found[0].labels) == 0.02
    assert [i.id for i in aws.instances(["us-west-2"])] == [replica(1), OTHER]
    assert not aws.instances([])


@needs("moto")
def test_a_machine_that_shut_itself_down_is_found_as_long_as_its_disk_costs(account: None):
    """One on demand is stopped by that, and not ended."""
    import boto3

    mine = launch("us-east-1", labels(replica(0)))
    boto3.client("ec2", region_name="us-east-1").stop_instances(InstanceIds=[mine])
    aws = Aws()
    (found,) = aws.instances(None, replica().pool_uid)
    assert found.key == mine
    aws.terminate(found)
    assert not aws.instances(None, replica().pool_uid)


@needs("moto")
def test_a_machine_that_is_to_end_when_it_shuts_down_does_not_merely_stop(account: None):
    import boto3

    mine = launch("us-east-1", labels(replica(0)))
    aws = Aws()
    (found,) = aws.instances(["us-east-1"])
    aws.end_when_shut_down(found)
    name = "instanceInitiatedShutdownBehavior"
    ec2 = boto3.client("ec2", region_name="us-east-1")
    told = ec2.describe_instance_attribute(InstanceId=mine, Attribute=name)
    assert told["InstanceInitiatedShutdownBehavior"]["Value"] == "terminate"


@needs("moto")
def test_terminate_ends_these_and_is_repeatable(account: None):
    launch("us-east-1", labels(replica(0)))
    launch("us-east-1", labels(replica(1)))
    aws = Aws()
    first, second = aws.instances(["us-east-1"])
    aws.terminate(first)
    aws.terminate(first)
    assert [i.key for i in aws.instances(["us-east-1"])] == [second.key]


@needs("moto")
def test_live_prices_are_of_each_zone(account: None):
    prices = Aws().spot_prices("us-east-1", ["m5.large"])
    assert prices
    assert {kind for _, kind in prices} == {"m5.large"}
    assert all(zone.startswith("us-east-1") for zone, _ in prices)
    assert all(price > 0 for price in prices.values())


LAB = ("198.51.100.0/24", "2001:db8::/48")


def groups(region: str = "us-east-1") -> dict[str, dict[str, Any]]:
    """Return the security groups of fogft's own, by the VPC that they are in."""
    import boto3

    found = boto3.client("ec2", region_name=region).describe_security_groups()["SecurityGroups"]
    return {group["VpcId"]: group for group in found if group["GroupName"].startswith("fogft-")}


def let_in(group: dict[str, Any]) -> set[tuple[int, str]]:
    return {
        (one["FromPort"], source)
        for one in group["IpPermissions"]
        for source in (
            *(found["CidrIp"] for found in one["IpRanges"]),
            *(found["CidrIpv6"] for found in one["Ipv6Ranges"]),
        )
    }


@needs("moto")
def test_a_security_group_of_every_vpc_lets_in_those_networks_at_those_ports_alone(account: None):
    import boto3

    boto3.client("ec2", region_name="us-east-1").create_vpc(CidrBlock="10.9.0.0/16")
    name = Aws().firewall("us-east-1", (22, 7448), LAB)
    made = groups()
    assert len(made) == 2
    assert {group["GroupName"] for group in made.values()} == {name}
    for group in made.values():
        assert let_in(group) == {(port, network) for port in (22, 7448) for network in LAB}
    assert Aws().firewall("us-east-1", (7448, 22), LAB[::-1]) == name
    assert groups() == made, "asked again, nothing changes"
    assert Aws().firewall("us-east-1", (22,), LAB) != name, "other rules, another group"


@needs("moto")
def test_a_security_group_is_completed_but_one_that_somebody_changed_is_refused(account: None):
    import boto3

    name = Aws().firewall("us-east-1", (22,), LAB)
    (group,) = groups().values()
    ec2 = boto3.client("ec2", region_name="us-east-1")
    ec2.revoke_security_group_ingress(
        GroupId=group["GroupId"], IpPermissions=group["IpPermissions"]
    )
    assert not let_in(*groups().values())
    assert Aws().firewall("us-east-1", (22,), LAB) == name
    assert groups() == {group["VpcId"]: group}
    rule = {"IpProtocol": "tcp", "FromPort": 0, "ToPort": 65535,
            "IpRanges": [{"CidrIp": "0.0.0.0/0"}]}  # fmt: skip
    ec2.authorize_security_group_ingress(GroupId=group["GroupId"], IpPermissions=[rule])
    with pytest.raises(CloudError, match=f"`{name}` .* was changed"):
        Aws().firewall("us-east-1", (22,), LAB)


ANYTHING = (
    '{"Version": "2012-10-17", "Statement": [{"Effect": "Allow", "Action": "ec2:*", '
    '"Resource": "*"}]}'
)


@needs("moto")
def test_a_role_that_may_too_much_is_told(account: None):
    """SkyPilot gives its role full access, and every VM has it."""
    import boto3

    iam = boto3.client("iam", region_name="us-east-1")
    assert "has no role `skypilot-v1`" in Aws().warning()
    iam.create_role(RoleName="skypilot-v1", AssumeRolePolicyDocument="{}")
    assert Aws().warning() == ""
    arn = iam.create_policy(PolicyName="AmazonEC2FullAccess", PolicyDocument=ANYTHING)
    iam.attach_role_policy(RoleName="skypilot-v1", PolicyArn=arn["Policy"]["Arn"])
    harmless = ANYTHING.replace("ec2:*", "ec2:Describe*")
    iam.put_role_policy(RoleName="skypilot-v1", PolicyName="ours", PolicyDocument=harmless)
    iam.put_role_policy(RoleName="skypilot-v1", PolicyName="inline", PolicyDocument=ANYTHING)
    assert "has `AmazonEC2FullAccess`, `inline`: give" in Aws().warning()


class Refusing:
    """A client whose every call fails, as botocore's do."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def get_paginator(self, name: str) -> Any:
        raise self.error

    def terminate_instances(self, InstanceIds: list[str]) -> Any:  # noqa: N803
        raise self.error


def client_error(code: str) -> Exception:
    error = Exception(f"An error occurred ({code}) when calling")
    error.response = {"Error": {"Code": code}}  # type: ignore[attr-defined]
    return error


@pytest.mark.parametrize(
    ("code", "expected", "hint"),
    [
        ("UnauthorizedOperation", NotAllowedError, ""),
        ("RequestExpired", CloudUnreachable, "renew"),
        ("ExpiredToken", CloudUnreachable, "renew"),
        ("InternalError", CloudUnreachable, ""),
        ("RequestLimitExceeded", CloudUnreachable, ""),
    ],
)
def test_not_allowed_is_not_the_same_as_cannot_tell(code: str, expected: type, hint: str):
    """The first hands the question to SkyPilot; from the second nothing may be concluded."""
    aws = Aws()
    aws.clients["ec2", "us-east-1"] = Refusing(client_error(code))
    with pytest.raises(expected) as caught:
        aws.instances(["us-east-1"])
    if hint:
        assert hint in caught.value.hint
        assert not aws.clients, "renewed credentials are read from the disk again"


def test_a_role_that_may_not_be_read_is_told_in_a_few_words():
    """What AWS says of a refusal ends in some thousand characters that only AWS can read."""
    error = client_error("AccessDenied")
    error.args = (
        "User: lab is not authorized to perform: iam:ListAttachedRolePolicies. Encoded "
        "authorization failure message: " + "Zm9nZnQ" * 120,
    )
    aws = Aws()

    class Iam:
        def list_attached_role_policies(self, RoleName: str) -> Any:  # noqa: N803
            raise error

        class exceptions:  # noqa: N801
            NoSuchEntityException = KeyError

    aws.clients["iam", "us-east-1"] = Iam()
    told = aws.warning()
    assert told.startswith("cannot read the permissions of AWS role `skypilot-v1`")
    assert told.endswith("not authorized to perform: iam:ListAttachedRolePolicies.")


@needs("moto")
def test_a_region_that_may_not_be_asked_hides_no_other(account: None):
    """An organisation keeps its accounts out of most regions."""
    aws = Aws()
    launch("us-west-2", labels(replica(0)))
    aws.clients["ec2", "us-east-1"] = Refusing(client_error("UnauthorizedOperation"))
    aws.regions = lambda: ["us-east-1", "us-west-2"]  # type: ignore[method-assign]
    assert [i.placement.region for i in aws.instances(None)] == ["us-west-2"]
    with pytest.raises(NotAllowedError):
        aws.instances(["us-east-1", "us-west-2"])


def test_no_network_is_cannot_tell():
    aws = Aws()
    aws.clients["ec2", "us-east-1"] = Refusing(ConnectionError("no route"))
    with pytest.raises(CloudUnreachable):
        aws.instances(["us-east-1"])


@needs("moto")
@pytest.mark.parametrize("renews", [False, True])
def test_a_login_that_ends_is_known_and_one_that_renews_itself_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, renews: bool
):
    """`aws sso login` leaves a token and its end; login tools write it elsewhere."""
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    config = tmp_path / "config"
    monkeypatch.setenv("AWS_CONFIG_FILE", str(config))
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    assert Aws().credentials_end_at() is None
    config.write_text(
        "[default]\nsso_session = lab\nsso_account_id = 1\nsso_role_name = fogft\n"
        "[sso-session lab]\nsso_start_url = https://lab.example.com\nsso_region = us-east-1\n"
    )
    name = hashlib.sha1(b"lab").hexdigest()
    cache = tmp_path / ".aws/sso/cache" / f"{name}.json"
    cache.parent.mkdir(parents=True)
    token = {"accessToken": "x", "expiresAt": "2026-11-23T18:00:00Z"}
    cache.write_text(json.dumps({**token, **({"refreshToken": "y"} if renews else {})}))
    end = datetime(2026, 11, 23, 18, tzinfo=timezone.utc).timestamp()
    assert Aws().credentials_end_at() == (None if renews else end)
    monkeypatch.setenv("AWS_CREDENTIAL_EXPIRATION", "2026-11-23T17:30:00+00:00")
    assert Aws().credentials_end_at() == end - 1800
    cache.write_text("{")
    config.write_text("[default]\nx_security_token_expires = 2026-11-23T17:00:00Z\n")
    assert Aws().credentials_end_at() == end - 3600
    config.write_text("[default\n")
    assert Aws().credentials_end_at() is None
