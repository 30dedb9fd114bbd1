"""tf2_msgs/msg/TFMessage for rclpy: tf2_msgs has no wheel. Its type support is that of another message under its own name and
hash, which suffices for messages that are published and received as CDR."""

import ctypes
import functools

from nav_msgs.msg import Path as Donor
from rclpy.type_support import check_for_type_support

NAME = "tf2_msgs/msg/TFMessage"
HASH = bytes.fromhex("e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087")
FAST_DDS = b"rosidl_typesupport_fastrtps_c"
FIND = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
GET_HASH = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)


class TypeSupport(ctypes.Structure):
    """rosidl_message_type_support_t"""

    _fields_ = [
        ("identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("find", FIND),
        ("get_hash", GET_HASH),
        ("get_description", ctypes.c_void_p),
        ("get_sources", ctypes.c_void_p),
    ]


class Callbacks(ctypes.Structure):
    """message_type_support_callbacks_t"""

    _fields_ = [("namespace", ctypes.c_char_p), ("name", ctypes.c_char_p), ("functions", ctypes.c_void_p * 5)]


def capsule_functions():
    pointer, new = ctypes.pythonapi.PyCapsule_GetPointer, ctypes.pythonapi.PyCapsule_New
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    return pointer, new


@functools.cache
def message_class() -> type:
    pointer, new = capsule_functions()
    check_for_type_support(Donor)
    of_donor = pointer(type(Donor)._TYPE_SUPPORT, None)
    find = TypeSupport.from_address(of_donor).find
    support = TypeSupport.from_buffer_copy(TypeSupport.from_address(find(of_donor, FAST_DDS)))
    callbacks = Callbacks.from_buffer_copy(Callbacks.from_address(support.data))
    callbacks.namespace, callbacks.name = b"tf2_msgs::msg", b"TFMessage"
    number = (ctypes.c_uint8 * 33)(1, *HASH)
    get_hash = GET_HASH(lambda _: ctypes.addressof(number))
    own = ctypes.addressof(support)
    find_own = FIND(lambda _, kind: own if kind == FAST_DDS else find(of_donor, kind))
    support.data, support.get_hash, support.find = ctypes.addressof(callbacks), get_hash, find_own
    parts = {name: part for name, part in vars(type(Donor)).items() if name.startswith("_") and name.isupper()}
    parts["_TYPE_SUPPORT"] = new(own, None, None)
    # As long as the class is there, so is what its type support points at.
    parts["kept"] = (support, callbacks, number, get_hash, find_own)
    return type("Metaclass_TFMessage", (type,), parts)("TFMessage", (), {})
