"""DDS as ROS 2 uses it: topic names, quality of service, and messages that begin with a Header.

Messages are handled in serialized form, as a generic ROS 2 subscription does: what a node
forwards is what it received, byte for byte, and the time spent here is DDS's own.

A domain of the live workload is closed: loopback only, no multicast, and a domain id that no
other process of this machine uses.
"""

import random
import socket
import struct
from dataclasses import dataclass
from typing import Any

from chainshaper.values.errors import OperationError, PlatformError

try:
    from cyclonedds import core
    from cyclonedds._clayer import ddspy_take, ddspy_write_ts
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.types import int32, sequence, uint8, uint32, uint64
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
except ImportError as error:  # no wheel for this Python or processor
    raise PlatformError(
        f"the live workload needs the `cyclonedds` package, which does not load here ({error}); "
        "wheels exist for Python 3.10 to 3.13 on x86-64: use one of these, or build it "
        "(`chainshaper doctor` says how)"
    ) from error

GuardCondition, WaitSet = core.GuardCondition, core.WaitSet
Participant = DomainParticipant  # of a domain, configured by CYCLONEDDS_URI

_DATA_HEAD = struct.Struct("<4siII4xQI")  # encapsulation, stamp, an empty frame id, number, length
_LITTLE_ENDIAN = b"\0\1\0\0"

_ANY = SampleState.Any | ViewState.Any | InstanceState.Any


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Stamped(IdlStruct, typename="chainshaper_msgs::msg::dds_::Stamped_"):
    """What the live workload's topics carry."""

    header: Header
    number: uint64
    data: sequence[uint8]  # type: ignore[type-arg]


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    """What a topic carries on which modes are announced."""

    data: str


@dataclass(frozen=True)
class Message:
    """A received message: serialized payload and the publisher's source timestamp."""

    payload: bytes
    source_timestamp: int  # ns of CLOCK_REALTIME


def closed_domain_configuration() -> str:
    """Cyclone DDS configuration (XML) of a domain that stays on this machine."""
    return (
        '<CycloneDDS><Domain Id="any"><General>'
        '<Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces>'
        "<AllowMulticast>false</AllowMulticast></General>"
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        "<MaxAutoParticipantIndex>119</MaxAutoParticipantIndex>"
        '<Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
        "</Domain></CycloneDDS>"
    )


def free_domain() -> int:
    """A DDS domain id in which no process of this machine takes part.

    Raises OperationError: all of them are in use.
    """
    for domain in random.sample(range(20, 101), 81):  # 0 to 19 are what people choose by hand
        try:
            # The first participant's unicast discovery port (DDSI-RTPS 2.3, 9.6.1.1).
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind(("127.0.0.1", 7400 + 250 * domain + 10))
            return domain
        except OSError:
            continue
    raise OperationError("no DDS domain from 20 to 100 is free: end an application that uses one")


def data_message(data: bytes | memoryview, stamp_ns: int, number: int = 0) -> bytes:
    """A message with a number and ``data`` behind a header with a stamp of CLOCK_REALTIME."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    size = memoryview(data).nbytes
    head = _DATA_HEAD.pack(_LITTLE_ENDIAN, seconds, nanoseconds, 1, number, size)
    return b"".join((head, data, bytes(-size % 4)))


def data_of(message: bytes) -> memoryview:
    """What :func:`data_message` put into a message: bytes that begin on a multiple of 32."""
    size = _DATA_HEAD.unpack_from(message)[-1]
    return memoryview(message)[_DATA_HEAD.size : _DATA_HEAD.size + size]


def number_in(message: bytes) -> int:
    """The number that :func:`data_message` put into a message."""
    return int(_DATA_HEAD.unpack_from(message)[-2])


def text_message(text: str) -> bytes:
    """A serialized ``std_msgs/String``."""
    return bytes(String(text).serialize())


def _qos(reliability: str, depth: int, lifespan_ns: int | None = None) -> Any:
    reliable = Policy.Reliability.Reliable(max_blocking_time=100_000_000)
    return Qos(
        reliable if reliability == "reliable" else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(depth),
        Policy.Durability.Volatile,
        *([] if lifespan_ns is None else [Policy.Lifespan(lifespan_ns)]),
    )


def _topic(participant: Any, name: str, carries_text: bool) -> Any:
    return Topic(participant, "rt" + name, String if carries_text else Stamped)  # ROS 2's prefix


def _counted(matched: int) -> int:
    """How many counterparts DDS counts. Raises OperationError: DDS refused to.

    The package's own lists of them ask twice, for the number and for the list, and fail where a
    counterpart is discovered between the two.
    """
    if matched < 0:
        raise OperationError(f"DDS does not say who was found, code {matched}")
    return matched


class Publisher:
    """A writer of one topic that takes serialized messages.

    Messages that a subscription has not taken ``lifespan_ns`` after they reached it are gone.
    """

    def __init__(
        self,
        participant: Any,
        topic: str,
        reliability: str,
        depth: int,
        lifespan_ns: int | None = None,
        *,
        carries_text: bool = False,
    ) -> None:
        own, qos = _topic(participant, topic, carries_text), _qos(reliability, depth, lifespan_ns)
        self._writer = DataWriter(participant, own, qos=qos)
        self._handle = self._writer._ref

    def write(self, payload: bytes, source_timestamp: int) -> None:
        code = ddspy_write_ts(self._handle, payload, source_timestamp)
        if code < 0:
            raise OperationError(f"DDS write failed with code {code}")

    def matched(self) -> int:
        """Number of subscriptions that have found this publisher."""
        return _counted(self._writer._get_matched_subscriptions(self._handle, None, 0))


class Subscription:
    """A reader of one topic that gives serialized messages, oldest first."""

    def __init__(
        self, participant: Any, topic: str, reliability: str, depth: int, carries_text: bool = False
    ) -> None:
        own = _topic(participant, topic, carries_text)
        self._reader = DataReader(participant, own, qos=_qos(reliability, depth))
        self.condition = ReadCondition(self._reader, _ANY)
        self._handle = self._reader._ref

    def ready(self) -> bool:
        # Cyclone counts the messages here; its own `triggered` is true for exactly one of them.
        return int(self.condition._triggered(self.condition._ref)) > 0

    def take(self) -> Message | None:
        """The next message, None when there is none or it only reports a publisher's state."""
        taken = ddspy_take(self._handle, _ANY, 1)
        if isinstance(taken, int):
            raise OperationError(f"DDS take failed with code {taken}")
        valid = (Message(data, info.source_timestamp) for data, info in taken if info.valid_data)
        return next(valid, None)

    def matched(self) -> int:
        """Number of publishers that have found this subscription."""
        return _counted(self._reader._get_matched_publications(self._handle, None, 0))
