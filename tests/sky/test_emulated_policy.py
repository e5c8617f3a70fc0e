"""The emulation's reading of the policy that docs/how-to/clouds.md recommends."""

from __future__ import annotations

from tests.sky.emulated_aws.policy import PAGE, Policy, actions, statements


def test_the_pages_policy_allows_what_it_names_and_nothing_else():
    rules = statements(PAGE.read_text())
    policy = Policy(rules)
    ours = [{"fogft-pool": "0" * 16}]
    for action in actions(rules):
        assert policy.allows(action.replace("*", "Instances"), lambda: ours)
    for action in ("ec2:RebootInstances", "iam:CreateRole", "s3:ListBuckets", "ec2:CreateVpc"):
        assert not policy.allows(action, lambda: ours)
    assert policy.allows("sts:GetCallerIdentity", list)


def test_only_machines_with_the_label_may_be_ended():
    policy = Policy(statements(PAGE.read_text()))
    assert policy.allows("ec2:TerminateInstances", lambda: [{"fogft-pool": "x"}])
    assert not policy.allows(
        "ec2:TerminateInstances", lambda: [{"fogft-pool": "x"}, {"Name": "db"}]
    )


def test_a_permission_can_be_taken_away():
    policy = Policy(statements(PAGE.read_text()))
    policy.taken = {"ec2:Describe*"}
    assert not policy.allows("ec2:DescribeInstances", list)
    assert policy.allows("ec2:RunInstances", list)


def test_what_may_be_tagged_is_judged_by_its_kind():
    policy = Policy(statements(PAGE.read_text()))
    assert policy.allows("ec2:CreateTags", list, "security-group")
    assert not policy.allows("ec2:CreateTags", list, "subnet")
