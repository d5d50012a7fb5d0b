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
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from radarsdf.extras import require
from radarsdf.io.bags.messages import read_message
from radarsdf.io.files import check_regular_file
from radarsdf.io.scans import Notes

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
_ENCODINGS = ("cdr", "ros1")
_PATCHED = threading.Lock()
_QUOTED = re.compile(r"\('(.*?)',\)")  # how rosbags prints the words of another error


class Topic(NamedTuple):
    """A topic of bags."""

    name: str
    message_type: str
    num_messages: int


class Message(NamedTuple):
    """A message of a bag."""

    bag: Path
    topic: str
    message_type: str
    recorded_s: float
    number: int
    """Of its topic, from 0."""
    content: Any
    """What :func:`radarsdf.io.bags.messages.read_message` returns."""


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
    for path in paths:
        with _opened(path) as reader:
            for connection in reader.connections:
                name = connection.topic
                if not (isinstance(name, str) and isinstance(connection.msgtype, str)):
                    raise _damaged(path, ValueError("a topic has no name or no type"))
                count = connection.msgcount + (topics[name].num_messages if name in topics else 0)
                topics[name] = Topic(name, _type_of(connection), count)
    return topics


def topics_with(types: Collection[str], topics: dict[str, Topic]) -> dict[str, Topic]:
    """Those that have messages of these types."""
    return {
        name: topic for name, topic in topics.items() if topic.message_type in types and topic.num_messages
    }


def read_messages(paths: list[Path], names: set[str], notes: Notes) -> Generator[Message, None, None]:
    """The messages of some topics, in the order of their recording; damaged ones are left out, and noted in the end."""
    numbers: Counter[str] = Counter()
    damaged: dict[str, list[str]] = {}
    with ExitStack() as stack:
        streams = [stack.enter_context(closing(_stream(path, names))) for path in paths]
        for recorded_s, path, connection, raw in heapq.merge(*streams, key=itemgetter(0)):
            topic, message_type = connection.topic, _type_of(connection)
            number, numbers[topic] = numbers[topic], numbers[topic] + 1
            try:
                content = read_message(raw, message_type, _encoding(connection) == "cdr")
            except ValueError as error:
                damaged.setdefault(topic, []).append(
                    f"{path}: message {number} of {topic}, at {recorded_s:.3f} s, is not a whole {message_type}: {error}"
                )
                continue
            yield Message(path, topic, message_type, recorded_s, number, content)
    for topic, texts in damaged.items():
        notes.add(f"messages left out: {len(texts)} of {numbers[topic]}; the first: {texts[0]}")


def by_record(stamps: NDArray[np.float64], what: str, wanted: str | None, notes: Notes) -> bool:
    """Whether record times stand for the header stamps of `what`: as wanted, or where these are zero or stand still."""
    if wanted is not None:
        return wanted == "record"
    if stamps.any() and (len(stamps) == 1 or (stamps != stamps[0]).any()):
        return False
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


def _stream(
    path: Path, names: set[str]
) -> Generator[tuple[float, Path, Any, bytes | memoryview], None, None]:
    """Record time, s, bag, connection of rosbags, and bytes of each message."""
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
                yield 1e-9 * recorded_ns, path, connection, raw
        except Exception as error:  # damaged bags raise exceptions of many kinds
            raise _damaged(path, error) from error


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A reader of rosbags."""
    check_regular_file(path if path.is_file() or not (path / _METADATA).is_file() else path / _METADATA)
    require("rosbags", what=f"{path}: bags are read by")
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415 - an extra

    try:
        reader: Any = (rosbag1 if path.suffix.lower() == ".bag" else rosbag2).Reader(path)
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
    why = _QUOTED.sub(r"\1", str(error) or type(error).__name__).rstrip(".")
    if isinstance(error, MemoryError):  # rosbags reads as many bytes as a damaged size says
        why = "a size in it is larger than the memory"
    cut_off = "end magic" in why or "index" in why.lower()
    remedy = "; if its recording was cut off, mcap recover or rosbag reindex may repair it" if cut_off else ""
    return ValueError(f"{path} is not a whole bag: {why}{remedy}")
