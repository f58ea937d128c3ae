"""rclpy, tf2_ros and message packages as far as the node uses them, with rclpy's own signatures.

Messages are rosbags' classes; whatever is published goes through CDR, as the middleware would have it.
"""

import sys
from types import ModuleType, SimpleNamespace

from lcf3d.formats.ros_types import store

TYPES = store()


class MessageKind(type):
    """Classes such as ``std_msgs.msg.Header``: made from keywords, checked as rclpy does."""

    def __call__(cls, **fields):
        if cls.kind.endswith("DiagnosticStatus"):
            assert isinstance(fields["level"], bytes), "rclpy takes a byte here"
            assert len(fields["level"]) == 1
            fields["level"] = fields["level"][0]
        return TYPES.types[cls.kind](**fields)


class Publisher:
    def __init__(self, msg_type):
        self.msg_type, self.sent = msg_type, []

    def publish(self, msg):
        kind = self.msg_type.kind
        assert msg.__msgtype__ == kind
        self.sent.append(TYPES.deserialize_cdr(TYPES.serialize_cdr(msg, kind), kind))


class Node:
    def __init__(self, node_name, *, parameters=None):
        self.name, self._given = node_name, parameters or {}
        self.subscriptions, self.publishers, self.timers, self.warnings = {}, {}, [], []

    def declare_parameter(self, name, value=None, descriptor=None, ignore_override=False):
        given = self._given.get(name, value)
        assert type(given) is type(value), f"{name} is a {type(value)}"
        return SimpleNamespace(name=name, value=given)

    def create_subscription(self, msg_type, topic, callback, qos_profile, *, callback_group=None, raw=False):
        assert topic not in self.subscriptions
        self.subscriptions[topic] = (msg_type, callback)

    def create_publisher(self, msg_type, topic, qos_profile, *, callback_group=None):
        self.publishers[topic] = Publisher(msg_type)
        return self.publishers[topic]

    def create_timer(self, timer_period_sec, callback, callback_group=None, clock=None):
        self.timers.append((timer_period_sec, callback))

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=5_000_000_000))

    def destroy_node(self):
        self.subscriptions.clear()

    def receive(self, topic, message):
        """A message comes over the wire."""
        kind, callback = self.subscriptions[topic]
        assert message.__msgtype__ == kind.kind
        callback(TYPES.deserialize_cdr(TYPES.serialize_cdr(message, kind.kind), kind.kind))


class TransformException(Exception):
    pass


class ExternalShutdownException(Exception):
    pass


class Buffer:
    def __init__(self, cache_time=None, node=None):
        self.known = {}

    def lookup_transform(self, target_frame, source_frame, time, timeout=None):
        if (target_frame, source_frame) not in self.known:
            raise TransformException(f"{source_frame} is not connected to {target_frame}")
        return self.known[target_frame, source_frame]


def modules(node):
    """What ``import`` would find where ROS 2 is sourced, by module name."""
    found = {}
    for kind in TYPES.types:
        package, middle, name = kind.split("/")
        if middle == "msg":
            module = found.setdefault(f"{package}.msg", ModuleType(f"{package}.msg"))
            setattr(module, name, MessageKind(name, (), {"kind": kind}))
            found.setdefault(package, ModuleType(package))
    found["rclpy"] = rclpy = ModuleType("rclpy")
    rclpy.calls = []
    rclpy.init = lambda *, args=None, context=None: rclpy.calls.append(("init", args))
    rclpy.create_node = lambda node_name, *, context=None, namespace=None: node
    rclpy.spin = lambda node, executor=None: rclpy.calls.append(("spin", node))
    rclpy.try_shutdown = lambda *, context=None: rclpy.calls.append(("shutdown", None))
    found["rclpy.qos"] = SimpleNamespace(qos_profile_sensor_data="sensor data")
    found["rclpy.executors"] = SimpleNamespace(ExternalShutdownException=ExternalShutdownException)
    found["rclpy.time"] = SimpleNamespace(Time=lambda seconds=0, nanoseconds=0: (seconds, nanoseconds))
    found["tf2_ros"] = SimpleNamespace(
        Buffer=Buffer, TransformException=TransformException, TransformListener=lambda buffer, node: object()
    )
    return found


def install(monkeypatch, node):
    """Put the stand-ins where ``import`` finds them."""
    found = modules(node)
    for name, module in found.items():
        monkeypatch.setitem(sys.modules, name, module)
    return found
