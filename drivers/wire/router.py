"""The router of a lab: a zenoh session that everybody else connects to, and that lets through what `access` allows."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from drivers.config import StationConfig
from drivers.wire.access import Access, rules
from drivers.wire.security import CA, CERTIFICATE, KEY, Identity
from drivers.wire.session import open_session, settings_of


class Router:
    """A router at a station's endpoint, and nowhere else; a context manager.

    The rules are those of its start: zenoh reads them once. A certificate that expires ends its member's connection.
    Raises NotConnected when it cannot listen there.
    """

    def __init__(self, config: StationConfig, access: Access, identity: Identity):
        self._session = open_session(
            "router",
            config.bus.endpoint,
            listen=True,
            timeout=config.bus.timeout,
            lease=config.lease,
            identity=identity,
            settings={
                "transport/shared_memory/enabled": False,
                "access_control": rules(access),
                "scouting/delay": 0,  # nothing scouts: there is nothing to wait for
            },
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop routing; idempotent."""
        if not self._session.is_closed():
            self._session.close()


def zenoh_file(endpoint: str, access: Access | None = None) -> str:
    """zenoh's own configuration, as JSON5, for programs that are not ours (zenohd, bridges).

    With ``access`` it is the router's, without a client's. The keys are named as they lie beside it.
    """
    mode: Literal["client", "router"] = "client" if access is None else "router"
    keys = (Path(CA), Path(CERTIFICATE), Path(KEY))
    settings = settings_of(mode, endpoint, listen=access is not None, keys=keys)
    if access is not None:
        settings["access_control"] = rules(access)
    nested: dict[str, Any] = {}
    for path, value in settings.items():
        *parents, last = path.split("/")
        here = nested
        for parent in parents:
            here = here.setdefault(parent, {})
        here[last] = value
    return (
        f"// The keys lie in this folder: start the program here.\n{json.dumps(nested, indent=2, ensure_ascii=False)}\n"
    )
