"""Messages of rosbags' tables, made as ROS makes them: without arguments, all zero."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


class Types:
    """The types of ROS 1 or 2."""

    def __init__(self, ros: int) -> None:
        self.is_ros1 = ros == 1
        store = Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE
        self.store = get_typestore(store)
        if self.is_ros1:
            content = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(
                get_types_from_msg(content, "tf2_msgs/msg/TFMessage")
            )

    def make(self, kind: str, **given: Any) -> Any:
        """A message with what is given, else zeros."""
        _, fields = self.store.fielddefs[kind]
        zeros = {name: self._zero(what) for name, what in fields}
        assert set(given) <= set(zeros)
        return self.store.types[kind](**zeros | given)

    def message_class(self, kind: str) -> type:
        """A class whose instances are made without arguments."""
        base: Any = self.store.types[kind]
        make = self.make

        def __init__(self: Any, **given: Any) -> None:
            vars(self).update(vars(make(kind, **given)))

        return type(kind.rpartition("/")[2], (base,), {"__init__": __init__})

    def sent(self, message: Any) -> Any:
        """A message as it arrives: serialised, and read again."""
        kind = message.__msgtype__
        store = self.store
        if self.is_ros1:
            return store.deserialize_ros1(store.serialize_ros1(message, kind), kind)
        return store.deserialize_cdr(store.serialize_cdr(message, kind), kind)

    def _zero(self, what: Any) -> Any:
        node, detail = what
        if node == Nodetype.NAME:
            return self.make(detail)
        if node == Nodetype.BASE:
            name = detail[0]
            texts = {"string": "", "bool": False}
            return texts.get(name, 0.0 if name.startswith("float") else 0)
        (inner, name), length = detail
        if inner == Nodetype.NAME or name[0] == "string":
            return [self._zero((inner, name)) for _ in range(length)]
        return np.zeros(length, name[0].replace("byte", "uint8"))
