"""One end of a service on CycloneDDS, as discovery sees it: ``python cyclone_end.py WHAT NAME``.

WHAT is `client` or `server`. Lives until its standard input is closed.
"""

import os
import sys
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic


@dataclass
class Request(IdlStruct, typename="std_srvs::srv::dds_::SetBool_Request_"):
    data: bool


@dataclass
class Response(IdlStruct, typename="std_srvs::srv::dds_::SetBool_Response_"):
    success: bool
    message: str


def main(what: str, name: str) -> None:
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    reliable = Qos(Policy.Reliability.Reliable(100_000_000), Policy.History.KeepAll)
    asked = Topic(participant, f"rq/{name}Request", Request)
    answered = Topic(participant, f"rr/{name}Reply", Response)
    make = (DataWriter, DataReader) if what == "client" else (DataReader, DataWriter)
    ends = [make[0](participant, asked, reliable), make[1](participant, answered, reliable)]
    sys.stdin.read()
    del ends


if __name__ == "__main__":
    main(*sys.argv[1:])
