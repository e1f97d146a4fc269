"""A slider whose truth is known: mass, damping, and whatever is hidden in it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxtune.discovery.problem import Hypothesis, Problem, Segments

AXES = ("mass", "damping", "coulomb", "push", "nothing", "cubic", "wild", "held", "drag")
HORIZONS = (0.1, 0.2, 0.4)
DT, NOISE = 0.01, 0.002
DRAWS = np.random.default_rng(5).standard_normal((12, 2)).clip(-2, 2)
"""[null logs, 2] mass and damping of the simulated null logs, in prior standard deviations."""


def simulate(system, vector, segment, steps):
    """A slider of 1 kg, 1 N s/m and `system` N of friction pushed by a force [steps]; coordinates are what is added."""
    del steps
    mass, damping, coulomb, push, _, cubic, wild, held, drag = vector

    def step(state, force):
        x, v = state
        # Held, the slider is pulled back to the middle by what else would brake it.
        rub = (system + coulomb) * jnp.tanh(jnp.where(held > 0, x, v) / 0.02) + cubic * x**3
        # A hypothesis that breaks the simulation wherever it is tried.
        broken = jnp.where(wild > 0, jnp.nan, 0.0)
        v = v + DT * (force + push - (1.0 + damping + drag) * v - rub) / jnp.exp(mass) + broken
        x = x + DT * v
        return (x, v), (x, v)

    _, (x, v) = jax.lax.scan(step, (segment["x"], segment["v"]), segment["force"])
    return {"q": x[:, None], "dq": v[:, None]}


play = jax.jit(jax.vmap(lambda system, vector, segment: simulate(system, vector, segment, 0), (None, None, 0)))


def hypothesis(name, bounds, probes, family="friction"):
    direction = np.array([[float(axis == name) for axis in AXES]])
    return Hypothesis(
        name=name,
        family=family,
        places=("slider",),
        directions=direction,
        probes=np.array(probes)[:, None],
        bounds=np.array([bounds]),
        prior=np.array([1.0]),
        joints=(0,),
    )


HYPOTHESES = (
    hypothesis("mass", (-1.0, 1.0), [-0.5, -0.1, 0.1, 0.5], "inertia"),
    hypothesis("damping", (-0.9, 5.0), [-0.5, 0.3, 1.0, 3.0]),
    hypothesis("coulomb", (0.0, 5.0), [0.05, 0.2, 0.8, 3.0]),
    hypothesis("push", (-5.0, 5.0), [-3.0, -0.3, 0.3, 3.0], "external"),
    hypothesis("nothing", (-5.0, 5.0), [-1.0, -0.05, 0.05, 1.0], "external"),
)
WILD = hypothesis("wild", (0.0, 1.0), [0.1], "external")


# What brakes the slider as its own damping does.
DRAG = hypothesis("drag", (0.0, 5.0), [0.3, 1.0, 3.0], "external")


# Friction and a push stand for one effect at two places, which may have one size or a size each.
ROWS = np.array([[float(axis == name) for axis in AXES] for name in ("coulomb", "push")])
ONE_SIZE = replace(HYPOTHESES[2], name="both", places=("one", "two"), directions=ROWS.sum(axis=0, keepdims=True))
EACH = replace(
    ONE_SIZE,
    directions=ROWS,
    probes=0.2 * np.eye(2),
    bounds=np.concatenate([HYPOTHESES[2].bounds, HYPOTHESES[3].bounds]),
    prior=np.ones(2),
    each=True,
)
BOTH = (*HYPOTHESES[:2], ONE_SIZE, EACH)


def measured(truth, seed, split=0, count=40, motion=None, rubs=0.0):
    """Segments by horizon: the truth's motion with noise, from states that are known to within the noise."""
    rng, moved = np.random.default_rng((seed, 1)), np.random.default_rng(seed if motion is None else motion)
    vector = np.array([truth.get(axis, 0.0) for axis in AXES], np.float32)
    found = {}
    for horizon in HORIZONS:
        steps = round(horizon / DT)
        force = (
            6.0 * moved.uniform(-1, 1, (count, 1)) * np.sin(moved.uniform(2, 12, (count, 1)) * DT * np.arange(steps))
        )
        start = {"x": moved.normal(0, 0.5, count), "v": moved.normal(0, 0.7, count), "force": force}
        start = {name: value.astype(np.float32) for name, value in start.items()}
        read = {name: np.asarray(value) for name, value in play(rubs, vector, start).items()}
        read = {name: value + NOISE * rng.standard_normal(value.shape) for name, value in read.items()}
        inputs = start | {name: start[name] + np.float32(NOISE) * rng.standard_normal(count) for name in ("x", "v")}
        inputs = {name: value.astype(np.float32) for name, value in inputs.items()}
        found[horizon] = Segments(
            inputs=inputs,
            signals=read,
            steps=steps,
            run=4 * split + np.arange(count) // 10,
            regimes=np.zeros((count, steps, 1), int),
        )
    return found


# While the slider slides, friction that differs between directions is friction and a push.
DIRECTION = replace(HYPOTHESES[3], name="coulomb", family="friction", form="direction_dependent")
# Friction that grows away from the middle of the slide, as of a warped rail.
WARPED = replace(hypothesis("cubic", (0.0, 30.0), [1.0, 10.0]), name="coulomb", form="warped")
# A form without which the effect is not seen.
HELD = replace(hypothesis("held", (0.0, 1.0), [0.5, 1.0]), name="coulomb", form="held", screened=True)


# Stands for a learned torque, which explains what no hypothesis does.
LEARNED = hypothesis("cubic", (-30.0, 30.0), [1.0])


def problem(truth, seed=0, hypotheses=HYPOTHESES, forms=(), residual=None, sealed=None, rubs=0.0):
    truths = {"train": truth, "select": truth, "sealed": truth if sealed is None else sealed}
    prior = np.array([0.1, 0.1, *np.zeros(len(AXES) - 2)])
    # Nobody knows the nominal parameters better than to a tenth.
    drawn = [{"mass": 0.1 * m, "damping": 0.1 * d} for m, d in DRAWS]
    splits = ("train", "select", "sealed")
    null_logs = [
        {split: measured(one, 900 + 100 * k + i, k, motion=10 * seed + k, rubs=rubs) for k, split in enumerate(splits)}
        for i, one in enumerate(drawn)
    ]
    return Problem(
        simulate=simulate,
        system=np.float32(rubs),
        axes=len(AXES),
        hypotheses=hypotheses,
        forms=forms,
        prior=prior,
        unknowns=np.zeros((0, len(AXES))),
        unknown_bounds=np.zeros((0, 2)),
        trees=np.array([0]),
        axis_trees=np.zeros(len(AXES), int),
        data={split: measured(one, 10 * seed + i, i, rubs=rubs) for i, (split, one) in enumerate(truths.items())},
        null_logs=null_logs,
        bin_rows=2,
        regimes=("steady",),
        components={"q": ("slider",), "dq": ("slider",)},
        push={"slider": AXES.index("push")},
        residual=residual,
    )
