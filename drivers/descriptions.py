"""What a log says of the station that it was recorded at: an attachment, `DESCRIPTIONS`."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Self

from pydantic import TypeAdapter, ValidationError

from drivers.interfaces import Description

DESCRIPTIONS = "devices.json"
"""Name of the attachment. Of several the last one counts."""


@dataclass(frozen=True)
class LoggedStation:
    """The station's name, whether its time stood still while somebody waited, and its devices as they say by name."""

    station: str
    lockstep: bool
    devices: dict[str, Description] = field(default_factory=dict)

    def as_json(self) -> bytes:
        """The attachment."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def read(cls, data: bytes) -> Self:
        """What `as_json` has written. Raises ValueError for anything else."""
        try:
            return TypeAdapter(cls).validate_json(data)
        except (ValidationError, RecursionError) as error:
            raise ValueError(f"no descriptions of devices: {str(error).splitlines()[0]}") from None
