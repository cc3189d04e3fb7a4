"""A builder of event tables, so that a test reads like the story of a run.

Times are small integers (ns). A message's source timestamp is its publication time plus
:data:`OFFSET`, unless the test says otherwise.
"""

from dataclasses import dataclass, field
from typing import Any

import polars as pl

from chainshaper.values import events

OFFSET = 1_000_000
"""CLOCK_REALTIME minus the event clock."""


@dataclass(frozen=True)
class Node:
    pid: int
    handle: int


@dataclass(frozen=True)
class Callback:
    pid: int
    handle: int
    rmw_subscription: int = 0


@dataclass(frozen=True)
class Publisher:
    pid: int
    handle: int
    rmw_handle: int


@dataclass
class Story:
    rows: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    next_handle: int = 0x1000

    def event(
        self, name: str, /, time: int, pid: int, tid: int | None = None, **fields: Any
    ) -> None:
        row = {"time": time, "pid": pid, "tid": pid if tid is None else tid, **fields}
        self.rows.setdefault(name, []).append(row)

    def handle(self) -> int:
        self.next_handle += 8
        return self.next_handle

    def node(self, name: str, pid: int, time: int = 0, handle: int | None = None) -> Node:
        node = Node(pid, handle or self.handle())
        namespace, _, short = name.rpartition("/")
        handles = {"node_handle": node.handle, "rmw_handle": self.handle()}
        names: dict[str, Any] = {"node_name": short, "namespace": namespace or "/"}
        self.event("rcl_node_init", time, pid, **handles, **names)
        return node

    def publisher(self, node: Node, topic: str, time: int = 0) -> Publisher:
        publisher = Publisher(node.pid, self.handle(), self.handle())
        about: dict[str, Any] = {"node_handle": node.handle}
        about |= {"rmw_publisher_handle": publisher.rmw_handle}
        about |= {"topic_name": topic, "queue_depth": 10}
        handle = publisher.handle
        self.event("rcl_publisher_init", time, node.pid, publisher_handle=handle, **about)
        return publisher

    def timer(
        self,
        node: Node,
        period: int = 100,
        time: int = 0,
        handle: int | None = None,
        symbol: str | None = None,
    ) -> Callback:
        timer, callback = self.handle(), Callback(node.pid, handle or self.handle())
        at, handles = (time, node.pid), {"timer_handle": timer}
        self.event("rcl_timer_init", *at, **handles, period=period)
        self.event("rclcpp_timer_callback_added", *at, **handles, callback=callback.handle)
        if symbol:
            self.event("rclcpp_callback_register", *at, callback=callback.handle, symbol=symbol)
        self.event("rclcpp_timer_link_node", *at, **handles, node_handle=node.handle)
        return callback

    def subscription(
        self,
        node: Node,
        topic: str,
        time: int = 0,
        *,
        handle: int | None = None,
        symbol: str | None = None,
        callbackless: bool = False,
    ) -> Callback:
        rcl, rmw, rclcpp = self.handle(), self.handle(), self.handle()
        callback = Callback(node.pid, handle or self.handle(), rmw)
        at, handles = (time, node.pid), {"subscription_handle": rcl}
        about: dict[str, Any] = {"node_handle": node.handle, "rmw_subscription_handle": rmw}
        about |= {"topic_name": topic, "queue_depth": 10, **handles}
        self.event("rcl_subscription_init", time, node.pid, **about)
        if callbackless:
            return callback
        self.event("rclcpp_subscription_init", *at, **handles, subscription=rclcpp)
        added = {"subscription": rclcpp, "callback": callback.handle}
        self.event("rclcpp_subscription_callback_added", *at, **added)
        if symbol:
            self.event("rclcpp_callback_register", *at, callback=callback.handle, symbol=symbol)
        return callback

    def source(
        self, name: str, pid: int, topic: str, period: int = 100
    ) -> tuple[Callback, Publisher]:
        """A node whose timer publishes a topic."""
        node = self.node(name, pid)
        return self.timer(node, period), self.publisher(node, topic)

    def relay(
        self, name: str, pid: int, reads: str, writes: str, *, callbackless: bool = False
    ) -> tuple[Callback, Publisher]:
        """A node whose subscription publishes another topic."""
        node = self.node(name, pid)
        reader = self.subscription(node, reads, callbackless=callbackless)
        return reader, self.publisher(node, writes)

    def client(self, node: Node, service: str, gid: int | None = None) -> Callback:
        """A client of a service; its gid is known where tracetools has `rmw_client_init`."""
        end = Callback(node.pid, self.handle(), self.handle())
        about: dict[str, Any] = {"node_handle": node.handle, "service_name": service}
        if gid is not None:
            named: dict[str, Any] = {"rmw_client_handle": end.rmw_subscription, "gid": [gid] * 16}
            self.event("rmw_client_init", 0, node.pid, **named)
        about |= {"client_handle": end.handle, "rmw_client_handle": end.rmw_subscription}
        self.event("rcl_client_init", 0, node.pid, **about)
        return end

    def service(self, node: Node, service: str, *, callbackless: bool = False) -> Callback:
        rcl, end = self.handle(), Callback(node.pid, self.handle(), self.handle())
        about: dict[str, Any] = {"node_handle": node.handle, "service_name": service}
        about |= {"service_handle": rcl, "rmw_service_handle": end.rmw_subscription}
        self.event("rcl_service_init", 0, node.pid, **about)
        if not callbackless:
            added = {"service_handle": rcl, "callback": end.handle}
            self.event("rclcpp_service_callback_added", 0, node.pid, **added)
        return end

    def call(
        self, kind: str, end: Callback, time: int, number: int, tid: int | None = None, **more: Any
    ) -> None:
        """``kind``: send_request, take_request, send_response or take_response."""
        role = "client" if kind in ("send_request", "take_response") else "service"
        about = {f"rmw_{role}_handle": end.rmw_subscription, "sequence_number": number, **more}
        if role == "service":
            about["client_gid"] = [about["client_gid"]] * 16
        self.event(f"rmw_{kind}", time, end.pid, tid, **about)

    def start(self, callback: Callback, time: int, tid: int | None = None, intra: int = 0) -> None:
        about = {"callback": callback.handle, "is_intra_process": intra}
        self.event("callback_start", time, callback.pid, tid, **about)

    def end(self, callback: Callback, time: int, tid: int | None = None) -> None:
        self.event("callback_end", time, callback.pid, tid, callback=callback.handle)

    def take(
        self, callback: Callback, time: int, sent: int, tid: int | None = None, taken: int = 1
    ) -> None:
        """Take the message that was published at ``sent``."""
        message = {"message": 1, "source_timestamp": sent + OFFSET, "taken": taken}
        reader = callback.rmw_subscription
        self.event("rmw_take", time, callback.pid, tid, rmw_subscription_handle=reader, **message)

    def publish(self, publisher: Publisher, time: int, tid: int | None = None) -> None:
        message = {"message": 1, "timestamp": time + OFFSET}
        writer = publisher.rmw_handle
        self.event("rmw_publish", time, publisher.pid, tid, rmw_publisher_handle=writer, **message)

    def runs(
        self,
        callback: Callback,
        start: int,
        end: int | None,
        *,
        reads: int | None = None,
        writes: tuple[tuple[Publisher, int], ...] = (),
        tid: int | None = None,
    ) -> None:
        """One instance, which took the message sent at ``reads`` just before it started."""
        if reads is not None:
            self.take(callback, start - 1, reads, tid)
        self.start(callback, start, tid)
        for publisher, time in writes:
            self.publish(publisher, time, tid)
        if end is not None:
            self.end(callback, end, tid)

    def gate(
        self, callback: Callback, /, sent: int, arrival: int, release: int | None, **fields: Any
    ) -> None:
        """A gate's decision about the message sent at ``sent``; ``fields`` differ from usual."""
        usual: dict[str, Any] = {"slot": 0, "cycles_waited": 0, "anchor": "stamp", "overrun": None}
        known: dict[str, Any] = {"callback": callback.handle, "source_timestamp": sent + OFFSET}
        known |= {"arrival": arrival, "release": release, **usual, **fields}
        self.event("gate_release", release or arrival, callback.pid, **known)

    def tables(self) -> dict[str, pl.DataFrame]:
        """The event tables, each sorted by time; events at one time keep the order of telling."""
        tables = {}
        for name, rows in self.rows.items():
            types = {**events.COMMON_COLUMNS, **events.FIELDS[name]}
            types |= events.OPTIONAL_FIELDS.get(name, {})
            table = pl.DataFrame(rows, schema_overrides=types, infer_schema_length=None)
            tables[name] = table.sort("time", maintain_order=True)
        return tables
