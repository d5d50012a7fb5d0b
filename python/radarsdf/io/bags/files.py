# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Bags of ROS 1 and ROS 2 as streams of messages, without ROS."""

from __future__ import annotations

import heapq
import importlib
import re
import threading
from collections import Counter
from collections.abc import Collection, Generator, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.extras import require
from radarsdf.io.bags.messages import read_message
from radarsdf.io.files import check_regular_file
from radarsdf.io.scans import Notes

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
_ROS1_SUFFIX = ".bag"
_METADATA = "metadata.yaml"
_ENCODINGS = ("cdr", "ros1")
_PATCHED = threading.Lock()
_QUOTED = re.compile(r"\('(.*?)',\)")  # how rosbags prints the words of another error


@dataclass(frozen=True)
class Topic:
    """A topic of bags."""

    name: str
    message_type: str
    count: int
    """Number of its messages."""


@dataclass(frozen=True)
class Message:
    """A message of a bag."""

    topic: str
    message_type: str
    recorded_s: float
    raw: bytes | memoryview
    cdr: bool
    """Whether it is of ROS 2."""
    bag: Path
    content: Any = None
    """What :func:`radarsdf.io.bags.messages.read_message` returns."""
    number: int = 0
    """Of its topic, from 0."""


def is_bag(path: Path) -> bool:
    """Whether the path is a bag by its name, or a folder that is a ROS 2 bag, whose files were not renamed."""
    if path.suffix.lower() in BAG_SUFFIXES or not (path / _METADATA).is_file():
        return path.suffix.lower() in BAG_SUFFIXES
    listed = (path / _METADATA).read_text(encoding="utf-8", errors="replace")
    files = [file.name for file in path.iterdir() if file.suffix.lower() in BAG_SUFFIXES]
    return not files or any(name in listed for name in files)


def bags_in(folder: Path) -> list[Path]:
    """The bags in a folder, by name."""
    return sorted(path for path in folder.iterdir() if is_bag(path) and not path.name.startswith("."))


def topics_of(paths: list[Path]) -> dict[str, Topic]:
    """The topics of bags, by name."""
    topics: dict[str, Topic] = {}
    with ExitStack() as stack:
        for path in paths:
            for connection in stack.enter_context(_opened(path)).connections:
                if not (isinstance(connection.topic, str) and isinstance(connection.msgtype, str)):
                    raise _damaged(path, ValueError("a topic has no name or no type"))
                name = connection.topic
                count = connection.msgcount + (topics[name].count if name in topics else 0)
                topics[name] = Topic(name, _type_of(connection), count)
    return topics


def topics_with(types: Collection[str], topics: dict[str, Topic]) -> dict[str, Topic]:
    """Those that have messages of these types."""
    return {name: topic for name, topic in topics.items() if topic.message_type in types and topic.count}


def read_messages(paths: list[Path], names: set[str], notes: Notes) -> Generator[Message, None, None]:
    """The messages of some topics, in the order of their recording; damaged ones are left out, and noted in the end."""
    numbers: Counter[str] = Counter()
    damaged: dict[str, list[str]] = {}
    with ExitStack() as stack:
        streams = [stack.enter_context(closing(_stream(path, names))) for path in paths]
        for message in heapq.merge(*streams, key=lambda message: message.recorded_s):
            topic, number = message.topic, numbers[message.topic]
            numbers[topic] += 1
            try:
                content = read_message(message.raw, message.message_type, message.cdr)
            except ValueError as error:
                damaged.setdefault(topic, []).append(
                    f"{message.bag}: message {number} of {topic}, at {message.recorded_s:.3f} s, is not a whole "
                    f"{message.message_type}: {error}"
                )
                continue
            yield replace(message, content=content, number=number)
    for topic, texts in damaged.items():
        notes.add(f"messages left out: {len(texts)} of {numbers[topic]}; the first: {texts[0]}")


def by_record(stamps: NDArray[np.float64], what: str, wanted: str | None, notes: Notes | None) -> bool:
    """Whether record times stand for the header stamps of `what`: as wanted, or where these are zero or stand still."""
    if wanted is not None:
        return wanted == "record"
    if stamps.any() and (len(stamps) == 1 or (stamps != stamps[0]).any()):
        return False
    if notes is not None:
        why = "stand still" if stamps.any() else "are zero"
        notes.add(f"the header stamps of {what} {why}: the record time is used instead")
    return True


def _type_of(connection: Any) -> str:
    """As ROS 2 writes it, and the encoding where it is none of ROS, as MCAP files may have."""
    package, slash, name = connection.msgtype.partition("/")
    ros2 = connection.msgtype if not slash or "/" in name else f"{package}/msg/{name}"
    encoding = _encoding(connection)
    return ros2 if encoding in _ENCODINGS else f"{ros2} in {encoding}"


def _encoding(connection: Any) -> str:
    return str(getattr(connection.ext, "serialization_format", "ros1"))


def _stream(path: Path, names: set[str]) -> Generator[Message, None, None]:
    with _opened(path) as reader:
        connections = [c for c in reader.connections if c.topic in names and _encoding(c) in _ENCODINGS]
        if not connections:  # of none, rosbags would give all messages
            return
        try:
            for connection, recorded_ns, raw in reader.messages(connections=connections):
                # A database of SQLite may hold values of any type.
                if not (isinstance(recorded_ns, int) and isinstance(raw, (bytes, memoryview))):
                    msg = "a message has no time or no bytes"
                    raise ValueError(msg)  # noqa: TRY004 - the file is damaged
                cdr = _encoding(connection) == "cdr"
                yield Message(connection.topic, _type_of(connection), 1e-9 * recorded_ns, raw, cdr, path)
        except Exception as error:  # damaged bags raise exceptions of many kinds
            raise _damaged(path, error) from error


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A reader of rosbags."""
    check_regular_file(path if path.is_file() or not (path / _METADATA).is_file() else path / _METADATA)
    require("rosbags", what=f"{path}: bags are read by")
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415 - an extra

    try:
        if path.suffix.lower() == _ROS1_SUFFIX:
            reader: Any = rosbag1.Reader(path)
            reader.open()
        else:
            reader = rosbag2.Reader(path)
            with _any_mcap():
                reader.open()
    except PermissionError:
        raise
    except Exception as error:  # damaged bags raise exceptions of many kinds, OSError among them
        raise _damaged(path, error) from error
    try:
        yield reader
    finally:
        reader.close()


@contextmanager
def _any_mcap() -> Iterator[None]:
    """Within it, rosbags opens MCAP files of any profile and encoding of schemas, of which it knows one."""
    storage: Any = importlib.import_module("rosbags.rosbag2.storage_mcap")
    with _PATCHED:
        read_string, schema = storage.read_string, storage.Schema

        def any_string(file: Any) -> str:
            start, raw = file.tell(), storage.read_bytes(file)
            text = str(raw.decode(errors="replace"))
            # What begins a record is the profile of the file, or a key.
            return text if start or text == "offered_qos_profiles" else "ros2"

        storage.read_string = any_string
        storage.Schema = lambda number, name, _, data: schema(number, name, "ros2msg", data)
        try:
            yield
        finally:
            storage.read_string, storage.Schema = read_string, schema


def _damaged(path: Path, error: Exception) -> ValueError:
    why = str(error) or type(error).__name__
    if isinstance(error, MemoryError):  # rosbags reads as many bytes as a damaged size says
        why = "a size in it is larger than the memory"
    why = _QUOTED.sub(r"\1", why).rstrip(".")
    remedy = ""
    if path.suffix.lower() == _ROS1_SUFFIX and "index" in why.lower():
        remedy = f"; if its recording was cut off, rosbag reindex {path.name} may repair it"
    elif "end magic" in why:
        files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        name = files[0].name if files else path.name
        remedy = f"; if its recording was cut off, mcap recover {name} may repair it"
    return ValueError(f"{path} is not a whole bag: {why}{remedy}")
