"""What a run writes down of itself, to messages and back: the records of `mechanics.records`."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.errors import ProtocolError
from drivers.wire import messages
from mechanics.records import (
    ContactBelief,
    EventRecord,
    LookRecord,
    PhaseRecord,
    PlanarState,
    StatusRecord,
    TrialRecord,
    WaypointRecord,
)

Record = WaypointRecord | TrialRecord | PhaseRecord | EventRecord | LookRecord | StatusRecord

STREAMS: dict[type, tuple[str, str]] = {
    WaypointRecord: ("run/waypoint", "extrinsic_msgs/msg/WaypointRecord"),
    TrialRecord: ("run/trial", "extrinsic_msgs/msg/TrialRecord"),
    PhaseRecord: ("run/phase", "extrinsic_msgs/msg/PhaseRecord"),
    EventRecord: ("run/event", "extrinsic_msgs/msg/EventRecord"),
    LookRecord: ("run/look", "extrinsic_msgs/msg/LookRecord"),
    StatusRecord: ("run/status", "extrinsic_msgs/msg/StatusRecord"),
}
"""Topic and type of each kind of record."""

_KINDS = {type_name: kind for kind, (_, type_name) in STREAMS.items()}
_STATE = "extrinsic_msgs/msg/PlanarState"
_CONTACT = "extrinsic_msgs/msg/ContactBelief"
_NOWHERE = ContactBelief("", np.empty((0, 2)), np.empty(0))


def encode_record(record: Record) -> bytes:
    """The record as CDR of its type in `STREAMS`."""
    header = messages.header(record.capture_ns, "world")
    if isinstance(record, WaypointRecord):
        truth, estimate = record.truth, record.estimated
        fields: dict[str, Any] = {
            "trial": record.trial,
            "step": record.step,
            "planned": _state(record.planned),
            "commanded": _doubles(record.commanded),
            "measured": _state(record.measured),
            "has_truth": truth is not None,
            "truth": _state(record.measured if truth is None else truth),
            "has_estimate": estimate is not None,
            "estimated": _state(record.measured if estimate is None else estimate),
            "has_contact": record.contact is not None,
            "contact": _contact(record.contact or _NOWHERE),
        }
    elif isinstance(record, LookRecord):
        fields = {
            "trial": record.trial,
            "act": record.act,
            "told": record.told,
            "sources": list(record.sources),
            "stamps": np.array(record.stamps, np.int64),
            "sequences": np.array(record.sequences, np.int64),
        }
    else:
        fields = {name: getattr(record, name) for name in record.__dataclass_fields__ if name != "capture_ns"}
    return messages.encode(messages.message(STREAMS[type(record)][1], header=header, **fields))


def decode_record(type_name: str, payload: bytes) -> Record:
    """The record in a payload. Raises ProtocolError."""
    try:
        kind = _KINDS[type_name]
    except KeyError:
        raise ProtocolError("wire", f"read {type_name}", "no record travels as this type", "") from None
    value = messages.decode(payload, type_name)
    capture_ns = messages.stamp_ns(value.header.stamp)
    if kind is WaypointRecord:
        return WaypointRecord(
            capture_ns,
            value.trial,
            value.step,
            _planar(value.planned),
            value.commanded.copy(),
            _planar(value.measured),
            _planar(value.truth) if value.has_truth else None,
            _planar(value.estimated) if value.has_estimate else None,
            _belief(value.contact) if value.has_contact else None,
        )
    if kind is LookRecord:
        return _look(capture_ns, value)
    names = [name for name in kind.__dataclass_fields__ if name != "capture_ns"]
    return kind(capture_ns, *(getattr(value, name) for name in names))


def _state(state: PlanarState) -> Any:
    nothing = np.zeros(3)
    return messages.message(
        _STATE,
        ee=_doubles(state.ee),
        has_go=state.go is not None,
        go=nothing if state.go is None else _doubles(state.go),
        has_eo=state.eo is not None,
        eo=nothing if state.eo is None else _doubles(state.eo),
        wrench=_doubles(state.wrench),
    )


def _planar(value: Any) -> PlanarState:
    return PlanarState(
        value.ee.copy(),
        value.go.copy() if value.has_go else None,
        value.eo.copy() if value.has_eo else None,
        value.wrench.copy(),
    )


def _contact(belief: ContactBelief) -> Any:
    return messages.message(
        _CONTACT,
        status=belief.status,
        x=_doubles(belief.points[:, 0]),
        y=_doubles(belief.points[:, 1]),
        weights=_doubles(belief.weights),
    )


def _belief(value: Any) -> ContactBelief:
    if not len(value.x) == len(value.y) == len(value.weights):
        got = f"{len(value.x)} x, {len(value.y)} y and {len(value.weights)} weights"
        raise ProtocolError("wire", "read where a contact was believed", got, "Expected one of each for every place")
    return ContactBelief(value.status, np.stack([value.x, value.y], axis=-1), value.weights.copy())


def _look(capture_ns: int, value: Any) -> LookRecord:
    if not len(value.sources) == len(value.stamps) == len(value.sequences):
        got = f"{len(value.sources)} sources, {len(value.stamps)} stamps and {len(value.sequences)} sequence numbers"
        raise ProtocolError("wire", "read what a look went by", got, "Expected one of each for every reading")
    numbers = tuple(value.stamps.tolist()), tuple(value.sequences.tolist())
    return LookRecord(capture_ns, value.trial, value.act, value.told, tuple(value.sources), *numbers)


def _doubles(values: Any) -> Any:
    return np.ascontiguousarray(values, dtype=np.float64)
