"""Reads ROS 1 and ROS 2 bags and MCAP files. `columns` in `meta.yaml` says where each column is found:

    columns:
      q.left_knee: /joint_states.position[left_knee]    # its place in the message's own `name`
      gyro.x: /imu.angular_velocity.x
      action.left_knee: /policy.data[2]

A bag has a clock per topic, a run has one for all signals. These rules make one of them:

- The rows are the messages of one topic: that of the actions if there is one, else that of the positions.
- Other topics are sampled at these times. What a policy sends on other topics belongs to the tick whose action is
  nearest. (A tick is one step of the policy.)
- Time is the stamp in the headers if all messages have one, else the recorder's; it starts at zero.
- A run begins where the last of its topics begins, and ends where the first measured one ends. A note says what is
  lost of its rows by that; if measured topics cost more than a tenth of them, the bag is refused.
- Topics of commands may end early. Topics that are sent on change (`enabled`, `cmd`, `contact`) may also begin late:
  before its first message the first value is taken.
- Rows continue for a while after the last action, because a policy may stop before its robot falls.
- Rows in a hole of a measured topic are left out, which leaves a hole in the time stamps.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from envs.logs.containment import TooLarge, check_size
from envs.logs.sampling import HELD, ON_CHANGE, SENT, held, sampled

SUFFIXES = (".bag", ".mcap", ".db3")
"""Suffixes of bags that are files; a folder with a `metadata.yaml` is a bag as well."""

_PLACE = re.compile(r"(?P<topic>/[^.\[\]\s]+)\.(?P<field>\w+(?:(?:\[\d+\])?\.\w+)*)(?:\[(?P<index>[^\[\]]+)\])?")
_MESSAGE_BYTES = 512  # that the values of a message take until all are read
_HOLE = 3.5  # periods of a topic without a message that count as a hole
_NOTED, _MOST_LOST = 0.01, 0.1  # shares of a run's time at its ends
_MORE_ROWS = 500  # at most, after the last message of the topic that gives the rows


def is_bag(path: Path) -> bool:
    """Returns whether a path is a ROS bag or MCAP file, by its suffix, or a ROS 2 bag's folder."""
    return (path.suffix in SUFFIXES and path.is_file()) or (path / "metadata.yaml").is_file()


@dataclass(frozen=True)
class _Place:
    """Where a column is found in a bag: topic, names and indices on the way to a field, and index in the field."""

    topic: str
    way: tuple[str | int, ...]
    index: str | None

    def __call__(self, message: Any) -> float:
        value = message
        for step in self.way:
            value = value[step] if isinstance(step, int) else getattr(value, step)
        if self.index is None:
            return float(value)
        names = getattr(message, "name", None)
        names = names if isinstance(names, list) else []
        # The name of a joint may be a number.
        is_index = self.index.isdecimal() and self.index not in names
        return float(value[int(self.index) if is_index else names.index(self.index)])


@dataclass(frozen=True)
class _Topic:
    """Messages of a topic: their times and the values of the columns found on it."""

    time: np.ndarray
    """[messages] ns"""
    values: Mapping[str, np.ndarray]
    """[messages] by our name of the column."""

    @property
    def signals(self) -> set[str]:
        """Names of the signals that have columns on this topic (`q`, `gyro`, ...)."""
        return {_signal(ours) for ours in self.values}


def _signal(column: str) -> str:
    return column.partition(".")[0]


def read_bag(path: Path, columns: Mapping[str, str]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Reads the columns that `meta.yaml` maps to places in a bag.

    Args:
      path: of the bag.
      columns: place in the bag by the format's name of the column.

    Returns:
      Columns [rows] by their place, and `t` in s; and notes about what was lost at the ends.

    Raises:
      ValueError: names the topic, and the message (from 1) and field where it is about one.
    """
    places = {}
    for ours, theirs in columns.items():
        match = _PLACE.fullmatch(theirs)
        if ours == "t" or not match:
            raise ValueError(
                f"{path}: columns.{ours}: got '{theirs}', expected /topic.field, /topic.field[3], "
                "/topic.field[name] or /topic.field[3].field "
                "of something other than the time, which comes with the messages"
            )
        way = tuple(int(part) if part.isdecimal() else part for part in re.findall(r"\w+", match["field"]))
        places[ours] = _Place(match["topic"], way, match["index"])
    # Actions first, so that rows are the policy's own steps.
    of_rows = [ours for first in ("action.", "q.") for ours in places if ours.startswith(first)]
    if not of_rows:
        raise ValueError(f"{path}: columns: got none of 'q.*', expected where in the bag the positions are")
    topics = _read_topics(path, places)
    ticks = places[of_rows[0]].topic
    period, start, time, notes = _rows(path, topics, ticks)
    found = {"t": time}
    for name, topic in topics.items():
        at = 1e-9 * (topic.time - start)
        # What a policy sends in one tick on two topics arrives at slightly different times, in either order.
        late = 0.5 * period if name != ticks and topics[ticks].signals & {*SENT} else 0.0
        for ours, values in topic.values.items():
            if _signal(ours) in HELD:
                found[columns[ours]] = held(at, values, time + late if _signal(ours) in SENT else time)
            else:
                found[columns[ours]] = sampled(at, values, time, period)
    return found, notes


def _rows(path: Path, topics: Mapping[str, _Topic], of_rows: str) -> tuple[float, int, np.ndarray, list[str]]:
    """Returns the period of the rows in s, the first stamp in ns, the times [rows] in s from there, and notes."""
    # A command holds until the next one, so its topic may end early or have holes; a measurement may not.
    measured = {name: topic for name, topic in topics.items() if topic.signals - {*SENT, *ON_CHANGE}}
    sent = {name: topic for name, topic in topics.items() if topic.signals & {*SENT}}
    for name in dict.fromkeys([of_rows, *measured]):
        if len(topics[name].time) < 2:
            raise ValueError(f"{path}, topic '{name}': got 1 message, expected 2 or more")
    # The rows come from positions or actions, so there is one topic or more.
    start = max(int(topic.time[0]) for topic in (measured | sent).values())
    stamps = topics[of_rows].time
    whole = int(stamps[0]), int(stamps[-1])
    end = min((int(topic.time[-1]) for topic in measured.values()), default=whole[1])
    period = int(np.median(np.diff(stamps)))
    more = min((end - int(stamps[-1])) // period, _MORE_ROWS)
    stamps = np.append(stamps, stamps[-1] + period * np.arange(1, 1 + more))
    stamps = stamps[(stamps >= start) & (stamps <= end)]
    for name, topic in measured.items():
        if name == of_rows:
            continue
        holes = np.diff(topic.time)
        wide = holes > _HOLE * np.median(holes)
        after = np.clip(np.searchsorted(topic.time, stamps), 1, len(topic.time) - 1)
        stamps = stamps[~wide[after - 1] | (topic.time[after] == stamps)]
    if len(stamps) < 2:
        raise ValueError(f"{path}: the topics {', '.join(topics)} have {len(stamps)} row(s) in common, expected more")
    time = 1e-9 * (stamps - stamps[0])
    return float(np.median(np.diff(time))), int(stamps[0]), time, _lost(path, whole, measured, sent)


def _lost(path: Path, whole: tuple[int, int], measured: Mapping[str, _Topic], sent: Mapping[str, _Topic]) -> list[str]:
    """Says what a run loses at its ends because topics begin late or end early.

    Args:
      path: of the bag.
      whole: first and last stamp of the topic that gives the rows, in ns.
      measured: topics that sensors send.
      sent: topics that a policy sends.

    Raises:
      ValueError: more than a tenth is lost because of a measured topic.
    """
    begin, end = whole
    cuts, lost = [], []
    if sent:
        first, name = max((int(topic.time[0]), name) for name, topic in sent.items())
        cuts = [(first - begin, "beginning", name)]
        # What comes before a policy's first command is no loss: the policy had not begun.
        begin = max(begin, first)
    if measured:
        first, late = max((int(topic.time[0]), name) for name, topic in measured.items())
        last, early = min((int(topic.time[-1]), name) for name, topic in measured.items())
        lost = [(first - begin, "beginning", late), (end - last, "end", early)]
    if sum(max(0, time) for time, _, _ in lost) > _MOST_LOST * (end - begin):
        time, where, name = max(lost)
        raise ValueError(
            f"{path}, topic '{name}': got no message in {1e-9 * time:.3g} s at the {where} of "
            f"{1e-9 * (whole[1] - whole[0]):.3g} s, expected messages in {1 - _MOST_LOST:.0%} of the time or more: "
            "rows without them would be lost"
        )
    return [
        f"{path.stem}: {1e-9 * time:.3g} s at the {where} were dropped, in which topic '{name}' has no message"
        for time, where, name in (*cuts, *lost)
        if time > _NOTED * (whole[1] - whole[0])
    ]


def _read_topics(path: Path, places: Mapping[str, _Place]) -> dict[str, _Topic]:
    """Reads all messages of the topics that are needed."""
    # rosbags is an optional dependency.
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise ValueError(f"{path}: reading a bag needs rosbags: pip install 'jaxtune[bags]'") from error
    store = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_HUMBLE)
    found = {place.topic: [] for place in places.values()}
    try:
        with AnyReader([path], default_typestore=store) as reader:
            for topic in found:
                if topic not in reader.topics:
                    raise LookupError(f"there is no topic '{topic}', expected some of {', '.join(reader.topics)}")
            check_size(path, _MESSAGE_BYTES * sum(reader.topics[topic].msgcount for topic in found))
            connections = [one for one in reader.connections if one.topic in found]
            for connection, recorded, raw in reader.messages(connections):
                messages = found[connection.topic]
                message = reader.deserialize(raw, connection.msgtype)
                messages.append(_read(message, recorded, connection.topic, len(messages) + 1, places))
    except TooLarge:
        raise
    except Exception as error:  # a damaged bag fails in many ways
        raise ValueError(f"{path}: {type(error).__name__}: {error}") from error
    # One clock for all topics: stamps of some would be compared with the recorder's times of others.
    stamped = all(stamp for messages in found.values() for stamp, _, _ in messages)
    return {topic: _topic(path, topic, messages, 0 if stamped else 1, places) for topic, messages in found.items()}


def _read(message: Any, recorded: int, topic: str, number: int, places: Mapping[str, _Place]) -> tuple:
    """Returns stamp and time of recording of a message, in ns, and its values in the order of the topic's places."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    values = []
    for place in places.values():
        if place.topic == topic:
            try:
                values.append(place(message))
            except (AttributeError, IndexError, TypeError, ValueError) as error:
                field = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in place.way)[1:]
                field += f"[{place.index}]" if place.index else ""
                raise ValueError(f"topic '{topic}', message {number}, '{field}': {error}") from error
    return stamp.sec * 10**9 + stamp.nanosec if stamp else 0, recorded, values


def _topic(path: Path, name: str, messages: list[tuple], clock: int, places: Mapping[str, _Place]) -> _Topic:
    time = np.array([message[clock] for message in messages], np.int64)
    if not len(time):
        raise ValueError(f"{path}, topic '{name}': got no message, expected some")
    late = np.diff(time) <= 0
    if late.any():
        number = int(np.argmax(late)) + 2
        raise ValueError(
            f"{path}, topic '{name}', message {number}: got the time {time[number - 1]} ns, expected more than "
            f"{time[number - 2]} of the message before"
        )
    mine = [ours for ours, place in places.items() if place.topic == name]
    return _Topic(time, dict(zip(mine, np.array([message[2] for message in messages]).T, strict=True)))
