"""The access rules as zenoh is given them."""

from __future__ import annotations

import pytest
import zenoh

from drivers.wire import topics
from drivers.wire.access import Access, rules

from .tls_lab import ACCESS


def granted(name: str, access: Access = ACCESS) -> list[tuple[str, str, str]]:
    """(flow, message, key) of everything that a member may."""
    made = rules(access)
    ids = [i for policy in made["policies"] if name in policy["subjects"] for i in policy["rules"]]
    return [
        (flow, message, key)
        for rule in made["rules"]
        if rule["id"] in ids
        for flow in rule["flows"]
        for message in rule["messages"]
        for key in rule["key_exprs"]
    ]


def test_what_has_no_rule_is_denied_and_nobody_is_everybody() -> None:
    made = rules(ACCESS)
    assert made["enabled"]
    assert made["default_permission"] == "deny"
    assert all(rule["permission"] == "allow" for rule in made["rules"])
    assert all(subject["cert_common_names"] for subject in made["subjects"])  # an empty one would match everybody
    assert granted("runner-bob") == []


def test_a_viewer_sends_nothing_but_questions() -> None:
    sent = {(message, key) for flow, message, key in granted("viewer-wall") if flow == "ingress"}
    assert {message for message, _ in sent} == {
        *("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")
    }
    verbs = {key.rpartition("/")[2] for message, key in sent if message == "query"}
    assert verbs == {"describe", "holders", "safety", "health", "counts"}


def test_a_machine_owns_no_device_whose_name_begins_as_its_own_does() -> None:
    access = Access(station="lab", machines={"bench": ("arm",), "shelf": ("arm2",)})
    token = zenoh.KeyExpr(topics.discovery("abc", "lab/arm2/pose", "geometry_msgs/msg/PoseStamped"))
    for name, owns in (("device-bench", False), ("device-shelf", True)):
        keys = [
            zenoh.KeyExpr(key) for flow, m, key in granted(name, access) if (flow, m) == ("ingress", "liveliness_token")
        ]
        assert any(key.includes(token) for key in keys) is owns


@pytest.mark.parametrize("device", ["*", "**", "a/b", "$*", ""])
def test_a_device_whose_name_is_a_pattern_gets_no_rights(device: str) -> None:
    with pytest.raises(ValueError):
        Access(station="lab", machines={"bench": (device,)})


def test_a_device_has_one_machine() -> None:
    with pytest.raises(ValueError):
        Access(station="lab", machines={"bench": ("arm",), "shelf": ("arm",)})


def test_a_machine_publishes_the_views_of_its_devices_and_no_others_and_everybody_may_read_them() -> None:
    view = topics.view("lab/arm/pose")
    for name, message, flow, may in (
        ("device-bench", "put", "ingress", True),
        ("device-shelf", "put", "ingress", False),
        ("viewer-wall", "put", "ingress", False),
        ("runner-alice", "put", "ingress", False),
        ("device-bench", "declare_subscriber", "egress", True),  # it learns that somebody looks on
        *(
            (member, "declare_subscriber", "ingress", True)
            for member in ("viewer-wall", "runner-alice", "device-shelf")
        ),
        *((member, "put", "egress", True) for member in ("viewer-wall", "runner-alice", "device-shelf")),
    ):
        keys = [zenoh.KeyExpr(key) for f, m, key in granted(name) if (f, m) == (flow, message)]
        assert any(key.includes(zenoh.KeyExpr(view)) for key in keys) is may, (name, message, flow)
    token = zenoh.KeyExpr(topics.discovery("abc", view, "geometry_msgs/msg/PoseStamped"))
    announced = [zenoh.KeyExpr(k) for f, m, k in granted("device-bench") if (f, m) == ("ingress", "liveliness_token")]
    assert any(key.includes(token) for key in announced)
