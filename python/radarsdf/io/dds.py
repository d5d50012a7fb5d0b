"""Messages of ROS 2 nodes by DDS, without ROS."""

from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from radarsdf.extras import require
from radarsdf.io.bag_messages import message_types

LOOPBACK = "127.0.0.1"
QUEUED = 100  # messages of a topic: scans of 5 s at 20 Hz
# Peers on this machine by unicast, as rmw_cyclonedds with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST.
_THIS_MACHINE = (
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>99</MaxAutoParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery>'
)
_BASIC, _MESSAGE, _ARRAY = 1, 2, 3  # kinds of fields of rosbags; else a sequence


class Node:
    """A participant in a DDS domain, at the interface of address `host`. It exchanges encoded messages."""

    def __init__(self, domain: int, host: str = LOOPBACK) -> None:
        self.domain, dds = domain, _cyclonedds()
        chosen = 'autodetermine="true"' if host == "0.0.0.0" else f'address="{host}"'
        general = f"<General><Interfaces><NetworkInterface {chosen}/></Interfaces>"
        rest = _THIS_MACHINE if host == LOOPBACK else "</General>"
        try:
            # A configuration, in place of that of the environment.
            configuration = f"<CycloneDDS><Domain>{general}{rest}</Domain></CycloneDDS>"
            self._domain = dds.domain.Domain(domain, configuration)
            self._participant = dds.domain.DomainParticipant(domain)
        except dds.core.DDSException as error:
            msg = f"DDS domain {domain} cannot be joined at {host}: {error.msg}; --host takes the address of an interface"
            raise OSError(msg) from error
        builtin = dds.builtin
        self._found = builtin.BuiltinDataReader(self._participant, builtin.BuiltinTopicDcpsPublication)
        self._writers: dict[str, Any] = {}

    def close(self) -> None:
        self._domain._delete(self._domain._ref)

    def published(self) -> dict[str, dict[str, bool]]:
        """By topic, the types of messages, and whether all who publish them are reliable."""
        reliability = _cyclonedds().qos.Policy.Reliability
        topics: dict[str, dict[str, bool]] = {}
        for endpoint in self._found.read(10_000):
            # Those that left have no name.
            package, _, name = (endpoint.type_name or "").partition("::msg::dds_::")
            if name and endpoint.topic_name.startswith("rt/"):
                types = topics.setdefault(endpoint.topic_name[2:], {})
                kind, policy = f"{package}/msg/{name[:-1]}", endpoint.qos[reliability]
                types[kind] = types.get(kind, True) and isinstance(policy, reliability.Reliable)
        return topics

    def reader(self, topic: str, message_type: str, *, reliable: bool, latched: bool = False) -> Any:
        """Return a reader, `reliable` if all publishers are: else it matches none of the others. `latched`: they keep their last message."""
        qos = _qos(QUEUED, reliable=reliable, latched=latched)
        return _cyclonedds().sub.DataReader(self._participant, self._topic(topic, message_type), qos=qos)

    def publish(self, topic: str, message: Any, *, encoded: bytes = b"", latched: bool = False) -> None:
        """Publish a message of rosbags; `latched`: later subscribers get the last one, too."""
        if topic not in self._writers:
            at = self._topic(topic, message.__msgtype__)
            qos = _qos(1 if latched else QUEUED, reliable=True, latched=latched)
            self._writers[topic] = _cyclonedds().pub.DataWriter(self._participant, at, qos=qos)
        writer = self._writers[topic]
        writer.write(writer.data_type(encoded or encode(message)))

    def _topic(self, name: str, message_type: str) -> Any:
        return _cyclonedds().topic.Topic(self._participant, f"rt{name}", _dds_type(message_type))


@cache
def _cyclonedds() -> Any:
    """Import an extra, with those of its modules that are used here."""
    found = require("rosbags", "cyclonedds", what="topics of ROS 2 need")
    for name in ("builtin", "core", "domain", "idl", "pub", "qos", "sub", "topic"):
        import_module(f"cyclonedds.{name}")
    return found


def _qos(depth: int, *, reliable: bool, latched: bool) -> Any:
    policy = _cyclonedds().qos.Policy
    return _cyclonedds().qos.Qos(
        policy.Reliability.Reliable(10**8) if reliable else policy.Reliability.BestEffort,
        policy.Durability.TransientLocal if latched else policy.Durability.Volatile,
        policy.History.KeepLast(depth),
        policy.DataRepresentation(use_cdrv0_representation=True),
        policy.IgnoreLocal.Participant,
    )


@cache
def _dds_type(message_type: str) -> Any:
    """Type for cyclonedds of messages of rosbags, with fields and names as those of ROS 2, by which peers match.

    Its instances hold the bytes of a message, which rosbags encodes and decodes, as those in bags.
    """
    idl = _cyclonedds().idl
    types = idl.types

    def hint(kind: int, of: Any) -> Any:
        if kind == _BASIC:
            known = {"string": str, "bool": bool, "byte": types.uint8, "char": types.uint8}
            return known.get(of[0]) or getattr(types, of[0])
        if kind == _MESSAGE:
            return _dds_type(of)
        part = hint(*of[0])
        return types.array[part, of[1]] if kind == _ARRAY else types.sequence[part]

    package, _, name = message_type.split("/")
    fields = {field: hint(*of) for field, of in message_types(cdr=True).fielddefs[message_type][1]}
    made: Any = idl.make_idl_struct(f"{name}_", f"{package}::msg::dds_::{name}_", fields, dataclassify=False)
    # A base class would be part of the type.
    made.__init__ = lambda message, data: message.__dict__.update(data=data)
    made.serialize = lambda message, **_: message.data
    made.deserialize = made.deserialize_key = classmethod(lambda of, data, **_: of(data))
    return made


def encode(message: Any) -> bytes:
    return bytes(message_types(cdr=True).serialize_cdr(message, message.__msgtype__))


def make_message(message_type: str, **values: Any) -> Any:
    """Make a message of rosbags. Fields without values are zero or empty."""

    def zero(kind: int, of: Any) -> Any:
        if kind == _BASIC:
            return "" if of[0] == "string" else 0
        if kind == _MESSAGE:
            return make_message(of)
        part, name = of[0]
        return np.zeros(of[1], name[0]) if part == _BASIC else []

    types = message_types(cdr=True)
    fields = types.fielddefs[message_type][1]
    return types.types[message_type](**{f: values[f] if f in values else zero(*of) for f, of in fields})
