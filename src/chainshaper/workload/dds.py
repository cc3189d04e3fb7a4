"""DDS as ROS 2 uses it: topic names, quality of service, and messages that begin with a Header.

Messages are handled in serialized form, as a generic ROS 2 subscription does: a node forwards the
bytes that it received, and the time that this takes is DDS's alone.

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
    """The type of the live workload's topics."""

    header: Header
    number: uint64
    data: sequence[uint8]  # type: ignore[type-arg]


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    """The type of topics on which modes are announced."""

    data: str


@dataclass(frozen=True)
class Message:
    """A received message: serialized payload and the publisher's source timestamp."""

    payload: bytes
    source_timestamp: int  # ns of CLOCK_REALTIME


def closed_domain_configuration() -> str:
    """Return the configuration of Cyclone DDS (XML) for a domain that stays on this machine."""
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
    """Return a DDS domain id in which no process of this machine takes part.

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
    """Make a serialized message: a header with a stamp (CLOCK_REALTIME), a number, and ``data``."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    size = memoryview(data).nbytes
    head = _DATA_HEAD.pack(_LITTLE_ENDIAN, seconds, nanoseconds, 1, number, size)
    return b"".join((head, data, bytes(-size % 4)))


def data_of(message: bytes) -> memoryview:
    """Return the data in a message of :func:`data_message`; it begins on a multiple of 32 bytes."""
    size = _DATA_HEAD.unpack_from(message)[-1]
    return memoryview(message)[_DATA_HEAD.size : _DATA_HEAD.size + size]


def number_in(message: bytes) -> int:
    """Return the number in a message of :func:`data_message`."""
    return int(_DATA_HEAD.unpack_from(message)[-2])


def text_message(text: str) -> bytes:
    """Make a serialized ``std_msgs/String``."""
    return bytes(String(text).serialize())


def _qos(reliability: str, depth: int, lifespan_ns: int | None = None) -> Any:
    policies = [Policy.History.KeepLast(depth), Policy.Durability.Volatile]
    if reliability == "reliable":
        policies.append(Policy.Reliability.Reliable(max_blocking_time=100_000_000))
    else:
        policies.append(Policy.Reliability.BestEffort)
    if lifespan_ns is not None:
        policies.append(Policy.Lifespan(lifespan_ns))
    return Qos(*policies)


def _topic(participant: Any, name: str, carries_text: bool) -> Any:
    return Topic(participant, "rt" + name, String if carries_text else Stamped)  # ROS 2's prefix


def _counted(matched: int) -> int:
    """Return how many counterparts DDS has counted. Raises OperationError: it refused to.

    The package's lists of counterparts ask DDS twice, for the number and for the list, and fail
    where a counterpart is discovered in between. So only the number is asked for.
    """
    if matched < 0:
        raise OperationError(f"DDS does not say who was found, code {matched}")
    return matched


class Publisher:
    """A writer of a topic that takes serialized messages.

    A message that a subscription has not taken ``lifespan_ns`` after it arrived is dropped.
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
        self._writer = DataWriter(
            participant,
            _topic(participant, topic, carries_text),
            qos=_qos(reliability, depth, lifespan_ns),
        )
        self._handle = self._writer._ref

    def write(self, payload: bytes, source_timestamp: int) -> None:
        """Write a message. Raises OperationError: DDS refuses."""
        code = ddspy_write_ts(self._handle, payload, source_timestamp)
        if code < 0:
            raise OperationError(f"DDS write failed with code {code}")

    def matched(self) -> int:
        """Return the number of subscriptions that DDS has matched with this publisher."""
        return _counted(self._writer._get_matched_subscriptions(self._handle, None, 0))


class Subscription:
    """A reader of a topic that returns serialized messages, oldest first."""

    def __init__(
        self, participant: Any, topic: str, reliability: str, depth: int, carries_text: bool = False
    ) -> None:
        self._reader = DataReader(
            participant,
            _topic(participant, topic, carries_text),
            qos=_qos(reliability, depth),
        )
        self.condition = ReadCondition(self._reader, _ANY)
        self._handle = self._reader._ref

    def ready(self) -> bool:
        """Return whether there are messages to take."""
        # Cyclone returns their number here. The package's `triggered` is true only if it is 1.
        return int(self.condition._triggered(self.condition._ref)) > 0

    def take(self) -> Message | None:
        """Take the next message; None: there is none, or only news of a publisher's state.

        Raises OperationError: DDS refuses.
        """
        taken = ddspy_take(self._handle, _ANY, 1)
        if isinstance(taken, int):
            raise OperationError(f"DDS take failed with code {taken}")
        valid = (Message(data, info.source_timestamp) for data, info in taken if info.valid_data)
        return next(valid, None)

    def matched(self) -> int:
        """Return the number of publishers that DDS has matched with this subscription."""
        return _counted(self._reader._get_matched_publications(self._handle, None, 0))
