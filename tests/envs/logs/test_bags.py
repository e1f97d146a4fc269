"""Bags of ROS 1 and 2 and MCAP: signals of several topics on one clock, refused by topic and message where damaged."""

import numpy as np
import pytest
import yaml
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from envs import logs
from envs.logs import containment

JOINTS = ["left_hip", "left_knee"]
COLUMNS = {
    "q.left_hip": "/joint_states.position[left_hip]",
    "q.left_knee": "/joint_states.position[left_knee]",
    "action.left_hip": "/policy.data[0]",
    "action.left_knee": "/policy.data[1]",
    "target.left_hip": "/policy.data[2]",
    "target.left_knee": "/policy.data[3]",
    "gyro.x": "/imu.angular_velocity.x",
    "gyro.y": "/imu.angular_velocity.y",
    "gyro.z": "/imu.angular_velocity.z",
}
META = {
    "robot": "biteno",
    "base": "free",
    "rate_hz": 100,
    "joints": JOINTS,
    "controller": {"type": "pd", "kp": 60.0, "kd": 2.0, "rate_hz": 1000},
    "columns": COLUMNS,
}
KINDS = ("ros1", "sqlite3", "mcap", "mcap_file")
START_NS = 1_700_000_000 * 10**9


def write(folder, kind, messages):
    """Writes a bag as run_000 of a folder: `messages` are (topic, type, fields, stamp in s)."""
    one = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    folder.mkdir(exist_ok=True)
    (folder / "meta.yaml").write_text(yaml.safe_dump(META))
    if one:
        writer = rosbag1.Writer(folder / "run_000.bag")
    else:
        plugin = rosbag2.StoragePlugin.SQLITE3 if kind == "sqlite3" else rosbag2.StoragePlugin.MCAP
        writer = rosbag2.Writer(folder / "run_000", version=9, storage_plugin=plugin)
    with writer:
        connections = {}
        for topic, name, fields, stamp in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            message = as_message(store, name, fields, stamp, one)
            raw = store.serialize_ros1(message, name) if one else store.serialize_cdr(message, name)
            writer.write(connections[topic], START_NS + round(stamp * 1e9), raw)
    if kind == "mcap_file":
        (folder / "run_000" / "run_000.mcap").rename(folder / "run_000.mcap")
        (folder / "run_000" / "metadata.yaml").unlink()
        (folder / "run_000").rmdir()
    return folder


def as_message(store, name, fields, stamp, one):
    types = store.types
    header = {"seq": 0} if one else {}
    nanoseconds = START_NS + round(stamp * 1e9)
    time = types["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    header = types["std_msgs/msg/Header"](stamp=time, frame_id="", **header)
    vector = lambda values: types["geometry_msgs/msg/Vector3"](**dict(zip("xyz", map(float, values), strict=True)))  # noqa: E731
    if name == "sensor_msgs/msg/JointState":
        empty = np.zeros(0)
        names, position = fields
        return types[name](header=header, name=names, position=np.array(position), velocity=empty, effort=empty)
    if name == "sensor_msgs/msg/Imu":
        still = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        none = np.zeros(9)
        return types[name](
            header=header,
            orientation=still,
            orientation_covariance=none,
            angular_velocity=vector(fields),
            angular_velocity_covariance=none,
            linear_acceleration=vector(fields),
            linear_acceleration_covariance=none,
        )
    if name == "geometry_msgs/msg/PoseArray":
        point = lambda values: types["geometry_msgs/msg/Point"](**dict(zip("xyz", map(float, values), strict=True)))  # noqa: E731
        turned = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        poses = [types["geometry_msgs/msg/Pose"](position=point(values), orientation=turned) for values in fields]
        return types[name](header=header, poses=poses)
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return types[name](layout=layout, data=np.array(fields, float))


def recording(seconds=0.5):
    """A policy at 100 Hz from 0.05 s on, joints at 1 kHz whose order changes, an IMU at 80 Hz, up to 0.03 s later."""
    messages = []
    for index in range(round(seconds * 1000)):
        hip, knee = 0.001 * index, -0.002 * index
        names, values = (JOINTS, (hip, knee)) if index % 2 else (JOINTS[::-1], (knee, hip))
        messages.append(("/joint_states", "sensor_msgs/msg/JointState", (names, values), 0.001 * index))
    for index in range(5, round(seconds * 100)):
        messages.append(
            ("/policy", "std_msgs/msg/Float64MultiArray", (index, -index, 10 + index, 20 + index), 0.01 * index)
        )
    for index in range(round(seconds * 80)):
        stamp = 0.0125 * index
        messages.append(("/imu", "sensor_msgs/msg/Imu", (stamp, 2 * stamp, 3 * stamp), stamp))
    return sorted(messages, key=lambda message: message[3])


@pytest.mark.parametrize("kind", KINDS)
def test_topics_meet_on_the_policys_clock(tmp_path, kind):
    (run,) = logs.read(write(tmp_path / "log", kind, recording())).runs
    # From the first word of the policy to the last of the IMU, at 0.4875 s.
    ticks = np.arange(5, 49)
    np.testing.assert_allclose(run.time, 0.01 * (ticks - 5), atol=1e-9)
    np.testing.assert_array_equal(run.signals["action"], np.stack([ticks, -ticks], axis=1))
    np.testing.assert_array_equal(run.signals["target"], np.stack([10 + ticks, 20 + ticks], axis=1))
    # Positions and rates grow along a line, which neither the mean over 10 ms nor the line between two rows changes.
    np.testing.assert_allclose(run.signals["q"], 0.01 * ticks[:, None] * [1, -2], atol=1e-9)
    np.testing.assert_allclose(run.signals["gyro"], 0.01 * ticks[:, None] * [1, 2, 3], atol=1e-9)


def test_fields_of_messages_in_an_array_are_found(tmp_path):
    stamps = 0.0125 * np.arange(40)
    feet = [("/feet", "geometry_msgs/msg/PoseArray", ((9, 9, 9), (s, 2 * s, 3 * s)), s) for s in stamps]
    places = {f"gyro.{axis}": f"/feet.poses[1].position.{axis}" for axis in "xyz"}
    (run,) = logs.read(with_topic(tmp_path / "log", [*recording(), *feet], places)).runs
    np.testing.assert_allclose(run.signals["gyro"], 0.01 * np.arange(5, 49)[:, None] * [1, 2, 3], atol=1e-9)
    absent = places | {"gyro.x": "/feet.poses[2].position.x"}
    with pytest.raises(
        ValueError, match=r"topic '/feet', message 1, 'poses\[2\]\.position\.x': list index out of range"
    ):
        logs.read(with_topic(tmp_path / "other", [*recording(), *feet], absent))


def test_a_hole_of_a_measured_topic_is_a_hole_in_time(tmp_path):
    messages = [m for m in recording() if m[0] != "/joint_states" or not 0.2 <= m[3] < 0.25]
    (run,) = logs.read(write(tmp_path / "log", "mcap", messages)).runs
    # 0.199 s and 0.25 s were heard: of the ticks, 0.20 to 0.24 s fall into the hole.
    steps = np.diff(run.time)
    np.testing.assert_allclose(np.sort(steps)[[-2, -1]], [0.01, 0.06], atol=1e-9)
    assert len(run.time) == 44 - 5


def test_what_comes_after_the_last_action_is_heard(tmp_path):
    """A policy that falls silent before its robot falls; and a command that was given once."""
    messages = [m for m in recording() if m[0] != "/policy" or m[3] < 0.295]
    messages.append(("/cmd", "std_msgs/msg/Float64MultiArray", (0.3, 0.1, -0.2), 0.01))
    messages.sort(key=lambda message: message[3])
    folder = write(tmp_path / "log", "mcap", messages)
    commands = {f"cmd.{name}": f"/cmd.data[{index}]" for index, name in enumerate(("x", "y", "yaw"))}
    (folder / "meta.yaml").write_text(yaml.safe_dump(META | {"columns": COLUMNS | commands}))
    (run,) = logs.read(folder).runs
    ticks = np.arange(5, 49)
    np.testing.assert_allclose(run.time, 0.01 * (ticks - 5), atol=1e-9)
    np.testing.assert_array_equal(run.signals["action"][:, 0], np.minimum(ticks, 29))
    np.testing.assert_allclose(run.signals["q"][:, 0], 0.01 * ticks, atol=1e-9)
    np.testing.assert_array_equal(run.signals["cmd"], np.tile([0.3, 0.1, -0.2], (len(ticks), 1)))


def with_topic(folder, messages, columns, **meta):
    """Writes a bag with more columns than those of `recording`."""
    write(folder, "mcap", sorted(messages, key=lambda message: message[3]))
    (folder / "meta.yaml").write_text(yaml.safe_dump(META | {"columns": COLUMNS | columns} | meta))
    return folder


@pytest.mark.parametrize(
    ("columns", "values"),
    [
        ({"enabled": "/flags.data[0]"}, {"enabled": np.ones(44)}),
        (
            {"contact.left": "/flags.data[0]", "contact.right": "/flags.data[1]"},
            {"contact": np.tile([1.0, 0.0], (44, 1))},
        ),
        ({f"cmd.{name}": f"/flags.data[{i}]" for i, name in enumerate(("x", "y", "yaw"))}, {"cmd": None}),
    ],
    ids=["enabled", "contact", "cmd"],
)
def test_what_is_sent_on_change_costs_no_row(tmp_path, columns, values):
    """One message at the end of the run: before it, its value is taken."""
    messages = [*recording(), ("/flags", "std_msgs/msg/Float64MultiArray", (1.0, 0.0, 0.5), 0.47)]
    log = logs.read(with_topic(tmp_path / "log", messages, columns))
    (run,) = log.runs
    np.testing.assert_allclose(run.time, 0.01 * np.arange(44), atol=1e-9)
    ((signal, expected),) = values.items()
    expected = np.tile([1.0, 0.0, 0.5], (44, 1)) if expected is None else expected
    np.testing.assert_array_equal(run.signals[signal], expected)
    assert log.notes == ()


def test_what_a_topic_costs_at_the_ends_is_noted(tmp_path):
    # Of the policy's rows, 0.05 to 0.49 s, the IMU lacks three at the beginning and two at the end.
    messages = [m for m in recording() if m[0] != "/imu" or 0.065 < m[3] < 0.48]
    log = logs.read(write(tmp_path / "log", "mcap", messages))
    assert len(log.runs[0].time) == 45 - 5
    assert log.notes == (
        "run_000: 0.025 s at the beginning were dropped, in which topic '/imu' has no message",
        "run_000: 0.015 s at the end were dropped, in which topic '/imu' has no message",
    )


def test_a_time_before_a_policy_is_noted_but_no_loss(tmp_path):
    columns = {ours: theirs for ours, theirs in COLUMNS.items() if not ours.startswith("action")}
    messages = [m for m in recording() if m[0] != "/policy" or m[3] > 0.195]
    folder = write(tmp_path / "log", "mcap", messages)
    (folder / "meta.yaml").write_text(yaml.safe_dump(META | {"columns": columns, "rate_hz": 1000}))
    log = logs.read(folder)
    assert log.notes[0] == "run_000: 0.2 s at the beginning were dropped, in which topic '/policy' has no message"
    assert len(log.runs[0].time) == 288


@pytest.mark.parametrize(("lacks", "where"), [((0.3, 0.6), "end"), ((0.0, 0.2), "beginning")])
def test_a_topic_that_costs_more_than_a_tenth_is_named(tmp_path, lacks, where):
    messages = [m for m in recording() if m[0] != "/imu" or not lacks[0] <= m[3] < lacks[1]]
    lost = {"end": r"0\.203", "beginning": r"0\.15"}[where]  # from 0.2875 s, and to 0.2 s
    named = rf"topic '/imu': got no message in {lost} s at the {where} of 0\.44 s, expected messages in 90%"
    with pytest.raises(ValueError, match=named):
        logs.read(write(tmp_path / "log", "mcap", messages))


def test_observations_and_actions_alone_are_a_log(tmp_path):
    folder = write(tmp_path / "log", "mcap", [m for m in recording() if m[0] == "/policy"])
    columns = {f"action.{name}": f"/policy.data[{i}]" for i, name in enumerate(JOINTS)} | {"obs.0": "/policy.data[2]"}
    (folder / "meta.yaml").write_text(yaml.safe_dump(META | {"columns": columns}))
    (run,) = logs.read_observed(folder).runs
    np.testing.assert_array_equal(run.signals["obs"][:, 0], np.arange(15, 60))


def test_the_name_of_a_joint_may_be_a_number(tmp_path):
    renamed = {"left_hip": "2", "left_knee": "1"}
    messages = [
        (topic, name, ([renamed[one] for one in fields[0]], fields[1]) if topic == "/joint_states" else fields, stamp)
        for topic, name, fields, stamp in recording()
    ]
    columns = {f"q.{joint}": f"/joint_states.position[{number}]" for joint, number in renamed.items()}
    (run,) = logs.read(with_topic(tmp_path / "log", messages, columns)).runs
    ticks = np.arange(5, 49)
    np.testing.assert_allclose(run.signals["q"], 0.01 * ticks[:, None] * [1, -2], atol=1e-9)


@pytest.mark.parametrize("late_s", [-0.002, 0.00005, 0.004])
def test_what_a_policy_says_on_two_topics_is_of_one_tick(tmp_path, late_s):
    messages = recording()
    kind = "std_msgs/msg/Float64MultiArray"
    messages += [("/target", kind, m[2][2:], m[3] + late_s) for m in messages if m[0] == "/policy"]
    messages.sort(key=lambda message: message[3])
    folder = write(tmp_path / "log", "mcap", messages)
    moved = {f"target.{joint}": f"/target.data[{index}]" for index, joint in enumerate(JOINTS)}
    (folder / "meta.yaml").write_text(yaml.safe_dump(META | {"columns": COLUMNS | moved}))
    (run,) = logs.read(folder).runs
    assert len(run.time) >= 43
    np.testing.assert_array_equal(run.signals["target"][:, 0], 10 + run.signals["action"][:, 0])


def test_targets_without_actions_are_heard_when_they_come(tmp_path):
    """Rows are those of the positions, and no later target is anticipated."""
    folder = write(tmp_path / "log", "mcap", [m for m in recording() if m[0] != "/imu"])
    columns = {ours: theirs for ours, theirs in COLUMNS.items() if not ours.startswith(("action", "gyro"))}
    (folder / "meta.yaml").write_text(yaml.safe_dump(META | {"columns": columns, "rate_hz": 1000}))
    (run,) = logs.read(folder).runs
    rows = np.round(1000 * run.time).astype(int) + 50
    np.testing.assert_array_equal(run.signals["target"][:, 0], 10 + rows // 10)


@pytest.mark.parametrize(
    ("columns", "named"),
    [
        ({"q.left_hip": "position[0]"}, r"columns\.q\.left_hip: got 'position\[0\]', expected /topic\.field"),
        ({"q.left_hip": "/joint_state.position[0]"}, "there is no topic '/joint_state', expected some of /imu, "),
        (
            {"q.left_hip": "/joint_states.positions[0]"},
            r"topic '/joint_states', message 1, 'positions\[0\]': .*attribute",
        ),
        ({"q.left_hip": "/joint_states.position[7]"}, r"message 1, 'position\[7\]': .*out of bounds"),
        ({"q.left_hip": "/joint_states.position[elbow]"}, r"message 1, 'position\[elbow\]': 'elbow' is not in list"),
        ({"q.left_hip": "/joint_states.name[0]"}, r"message 1, 'name\[0\]': could not convert string"),
        ({"q.left_hip": "/joint_states.position"}, "message 1, 'position': "),
        ({"t": "/joint_states.header.stamp.sec"}, r"columns\.t: .*other than the time"),
    ],
)
def test_places_that_are_not_there_are_named(tmp_path, columns, named):
    folder = write(tmp_path / "log", "mcap", recording(0.2))
    (folder / "meta.yaml").write_text(yaml.safe_dump(META | {"columns": COLUMNS | columns}))
    with pytest.raises(ValueError, match=named):
        logs.read(folder)


def test_a_bag_without_a_word_of_positions_is_named(tmp_path):
    folder = write(tmp_path / "log", "mcap", recording(0.2))
    (folder / "meta.yaml").write_text(yaml.safe_dump(META | {"columns": {}}))
    with pytest.raises(ValueError, match=r"columns: got none of 'q\.\*'"):
        logs.read(folder)


def test_time_that_stands_still_is_named(tmp_path):
    messages = recording(0.2)
    place = [index for index, message in enumerate(messages) if message[0] == "/imu"][2]
    messages[place] = (*messages[place][:3], messages[place][3] - 0.0125)
    with pytest.raises(ValueError, match=r"topic '/imu', message 3: got the time \d+ ns, expected more than \d+"):
        logs.read(write(tmp_path / "log", "ros1", messages))


def test_topics_that_never_meet_are_named(tmp_path):
    messages = [m for m in recording() if (m[3] < 0.1) == (m[0] == "/imu")]
    with pytest.raises(ValueError, match=r"have 0 row\(s\) in common"):
        logs.read(write(tmp_path / "log", "sqlite3", messages))


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_cut_short_is_named(tmp_path, kind):
    folder = write(tmp_path / "log", kind, recording())
    (path,) = [p for p in folder.rglob("*") if p.suffix in (".bag", ".mcap", ".db3")]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ValueError, match="run_000"):
        logs.read(folder)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_too_many_messages_is_refused_unread(tmp_path, monkeypatch, kind):
    folder = write(tmp_path, kind, recording())
    monkeypatch.setattr(containment, "LARGEST_BYTES", 1000)
    with pytest.raises(ValueError, match=r"^[^:]*run_000[^:]*: got .* GiB unpacked, expected at most"):
        logs.read(folder)
