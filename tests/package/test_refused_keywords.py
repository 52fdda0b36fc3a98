"""Every keyword of every public function and of every class that users make refuses what it cannot use, by its name."""

# pyright: reportArgumentType=false

import equinox as eqx
import jax.numpy as jnp
import jaxtyping
import pytest
from test_keywords import ARM, BAR, CALLS, FUNCTIONS, GRASP, HAND, OF_NUMBERS, Q, keywords_of

import jaxdyn as jd

# Values that fit no argument but those of `ACCEPTED`.
VALUES = {"text": "zzz", "object": object(), "mapping": {"zzz": 1.0}, "none": None, "not a number": float("nan")}
TARGET = lambda t: jnp.zeros(7)  # noqa: E731
IGNORED = {
    ("forward_dynamics", "t"): "the motion of bodies does not depend on it",
    ("inverse_dynamics", "t"): "as above",
    ("contact.gap_contact", "name"): "None is the default name",
    ("contact.DryFriction", "name"): "as above",
    ("ModelBuilder", "gravity"): "None is no gravity",
}
FLOWING = ("t", "preload", "dt")
CLASSES = {
    "contact.DryFriction": ((0.3, 1.0), {"static": 0.4, "smoothing": 0.1}),
    "contact.Parametrised": ((lambda u: jnp.array([u[0], u[1], 0.0]),), {}),
    "contact.Sphere": ((0.1,), {}),
    "contact.UnilateralContact": ((jd.rolling_sphere("a", (0, 0, 0), 0.1, spin=False),), {"static": 0.2}),
    "control.CartesianStiffness": ((ARM, HAND, lambda t: jnp.eye(4), 10.0, 1.0), {}),
    "control.GraspForce": ((GRASP, lambda t: jnp.eye(4), 10.0, 1.0), {"ki": 0.1}),
    "control.HybridForce": ((BAR, lambda q: q[:1], lambda t: jnp.zeros(1), 4.0), {"kd": 1.0}),
    "control.OperationalSpace": ((ARM, HAND, lambda t: jnp.eye(4), 10.0, 1.0), {"posture": Q}),
    "events.ContactLost": ((), {}),
    "events.JointLimit": ((), {}),
    "events.ModeSwitches": ((), {}),
    "forces.CoulombFriction": ((), {"level": 0.1, "joints": "a"}),
    "forces.Drive": ((1.0, 0.1, 0.0), {"effort_limit": 1.0, "joints": "a"}),
    "forces.EffortLimits": ((), {"limit": 2.0}),
    "forces.ElasticTransmission": (("a", "b", 1.0), {}),
    "forces.ExternalWrench": (("a", jnp.zeros(6)), {}),
    "forces.FirstOrderDrive": ((0.1,), {"joints": "a"}),
    "forces.JointDamping": ((), {"coefficient": 0.1, "joints": "a"}),
    "forces.JointSpring": ((1.0,), {"rest": 0.1, "joints": "a"}),
    "forces.JointStops": ((), {"joints": "a"}),
    "forces.SecondOrderDrive": ((1.0,), {"joints": "a"}),
    "forces.SlidingFriction": ((0.1, 1.0, 1), {}),
    "identify.Measured": ((ARM,), {"position_bias": Q, "torque_gain": Q, "torque_bias": Q}),
    "identify.Objective": ((), {}),
    "identify.Solver": ((), {}),
    "Holonomic": ((lambda q, t: q[:1],), {}),
    "Pfaffian": ((lambda q, t: q[None],), {"b": lambda q, t: q[:1]}),
    "ModelBuilder": ((), {}),
    "MetricSystem": ((lambda q: jnp.eye(2), 2), {"potential": lambda q: q @ q}),
    "LagrangianSystem": ((lambda q, v: v @ v, 2), {"potential": lambda q: q @ q}),
    "ExplicitSystem": ((lambda q: jnp.eye(2), lambda q, v: v, 2), {"potential": lambda q: q @ q}),
    "Multipliers": ((), {}),
    "Projected": ((), {}),
    "Reduced": ((), {}),
    "Variational": ((), {}),
    "simulation.Baumgarte": ((), {}),
    "sensors.Encoder": (("a",), {"resolution": 0.1, "noise": jd.sensors.Noise(0.1)}),
    "sensors.ForceTorque": (("a",), {"noise": jd.sensors.Noise(0.1)}),
    "sensors.FramePose": (("a",), {"noise": jd.sensors.Noise(0.1)}),
    "sensors.Imu": (("a",), {"noise": jd.sensors.Noise(0.1)}),
    "sensors.Noise": ((), {}),
}


@pytest.fixture(autouse=True)
def as_users_have_it():
    """Without the checks of annotations that the tests put before all functions."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def find(name):
    item = jd
    for part in name.split("."):
        item = getattr(item, part)
    return item


def wrong_outcomes(name, function, args, given, run):
    """What happened, for each keyword and value that was accepted or refused without the keyword's name or the value."""
    keywords = keywords_of(function) | given
    wrong = []
    for key, usual in keywords.items():
        for kind, value in VALUES.items():
            if (name, key) in IGNORED:
                continue
            # States, times and forces that are not a number give results that are none, as everywhere in JAX.
            if key in FLOWING and kind == "not a number":
                continue
            if (value is None and keywords_of(function).get(key, 0) is None) or (
                kind == "text" and (isinstance(usual, str) or key.endswith(("name", "body", "object")))
            ):
                continue
            try:
                run(lambda key=key, value=value: function(*args, **{**keywords, key: value}))
            except ValueError as error:
                if key not in str(error) and "zzz" not in str(error):
                    wrong.append(f"{name}: {key}, {kind}: {error}")
            except Exception as error:
                wrong.append(f"{name}: {key}, {kind}: {type(error).__name__}: {error}")
            else:
                wrong.append(f"{name}: {key}, {kind}: accepted")
    return wrong


@pytest.mark.parametrize("name", sorted(CALLS))
def test_functions(name):
    args, given = CALLS[name]
    run = (
        (lambda call: call())
        if name in OF_NUMBERS or name.startswith(("constraints.", "contact."))
        else eqx.filter_eval_shape
    )
    wrong = wrong_outcomes(name, FUNCTIONS[name], args, given, run)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", sorted(CLASSES))
def test_classes(name):
    wrong = wrong_outcomes(name, find(name), *CLASSES[name], lambda call: call())
    assert not wrong, "\n".join(wrong)
