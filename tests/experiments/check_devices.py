"""A station of one real device at its emulator, its checklist, and a person who does as a test says."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.config import StationConfig
from experiments.check_device.checklist import walk
from experiments.check_device.findings import Finding
from experiments.check_device.person import Nobody, Person
from experiments.ports import free_endpoint


class Hand:
    """A person: ``does`` is called with each request, and says whether it was done; ``agrees`` to whatever is asked."""

    here = True

    def __init__(self, does: Callable[[str], bool] = lambda _: False, agrees: bool = True):
        self._does, self._agrees = does, agrees
        self.heard = list[str]()

    def ready(self, request: str) -> bool:
        self.heard.append(request)
        return self._does(request)

    def confirm(self, question: str) -> bool:
        self.heard.append(question)
        return self._agrees


def station(name: str, device: dict[str, Any], **more: Any) -> StationConfig:
    given = {"name": "bench", "bus": {"endpoint": free_endpoint()}, "devices": {name: {"backend": "real"} | device}}
    return StationConfig.model_validate(given | more)


def findings(config: StationConfig, name: str, person: Person | None = None, **options: Any) -> dict[str, Finding]:
    """What each step has found, by its name."""
    return {step: finding for step, _, finding in walk(config, name, person or Nobody(), **options)}


def found(step: str, config: StationConfig, name: str, person: Person | None = None, **options: Any) -> Finding:
    """What one step has found."""
    return findings(config, name, person, only=(step,), **options)[step]


def noisy(picture: np.ndarray, seed: int = 0) -> Callable[[], np.ndarray]:
    """A camera's view: no two pictures are the same."""
    random = np.random.default_rng(seed)
    return lambda: np.clip(picture + random.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
