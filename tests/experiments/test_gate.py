"""What `discover` refuses before it computes: logs that cannot answer, and logs that would make it answer wrongly."""

import shutil
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from envs.diagnosis.contacts import contacts
from envs.diagnosis.finding import MISLEADING
from envs.logs import Controller, read, write
from experiments import discover
from experiments.common import checkpoint
from experiments.discovery import gate
from experiments.discovery.blind_cases import ARM
from experiments.discovery.blind_drive import Truth
from experiments.discovery.blind_robots import record
from experiments.discovery.excitation import excitation
from experiments.discovery.measured import digest, read_logs

JOINTS = ("shoulder", "elbow")
GAINS = {"kp": np.array([40.0, 20.0]), "kd": np.array([2.0, 0.8]), "torque_limit_nm": np.array([15.0, 15.0])}
HORIZONS = (0.05, 0.1, 0.2)


@pytest.fixture(scope="module")
def good():
    """A log of the arm in another engine, its sensors noisy; it names its model by its path."""
    spec = mujoco.MjSpec.from_file(str(ARM))
    controller = Controller(kind="pd", rate_hz=1000.0, gains=GAINS)
    log = record(spec, JOINTS, excitation(spec, JOINTS, 4, 2.0, 500.0), controller, Truth(None), 0.1, 3)
    return replace(log, robot=str(ARM))


def signals(log, **changes):
    """The log with signals of every run changed by functions of them."""
    runs = [replace(run, signals=run.signals | {k: f(run.signals[k]) for k, f in changes.items()}) for run in log.runs]
    return replace(log, runs=tuple(runs))


def gains(log, **changes):
    runs = [
        replace(run, controller=replace(run.controller, gains={**run.controller.gains, **changes})) for run in log.runs
    ]
    return replace(log, runs=tuple(runs))


def without(log, *names):
    runs = [replace(run, signals={k: v for k, v in run.signals.items() if k not in names}) for run in log.runs]
    return replace(log, runs=tuple(runs))


def at(log, *rows):
    """The log without some rows."""
    runs = [
        replace(
            run,
            time=np.delete(run.time, rows),
            signals={k: np.delete(v, rows, axis=0) for k, v in run.signals.items()},
        )
        for run in log.runs
    ]
    return replace(log, runs=tuple(runs))


def jumped(log):
    return replace(log, runs=tuple(replace(r, time=r.time + 0.4 * (r.time > 0.9)) for r in log.runs))


MISLED = {
    # Without a limit, as in degrees every motor would be at it.
    "degrees": (
        lambda log: gains(signals(log, q=np.degrees, dq=np.degrees), torque_limit_nm=np.full(2, np.inf)),
        "degrees for radians",
    ),
    "swapped joints": (lambda log: signals(log, q=lambda v: v[:, ::-1], dq=lambda v: v[:, ::-1]), "are swapped"),
    "flipped sign": (lambda log: signals(log, q=lambda v: v * [1, -1], dq=lambda v: v * [1, -1]), "a flipped sign"),
    "missing rows": (lambda log: at(log, *range(300, 340)), "rows are missing after row 300"),
    "clock jump": (jumped, "the clock jumps after row"),
    "misspelt column": (
        lambda log: replace(
            without(log, "enabled"),
            runs=tuple(
                replace(new, other={"Enabled": old.signals["enabled"]})
                for old, new in zip(log.runs, without(log, "enabled").runs, strict=True)
            ),
        ),
        "column 'Enabled' is not known; rename it to 'enabled'",
    ),
}


def check(log, **options):
    return gate.check(log, mujoco.MjSpec.from_file(str(ARM)), HORIZONS, **options)


def test_a_good_log_passes_without_a_word(good):
    assert check(good) == []


@pytest.mark.parametrize("kind", MISLED)
def test_what_would_mislead_is_refused_unless_the_log_is_trusted(good, kind):
    assert kind in MISLEADING
    damage, sentence = MISLED[kind]
    damaged = damage(good)
    with pytest.raises(ValueError, match=sentence) as refused:
        check(damaged)
    assert "--trust-log" in str(refused.value)
    assert any(sentence in note for note in check(damaged, trust=True))


def test_what_does_not_mislead_is_a_note(good):
    late = replace(
        good,
        runs=tuple(
            replace(
                run,
                time=run.time[15:],
                signals={k: v[:-15] if k in ("q", "dq") else v[15:] for k, v in run.signals.items()},
            )
            for run in good.runs
        ),
    )
    assert any("an apparent delay of" in note for note in check(late))


def test_sealed_runs_are_not_looked_at(good):
    runs = [
        replace(run, signals=run.signals | {"q": np.degrees(run.signals["q"])}) if run.split == "sealed" else run
        for run in good.runs
    ]
    assert check(replace(good, runs=tuple(runs))) == []


def servo(log):
    """Motors that are at their limit in all rows."""
    return gains(signals(log, target=lambda v: v + 1.5), torque_limit_nm=np.array([0.2, 0.2]))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda log: replace(log, runs=log.runs[:1]), "no run is left for 'select'"),
        (lambda log: replace(log, joints=("elbow",)), "joints: got a log without shoulder"),
        (lambda log: at(log, *range(200, 1000)), "'train' has room for 2 segment"),
        (lambda log: signals(log, q=lambda v: v[:1] + 1e-4 * np.sin(np.arange(len(v)))[:, None]), "a robot at rest"),
        (lambda log: gains(log, kp=np.zeros(2)), "controller.kp: got 0 for shoulder, elbow, expected the controller's"),
        (lambda log: gains(log, kp=np.array([0.0, 20.0])), "controller.kp: got 0 for shoulder, expected"),
        (servo, "got controllers at their limit in 100% of the rows"),
    ],
)
def test_a_log_that_cannot_answer_is_refused_though_it_is_trusted(good, damage, message):
    with pytest.raises(ValueError, match=message):
        check(damage(good), trust=True)


def test_a_passive_joint_needs_no_gain(good):
    still = signals(good, target=lambda v: v * [0, 1])
    gate._check_driven(gains(still, kp=np.array([0.0, 20.0])))


def test_torques_that_were_sent_need_no_gain(good):
    sent = without(good, "target")
    sent = replace(sent, runs=tuple(replace(r, signals=r.signals | {"tau": r.signals["q"]}) for r in sent.runs))
    sent = gains(sent, kp=np.zeros(2))
    gate._check_driven(sent)
    assert any("torques are taken as sent to the motors" in note for note in check(sent, trust=True))


def test_a_sign_that_looks_flipped_in_few_runs_alone_is_a_note(good):
    again = [replace(run, name=f"{run.name}_again", condition=f"{run.condition} again") for run in good.runs]
    first = signals(replace(good, runs=good.runs[:1]), q=lambda v: v * [1, -1], dq=lambda v: v * [1, -1])
    log = replace(good, runs=(*first.runs, *good.runs[1:], *again))
    assert any("flipped sign" in note for note in check(log))
    with pytest.raises(ValueError, match="flipped sign"):
        check(replace(log, runs=(*first.runs, *good.runs[1:])))


def test_torques_beside_an_unknown_controller_were_measured(good):
    runs = []
    for run in without(good, "target").runs:
        controller = replace(run.controller, kind="unknown", gains={})
        runs.append(replace(run, controller=controller, signals=run.signals | {"tau": run.signals["q"]}))
    notes = check(replace(good, runs=tuple(runs)), trust=True)
    assert any("the controller is unknown, so torques that were measured are compared" in note for note in notes)
    assert not any("taken as sent" in note for note in notes)


@pytest.mark.parametrize("name", ["Enabled", "enable", "ENABLED", "enabeled", "volt", "Tau.elbow", "gyro_x"])
def test_a_name_that_is_nearly_known_is_named(good, name):
    run = without(good, "enabled").runs[0]
    found = discover.gate.diagnose_log(replace(good, runs=(replace(run, other={name: run.time}),)))
    assert [one.kind for one in found[run.name]] == ["misspelt column"]


@pytest.mark.parametrize("name", ["temp", "load", "enabled_motors", "gripper_fraction", "battery"])
def test_a_name_of_the_users_own_is_left_alone(good, name):
    run = good.runs[0]
    assert discover.gate.diagnose_log(replace(good, runs=(replace(run, other={name: run.time}),)))[run.name] == []


def test_a_robot_that_touches_something_is_named(good):
    floor = '<geom name="floor" type="plane" size="1 1 1" pos="0 0 {}" contype="1" conaffinity="1"/>'
    hand = '<geom type="sphere" pos="0 0 -0.25" size="0.02" contype="1" conaffinity="1" mass="0"/>'

    def touching(height):
        text = ARM.read_text().replace("<worldbody>", f"<worldbody>{floor.format(height)}")
        inner = '<joint name="elbow" range="-2.0 2.0"/>'
        assert inner in text
        return contacts(good.runs[0], JOINTS, mujoco.MjModel.from_xml_string(text.replace(inner, inner + hand)))

    (found,) = touching(-0.5)
    assert (found.kind, found.misleading) == ("contact", True)
    assert "lower touches world in" in found.sentence
    # Far below nothing is touched; and what is touched in all rows is only drawn so.
    assert touching(-1.0) == touching(1.0) == []


def test_the_command_refuses_with_the_doctors_sentence_before_it_makes_a_folder(tmp_path, good):
    folder = tmp_path / "log"
    write(replace(signals(good, q=np.degrees, dq=np.degrees), robot="arm.xml"), folder)
    shutil.copy(ARM, folder / "arm.xml")
    assert read(folder).joints == JOINTS
    with pytest.raises(ValueError, match=r"set `units: \{angle: deg\}` in meta.yaml"):
        discover.main(discover.Args(logs=(folder,), out=tmp_path / "out", horizons=HORIZONS))
    assert not (tmp_path / "out").exists()


def test_a_folder_in_which_another_process_works_is_refused_before_anything_is_computed(tmp_path, good, monkeypatch):
    folder, out = tmp_path / "log", tmp_path / "out"
    write(replace(good, robot="arm.xml"), folder)
    shutil.copy(ARM, folder / "arm.xml")
    monkeypatch.setattr(discover, "investigate", lambda *_, **__: pytest.fail("it was begun"))
    args = discover.Args(logs=(folder,), out=out, horizons=HORIZONS, trust_log=True)
    with pytest.raises(pytest.fail.Exception, match="it was begun"):
        discover.main(args)
    with checkpoint.lock(out / "summary.json"), pytest.raises(ValueError, match="another process works on"):
        discover.main(args)


def test_flags_that_switch_physics_off_are_refused_unless_they_are_cleared(tmp_path, good):
    folder = tmp_path / "log"
    write(replace(signals(good, q=np.degrees, dq=np.degrees), robot="arm.xml"), folder)
    option = '<option timestep="0.001" gravity="0 0 -9.81"'
    text = ARM.read_text()
    assert option in text
    (folder / "arm.xml").write_text(text.replace(f"{option}/>", f'{option}><flag constraint="disable"/></option>'))
    with pytest.raises(ValueError, match="got constraint disabled"):
        discover.main(discover.Args(logs=(folder,), out=tmp_path / "out", horizons=HORIZONS))
    # Cleared, it is the doctor that refuses.
    with pytest.raises(ValueError, match="degrees for radians"):
        discover.main(discover.Args(logs=(folder,), out=tmp_path / "out", horizons=HORIZONS, clear_flags=True))


def test_the_doctor_looks_at_the_model_whose_flags_were_cleared(tmp_path, good):
    folder = tmp_path / "log"
    write(replace(good, robot="arm.xml"), folder)
    option = '<option timestep="0.001" gravity="0 0 -9.81"'
    (folder / "arm.xml").write_text(
        ARM.read_text().replace(f"{option}/>", f'{option}><flag gravity="disable"/></option>')
    )
    log, spec = read_logs([folder], clear_flags=True)
    assert gate.check(log, spec, HORIZONS) == []
    assert log.notes == ("flags of the model that disabled gravity were cleared",)


def slower(log, number, every):
    """The log with every so-manyth row of one run."""
    run = log.runs[number]
    run = replace(run, time=run.time[::every], signals={name: values[::every] for name, values in run.signals.items()})
    return replace(log, runs=(*log.runs[:number], run, *log.runs[number + 1 :]))


def test_runs_of_different_rates_are_refused(good):
    with pytest.raises(ValueError, match=r"run_002: got 250 rows a second, expected 500 as in run_000"):
        check(slower(good, 2, 2))


def test_runs_of_one_name_in_several_folders_are_conditions_of_their_own(tmp_path, good):
    folders = [tmp_path / f"log_{number}" for number in range(4)]
    for folder, run in zip(folders, good.runs, strict=True):
        write(replace(good, runs=(replace(run, name="run_000", condition="run_000", split=None),)), folder)
    log, _ = read_logs(folders)
    assert [run.condition for run in log.runs] == [f"run_000_{number}" for number in range(4)]
    assert log.notes == ()


def test_a_recording_that_is_there_twice_is_refused(tmp_path, good):
    write(good, tmp_path / "log")
    with pytest.raises(ValueError, match="got one recording twice, as run_000_0 and as run_000_1"):
        read_logs([tmp_path / "log", tmp_path / "log"])


def test_a_log_that_was_corrected_is_another_question(tmp_path, good):
    write(good, tmp_path / "log")
    log, spec = read_logs([tmp_path / "log"])
    assert digest(log, spec) == digest(*read_logs([tmp_path / "log"]))
    heavier = spec.copy()
    heavier.geoms[0].mass *= 1.1
    others = [
        digest(log, heavier),
        digest(gains(log, kp=np.array([41.0, 20.0])), spec),
        digest(signals(log, q=lambda values: -values), spec),
        digest(replace(log, runs=log.runs[1:]), spec),
        digest(replace(log, runs=(replace(log.runs[0], split="sealed"), *log.runs[1:])), spec),
    ]
    assert len({digest(log, spec), *others}) == 6
    # The supply of a servo may be given and recorded too.
    both = gains(log, volts=np.full(2, 7.4))
    both = replace(
        both, runs=tuple(replace(r, signals=r.signals | {"volts": np.full(len(r.time), 7.4)}) for r in both.runs)
    )
    assert len(digest(both, spec)) == 64
