"""hiros as a node of ROS 2: what a source and a sink of its graph have in common.

rclpy is that of the ROS 2 whose setup is sourced, or of the wheels. Messages stay bytes: a
subscription with ``raw`` gives them in CDR, as a bag stores them, and ``publish`` takes such bytes.
"""

from __future__ import annotations

import ctypes
import os
import re
import time
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Any

import hiros_schemas
from hiros_mcap.errors import ConfigError, LogError

ADDRESS = "ros2://"
NAME = "hiros"
"""Of the node, unless ``--ros-args -r __node:=NAME`` gives another."""
_REMEDY = (
    "source a ROS 2 of this Python (source /opt/ros/DISTRO/setup.bash, in an environment made with "
    '--system-site-packages), or install its wheels: pip install "hiros-mcap[ros2]"'
)
_IDL = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
_FIELD = re.compile(r"(?:sequence<)?([\w/]+(?:<\d+>)?)(?:, (\d+))?(>)?(\[\d+\])?")


class RosNode:
    """A node that is not spun: it waits for messages, and takes them.

    Parameters
    ----------
    arguments : what follows ``--ros-args``: remapping, namespace, parameters.

    Raises LogError if there is no ROS 2 or it does not start, ConfigError for arguments that it
    refuses.
    """

    def __init__(self, arguments: Sequence[str] = ()) -> None:
        try:
            _check_middleware()
            import rclpy
            from rclpy.signals import SignalHandlerOptions
        except ImportError as error:
            raise LogError(f"needs rclpy ({_line(error)}): {_REMEDY}", path=ADDRESS) from None
        self._context: Any = rclpy.Context()
        self._arguments = arguments
        try:
            rclpy.init(
                args=[NAME, "--ros-args", *arguments],
                context=self._context,
                signal_handler_options=SignalHandlerOptions.NO,
            )
            self.node: Any = rclpy.create_node(
                NAME, context=self._context, start_parameter_services=False
            )
        except Exception as error:  # noqa: BLE001 - RCLError, and errors of names and arguments
            self._context.try_shutdown()
            if arguments:
                text = f"--ros-args {' '.join(arguments)}: refused by ROS 2: {_line(error)}"
                raise ConfigError(text) from None
            raise LogError(f"ROS 2 does not start: {_line(error)}", path=ADDRESS) from None

    @property
    def graph(self) -> str:
        """Name of the graph in errors and summaries."""
        return f"{ADDRESS} (domain {os.environ.get('ROS_DOMAIN_ID') or 0})"

    def wait(self, subscriptions: Sequence[Any], seconds: float) -> None:
        """Wait for a message as ``rclpy.wait_for_message`` does.

        An executor would take three times as long for each message.
        """
        from rclpy.impl.implementation_singleton import rclpy_implementation

        if not subscriptions:
            time.sleep(seconds)
            return
        nothing_else = (0,) * 5
        waiting = rclpy_implementation.WaitSet(
            len(subscriptions), *nothing_else, self._context.handle
        )
        for subscription in subscriptions:
            waiting.add_subscription(subscription.handle)
        waiting.wait(round(seconds * 1e9))

    def close(self) -> None:
        """Leave the graph; a second call does nothing."""
        if self._context.ok():
            self.node.destroy_node()
            self._context.try_shutdown()

    def remapped(self) -> dict[str, str]:
        """Return the name in the graph -> the name that hiros has for it, of all remapping rules.

        A node that subscribes to what it finds needs the rules the other way round.
        """
        rules = (text.partition(":=") for text in self._arguments if ":=" in text)
        names = [left.rpartition(":")[2] for left, _, _ in rules]
        resolve = self.node.resolve_topic_name
        return {
            resolve(name): resolve(name, only_expand=True)
            for name in names
            if not name.startswith("__")
        }

    def owns(self, endpoint: Any) -> bool:
        """Whether an endpoint of the graph belongs to this node, or to another of its name."""
        here = self.node.get_name(), self.node.get_namespace()
        return (endpoint.node_name, endpoint.node_namespace) == here


def _check_middleware() -> None:
    """Raise LogError for a middleware that is not there: ROS 2 would end the process."""
    if middleware := os.environ.get("RMW_IMPLEMENTATION"):
        try:
            ctypes.CDLL(f"lib{middleware}.so")
        except OSError as error:
            raise LogError(
                f"the middleware of RMW_IMPLEMENTATION is not there ({_line(error)}): install it, "
                "or unset the variable",
                path=ADDRESS,
            ) from None


def _line(error: Exception) -> str:
    """Return the first line of an error, without its place in the sources of ROS 2."""
    return str(error).partition("\n")[0].partition(", at /")[0][:200] or type(error).__name__


@cache
def message_class(kind: str) -> Any:
    """Return the class of ``pkg/msg/Type``; None if its package is not installed.

    Raises LogError if it is installed and its libraries are not found.
    """
    package, _, name = kind.split("/")
    try:
        found = getattr(import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        return None
    try:
        from rclpy.type_support import check_is_valid_msg_type

        check_is_valid_msg_type(found)
    except Exception as error:  # noqa: BLE001 - each release raises others
        raise LogError(f"the libraries of {package} are not found: {_line(error)}") from None
    return found


def not_installed(kind: str) -> str:
    """Return the remedy for a message package that is missing."""
    package = kind.split("/")[0]
    if package in (hiros_schemas.ROS_PACKAGE.name, "tf2_msgs"):
        how = (
            "build it with colcon and source its setup, or beside the wheels: "
            "python -m hiros_schemas.ros2_packages"
        )
    else:
        how = f"install it, as ros-DISTRO-{package.replace('_', '-')}, or source its workspace"
    return f"the message package {package} is not installed; {how}"


@cache
def definition_of(kind: str) -> str:
    """Return the definition of an installed type as MCAP's ``ros2msg`` wants it.

    It is that of the Python class, so that it fits the bytes whatever the release.
    """
    texts: dict[str, str] = {}
    _define(kind, texts)
    first, *others = texts
    blocks = [f"{hiros_schemas.DELIMITER}\nMSG: {name}\n{texts[name]}" for name in others]
    return "\n".join([texts[first], *blocks])


def _define(kind: str, texts: dict[str, str]) -> None:
    """Add the text of a type, and of all that it uses."""
    texts[hiros_schemas.short_name(kind)] = ""
    lines, package = [], kind.split("/")[0]
    for name, idl in message_class(kind).get_fields_and_field_types().items():
        base, most, is_sequence, array = _FIELD.fullmatch(idl).groups()  # type: ignore[union-attr]
        suffix = array or (f"[{'<=' + most if most else ''}]" if is_sequence else "")
        word, _, longest = base.partition("<")  # string<10>
        ros_name = _IDL.get(word, word) + (f"<={longest[:-1]}" if longest else "")
        lines.append(f"{ros_name}{suffix} {name}\n")
        if "/" in base and base not in texts:
            _define("/msg/".join((base if "/" in base else f"{package}/{base}").split("/")), texts)
    texts[hiros_schemas.short_name(kind)] = "".join(lines)
