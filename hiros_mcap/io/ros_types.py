"""Messages of any ROS type, decoded by the definitions that their log carries."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from hiros_mcap.errors import LogError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Bytes = bytes | memoryview

_HEADER = "std_msgs/msg/Header"
_HEADER_TEXT = "builtin_interfaces/Time stamp\nstring frame_id\n"


def long_name(name: str) -> str:
    """``pkg/msg/Type`` of ``pkg/Type`` or of itself."""
    package, *_, kind = name.split("/")
    return f"{package}/msg/{kind}"


def types_of(texts: Mapping[str, str]) -> Typestore:
    """Types of definitions, by name, and of what they contain; the Header is that of ROS 2.

    The definitions of standard types differ from release to release, so only those of the log
    itself tell what its bytes are. Raises LogError for text that is no definition.
    """
    return _with_types(exact_types({_HEADER: _HEADER_TEXT}), texts)


def exact_types(texts: Mapping[str, str]) -> Typestore:
    """Types of complete definitions; raises LogError for text that is none."""
    from rosbags.typesys import Stores, get_typestore

    return _with_types(get_typestore(Stores.EMPTY), texts)


def ros2_types(texts: Mapping[str, str]) -> Typestore:
    """Types of ``texts`` on top of ROS 2's standard ones, whose Header has no ``seq``.

    Raises LogError for text that is no definition.
    """
    from rosbags.typesys import Stores, get_typestore

    return _with_types(get_typestore(Stores.ROS2_HUMBLE), texts)


def _with_types(store: Typestore, texts: Mapping[str, str]) -> Typestore:
    from rosbags.typesys import get_types_from_msg

    for name, text in texts.items():
        try:
            types = get_types_from_msg(text, long_name(name))
            store.register({k: v for k, v in types.items() if k not in store.fielddefs})
        except Exception as error:  # noqa: BLE001 - its parser raises many kinds
            reason = " ".join(str(error).split())[:80]
            raise LogError(f"the definition of {name} cannot be parsed: {reason}") from None
    return store


def decoder_of(store: Typestore, name: str) -> Callable[[Bytes], Any]:
    """Return what decodes messages of a type in CDR; it raises LogError for damaged bytes."""
    return partial(_converted, store.deserialize_cdr, long_name(name))


def cdr_of(store: Typestore, name: str) -> Callable[[Bytes], bytes]:
    """Return what turns messages of ROS 1 into CDR; it raises LogError for damaged bytes."""
    convert = partial(_converted, store.ros1_to_cdr, long_name(name))
    return lambda data: bytes(convert(data))


def _converted(convert: Callable[[Bytes, str], Any], name: str, data: Bytes) -> Any:
    try:
        return convert(data, name)
    except Exception as error:  # noqa: BLE001 - damaged bytes raise anything
        raise LogError(f"a message cannot be decoded: {type(error).__name__}") from None
