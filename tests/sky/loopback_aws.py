"""AWS's interface on loopback, and nothing behind it: ``python loopback_aws.py PORT``.

Its instances have loopback addresses, so that whoever tries to reach one reaches nobody.
"""

from __future__ import annotations

import itertools
import sys
import threading

import boto3
from moto.ec2.models import elastic_network_interfaces, instances
from moto.server import ThreadedMotoServer

REGIONS = ("us-east-1", "us-west-2", "eu-west-1")


def main(port: int) -> None:
    addresses = (f"127.77.{n // 250}.{n % 250 + 1}" for n in itertools.count())
    for module in (elastic_network_interfaces, instances):
        if hasattr(module, "random_public_ip"):
            module.random_public_ip = lambda *_: next(addresses)
    ThreadedMotoServer(ip_address="127.0.0.1", port=port, verbose=False).start()
    access = {"aws_access_key_id": "test", "aws_secret_access_key": "test",
              "endpoint_url": f"http://127.0.0.1:{port}"}  # fmt: skip
    iam = boto3.client("iam", region_name="us-east-1", **access)  # else SkyPilot sleeps 30 s
    iam.create_instance_profile(InstanceProfileName="skypilot-v1")
    iam.create_role(RoleName="skypilot-v1", AssumeRolePolicyDocument="{}")
    iam.add_role_to_instance_profile(InstanceProfileName="skypilot-v1", RoleName="skypilot-v1")
    for region in REGIONS:
        ec2 = boto3.client("ec2", region_name=region, **access)
        vpc = ec2.describe_vpcs(Filters=[{"Name": "is-default", "Values": ["true"]}])["Vpcs"][0]
        gateway = ec2.create_internet_gateway()["InternetGateway"]["InternetGatewayId"]
        ec2.attach_internet_gateway(InternetGatewayId=gateway, VpcId=vpc["VpcId"])
        of_vpc = [{"Name": "vpc-id", "Values": [vpc["VpcId"]]}]
        table = ec2.describe_route_tables(Filters=of_vpc)["RouteTables"][0]["RouteTableId"]
        ec2.create_route(RouteTableId=table, DestinationCidrBlock="0.0.0.0/0", GatewayId=gateway)
    print("ready", flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    main(int(sys.argv[1]))
