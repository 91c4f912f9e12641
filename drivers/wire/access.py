"""Who may do what on a lab's bus, as the router enforces it.

Everything that is not allowed here is dropped. Reading (streams, who is alive, the verbs that only tell something) is
for every member, commanding for runners; a device's machine publishes and answers for its own devices and no others.
zenoh looks at each kind of message (puts, queries, replies, each kind of declaration) on its way in and on its way out.
"""

from __future__ import annotations

import io
import re
from typing import Annotated, Any, Self

from pydantic import Field, model_validator
from ruamel.yaml import YAML

from drivers.scene import Strict
from drivers.wire import topics
from drivers.wire.security import Role, role_of
from mechanics.yaml_input import Refusal

NAME = r"^[a-z0-9][a-z0-9_-]*$"
READ_VERBS = ("describe", "holders", "safety", "health", "counts")
"""Verbs that change nothing; every other verb is a command."""

_IN, _OUT = "ingress", "egress"
_ANY_DISCOVERY = "@/*/@ros2_lv/**"  # what a ROS 2 bridge asks for; it is told of this station only
_PLAIN = re.compile(r"[A-Za-z0-9_.-]+")

Name = Annotated[str, Field(pattern=NAME)]


class Access(Strict):
    """The members of a lab: ``machines`` with the devices that each may serve, runners, viewers.

    ``revoked`` holds the common names (``runner-bob``) that may do nothing any more; none of them is given out again.
    """

    station: str
    machines: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    runners: tuple[Name, ...] = ()
    viewers: tuple[Name, ...] = ()
    revoked: tuple[Name, ...] = ()

    @model_validator(mode="after")
    def _sound(self) -> Self:
        served: dict[str, str] = {}
        for machine, devices in self.machines.items():
            if not re.fullmatch(NAME, machine):
                raise Refusal(f"{machine!r} is no name", "small letters, digits, _ and -", at=("machines", machine))
            for i, device in enumerate(devices):
                if not _PLAIN.fullmatch(device):  # it becomes part of a key, where * and / mean something
                    raise Refusal(f"{device!r} is no device", "a name without * and /", at=("machines", machine, i))
                if device in served:
                    wrong = f"{device} is served by {served[device]} already"
                    raise Refusal(wrong, "one machine for each device", at=("machines", machine, i))
                served[device] = machine
        return self

    def members(self) -> dict[str, Role]:
        """The common name of every member with its role, the router's among them; revoked ones are none."""
        roles: dict[str, Role] = {"router": "router"}
        roles |= {f"device-{name}": "device" for name in self.machines}
        roles |= {f"runner-{name}": "runner" for name in self.runners}
        roles |= {f"viewer-{name}": "viewer" for name in self.viewers}
        return {name: role for name, role in roles.items() if name not in self.revoked}

    def without(self, name: str) -> Access:
        """The members after the one with this common name was revoked."""
        role, own = role_of(name), name.partition("-")[2]
        return self.model_copy(
            update={
                "machines": {key: d for key, d in self.machines.items() if role != "device" or key != own},
                "runners": tuple(runner for runner in self.runners if role != "runner" or runner != own),
                "viewers": tuple(viewer for viewer in self.viewers if role != "viewer" or viewer != own),
                "revoked": (*self.revoked, name),
            }
        )

    def text(self) -> str:
        """As YAML, for `mechanics.yaml_input`."""
        yaml, out = YAML(), io.StringIO()
        yaml.default_flow_style = None
        yaml.dump(self.model_dump(mode="json"), out)
        return out.getvalue()


Allowed = tuple[str, tuple[str, ...], tuple[str, ...]]
"""Direction as the router sees it, kinds of message, key expressions."""


def rules(access: Access) -> dict[str, Any]:
    """zenoh's ``access_control``: deny by default; each member a subject by the common name of its certificate."""
    station = access.station
    grants = {"read": _reading(station), "command": _commanding(station)}
    grants |= {f"device-{name}": _serving(station, devices) for name, devices in access.machines.items() if devices}
    members = [name for name in access.members() if name != "router"]
    made: list[dict[str, Any]] = [
        {
            "id": f"{grant} {i}",
            "permission": "allow",
            "flows": [flow],
            "messages": list(messages),
            "key_exprs": list(keys),
        }
        for grant, allowed in grants.items()
        for i, (flow, messages, keys) in enumerate(allowed)
    ]
    policies: list[dict[str, Any]] = []
    for name in members:
        granted = ("read", "command") if role_of(name) == "runner" else ("read", name)
        allowed = [rule["id"] for rule in made if rule["id"].rsplit(" ", 1)[0] in granted]
        policies.append({"rules": allowed, "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": made,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in members],
        "policies": policies,
    }


def _reading(station: str) -> list[Allowed]:
    verbs = tuple(topics.key(station, "*", verb) for verb in READ_VERBS)
    alive = topics.alive(station, "*")
    return [
        (_IN, ("declare_subscriber",), (f"{station}/**",)),
        (_OUT, ("put", "delete"), (f"{station}/**",)),
        (_IN, ("query",), verbs),
        (_OUT, ("declare_queryable", "reply"), verbs),
        (_IN, ("declare_liveliness_subscriber", "liveliness_query"), (alive, _ANY_DISCOVERY)),
        (_OUT, ("liveliness_token",), (alive, _discovery(station, "*"))),
    ]


def _commanding(station: str) -> list[Allowed]:
    anything = topics.key(station, "*", "*")
    return [
        (_IN, ("query",), (anything,)),
        (_OUT, ("declare_queryable", "reply"), (anything,)),
        (_IN, ("liveliness_token",), (topics.lease(station, "*", "*"), _discovery(station, topics.ESTIMATOR))),
        *_publishing(station, (topics.ESTIMATOR,)),
    ]


def _serving(station: str, devices: tuple[str, ...]) -> list[Allowed]:
    verbs = tuple(topics.key(station, device, "*") for device in devices)
    tokens = [token for device in devices for token in (topics.alive(station, device), _discovery(station, device))]
    leases = tuple(topics.lease(station, device, "*") for device in devices)
    return [
        *_publishing(station, devices),
        (_IN, ("declare_queryable", "reply"), verbs),
        (_OUT, ("query",), verbs),
        (_IN, ("liveliness_token",), tuple(tokens)),
        (_IN, ("declare_liveliness_subscriber",), leases),
        (_OUT, ("liveliness_token",), leases),
    ]


def _publishing(station: str, devices: tuple[str, ...]) -> list[Allowed]:
    return [
        (_IN, ("put", "delete"), tuple(f"{station}/{device}/**" for device in devices)),
        # a publisher learns who listens, by whatever pattern, so that what nobody hears need not be produced
        (_OUT, ("declare_subscriber",), (f"{station}/**",)),
    ]


def _discovery(station: str, device: str) -> str:
    """The tokens that announce a device's streams; ``*``: those of every device."""
    some = "$*" if device == "*" else f"{device}§$*"
    return topics.discovery("*", f"{station}/{some}", "*").rsplit("/", 1)[0] + "/*"
